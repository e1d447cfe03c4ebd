"""Measured corner noise: from whatever guess, to whatever truth."""

import numpy as np
import pytest

from vical_daemon.estimation.noise.corner_noise import CornerNoise


@pytest.mark.parametrize("guess_px", [0.1, 0.5, 3.0])
@pytest.mark.parametrize("true_px", [0.01, 0.2, 2.0])
def test_the_guess_is_forgotten(guess_px, true_px):
    rng, noise = np.random.default_rng(0), CornerNoise(guess_px)
    for _ in range(200):
        residual = true_px * rng.standard_normal(80) / noise.sigma_px
        noise.learn(float(residual @ residual), 80)
    assert noise.sigma_px == pytest.approx(true_px, rel=0.05)


def test_one_frame_does_not_overthrow_the_guess():
    noise = CornerNoise(0.5)
    noise.learn(0.001, 10)
    assert 0.4 < noise.sigma_px < 0.5
    noise.learn(1.0, 3)  # too few corners to say anything
    assert 0.4 < noise.sigma_px < 0.5


def test_a_change_of_focus_is_followed():
    rng, noise = np.random.default_rng(1), CornerNoise(0.5)
    for true_px in (0.2, 0.6):
        for _ in range(3000):
            residual = true_px * rng.standard_normal(80) / noise.sigma_px
            noise.learn(float(residual @ residual), 80)
        assert noise.sigma_px == pytest.approx(true_px, rel=0.1)
