"""The correction of one image where its model bends."""

import numpy as np
import pytest

from vical_daemon.estimation.filter.image_update import blurred, log_likelihood, solve
from vical_daemon.estimation.filter.linearise import Image, Linear

POINTS, STATES = 6, 3


def test_a_step_that_puts_the_points_behind_the_camera_is_not_linearised_about():
    rng = np.random.default_rng(1)
    ways = rng.standard_normal((2 * POINTS, STATES))
    e = rng.standard_normal(STATES)
    uv = (ways @ e).reshape(-1, 2)
    image = Image("cam0", 0, 0.0, np.arange(POINTS), np.zeros((POINTS, 3)), uv, np.full(POINTS, 0.01))
    all_seen, bent = np.ones(POINTS, bool), np.full((2 * POINTS, 1), 0.005)

    def linear(valid):
        z, none = np.zeros((POINTS, 2)), np.zeros((STATES, 0))
        return Linear(z, ways, np.eye(STATES), np.eye(STATES), bent, valid, none)

    asked = []

    def behind(dx, S):
        asked.append(dx)
        return linear(np.zeros(POINTS, bool))

    fit = solve(image, np.eye(STATES), linear(all_seen), all_seen, behind)
    assert len(asked) == 1  # it was bent, so once more was tried
    assert fit.keep.all()
    np.testing.assert_allclose(fit.dx, e, atol=0.05)


def test_a_blurred_image_is_known_from_a_moved_one():
    """Noise of five times the usual is found; a turn of the camera, however large, is none."""
    rng, n = np.random.default_rng(4), 60
    ways = rng.standard_normal((2 * n, STATES))
    image = Image("cam0", 0, 0.0, np.arange(n), np.zeros((n, 3)), np.zeros((n, 2)), np.full(n, 0.2))
    none = np.zeros((2 * n, 0))
    lin = Linear(
        image.uv, ways, np.eye(STATES), np.eye(STATES), none, np.ones(n, bool), np.zeros((STATES, 0))
    )
    white = 0.2 * rng.standard_normal((n, 2))
    moved = (ways @ [30.0, -20.0, 10.0]).reshape(-1, 2)
    assert blurred(image, white + moved, lin) < 1.2
    assert blurred(image, 5.0 * white + moved, lin) == pytest.approx(5.0, rel=0.2)
    wrong = moved + 200.0 * rng.standard_normal((n, 2))  # corners of something else
    assert blurred(image, wrong, lin) == 1.0


def test_the_likelihood_of_an_image_counts_its_corner_noise():
    """Against the density of the innovation: filters with different noise of corners can be compared."""
    rng = np.random.default_rng(5)
    ways = rng.standard_normal((2 * POINTS, STATES))
    uv = (ways @ rng.standard_normal(STATES)).reshape(-1, 2) + 0.2 * rng.standard_normal((POINTS, 2))
    none, seen = np.zeros((2 * POINTS, 0)), np.ones(POINTS, bool)
    lin = Linear(
        np.zeros((POINTS, 2)), ways, np.eye(STATES), np.eye(STATES), none, seen, np.zeros((STATES, 0))
    )
    off = []
    for sigma in (0.1, 0.2, 2.0):
        image = Image("cam0", 0, 0.0, np.arange(POINTS), np.zeros((POINTS, 3)), uv, np.full(POINTS, sigma))
        fit = solve(image, np.eye(STATES), lin, seen, lambda *_: lin)
        assert fit.keep.all()
        V = ways @ ways.T + (sigma * fit.noise) ** 2 * np.eye(2 * POINTS)
        expected = -0.5 * (uv.ravel() @ np.linalg.solve(V, uv.ravel()) + np.linalg.slogdet(V)[1])
        off.append(log_likelihood(fit, image) - expected)
    np.testing.assert_allclose(off, off[0], atol=1e-9)
