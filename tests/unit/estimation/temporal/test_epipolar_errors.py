"""What is known of errors along tracks: sizes and memory from residuals, and what they add to a gradient."""

import numpy as np
import pytest
from scipy.optimize import nnls

from vical_daemon.estimation.temporal.epipolar_errors import (
    Effects,
    TrackNoise,
    _not_negative,
    gyro_scores,
    persistent_scores,
    sighting_errors,
    track_noise,
)
from vical_daemon.estimation.temporal.epipolar_pairs import Pairs

N_IMAGES, N_TRACKS, DT = 60, 40, 0.05
T = np.arange(N_IMAGES) * DT
NOISE = TrackNoise(white=0.2**2, persistent=0.5**2, memory_s=0.8)


def pairs_of(lags=(2, 5, 10, 20, 40)):
    first = np.concatenate([np.arange(N_IMAGES - lag) for lag in lags])
    second = np.concatenate([np.arange(lag, N_IMAGES) for lag in lags])
    of = np.repeat(np.arange(len(first)), N_TRACKS)
    ids = np.tile(np.arange(N_TRACKS), len(first))
    one = np.zeros((2, len(of)), dtype=int)
    return Pairs(first, second, np.arange(len(first)) * N_TRACKS, of, ids, np.zeros((1, 2)), *one)


def effects_of(pairs, seed=0):
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(pairs.of))
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1) / np.sqrt(2.0)
    return Effects(-direction, direction, np.random.default_rng(seed + 1).normal(0, 1, (len(pairs.of), 3)))


def residuals(pairs, effects, first, second):
    return np.sum(effects.by_first * first + effects.by_second * second, axis=1)


def test_sizes_and_memory_of_errors_are_found_from_residuals():
    pairs = pairs_of()
    effects = effects_of(pairs)
    e = residuals(pairs, effects, *sighting_errors(pairs, T, NOISE, 1.0))
    lag = (T[pairs.second] - T[pairs.first])[pairs.of]
    found = track_noise(e, lag, effects.by_first, effects.by_second)
    assert np.sqrt(found.white) == pytest.approx(0.2, abs=0.06)
    assert np.sqrt(found.persistent) == pytest.approx(0.5, rel=0.2)
    assert 0.4 <= found.memory_s <= 1.5
    white = TrackNoise(0.3**2, 0.0, 0.8)
    e = residuals(pairs, effects, *sighting_errors(pairs, T, white, 1.0))
    found = track_noise(e, lag, effects.by_first, effects.by_second)
    assert found.white + found.persistent == pytest.approx(0.09, rel=0.1)


def test_least_squares_that_are_not_negative_agree_with_scipy():
    rng = np.random.default_rng(2)
    for _ in range(200):
        A, b = rng.normal(size=(8, 2)), rng.normal(size=8)
        A[:, 1] *= rng.integers(2)
        (x, left), (expected, norm) = _not_negative(A, b), nnls(A, b)
        assert left == pytest.approx(norm)
        np.testing.assert_allclose(A @ x, A @ expected, atol=1e-9)


def test_the_gradients_covariance_is_that_of_drawn_errors(monkeypatch):
    pairs = pairs_of((2, 5, 10))
    effects = effects_of(pairs, 3)
    clear = np.random.default_rng(5).normal(0, 1, (len(pairs.of), 3)) + 0.5
    expected = persistent_scores(clear, pairs, T, effects, NOISE)
    draws = []
    original = np.random.default_rng
    for seed in range(400):
        monkeypatch.setattr(np.random, "default_rng", lambda _, seed=seed: original(seed))
        draws.append(clear.T @ residuals(pairs, effects, *sighting_errors(pairs, T, NOISE, 1.0)))
    monkeypatch.undo()
    np.testing.assert_allclose(np.cov(np.array(draws).T), expected, rtol=0.25, atol=0.1 * expected.max())
    treated_as_new = persistent_scores(clear, pairs, T, effects, TrackNoise(0.29, 0.0, 0.8))
    assert np.abs(np.diag(expected) / np.diag(treated_as_new) - 1.0).max() > 0.2


def test_the_gyros_noise_is_shared_by_all_pairs_that_span_it():
    pairs = pairs_of((2, 5))
    effects = effects_of(pairs, 7)
    clear = np.ones((len(pairs.of), 1))
    density = 0.01
    expected = gyro_scores(clear, pairs, T, effects, density)
    rng = np.random.default_rng(8)
    draws = []
    for _ in range(600):
        walk = np.vstack(
            [np.zeros(3), np.cumsum(rng.normal(0, density * np.sqrt(DT), (N_IMAGES - 1, 3)), axis=0)]
        )
        turn = (walk[pairs.second] - walk[pairs.first])[pairs.of]
        draws.append(np.sum(effects.by_turn * turn))
    assert np.var(draws) == pytest.approx(float(expected[0, 0]), rel=0.2)
