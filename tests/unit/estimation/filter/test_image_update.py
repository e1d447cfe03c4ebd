"""The correction by one image."""

import numpy as np
import pytest

from vical_daemon.estimation.filter.image_update import blurred, solve
from vical_daemon.estimation.filter.linearise import Image, Linear

STATES = 3


def test_a_correction_finds_the_state_and_leaves_out_an_impossible_corner():
    rng, n = np.random.default_rng(1), 20
    ways, e = rng.standard_normal((2 * n, STATES)), rng.standard_normal(STATES)
    uv = (ways @ e).reshape(-1, 2)
    uv[3] += 5.0
    image = Image("cam0", 0, 0.0, np.arange(n), np.zeros((n, 3)), uv, np.full(n, 0.01))
    none, unit = np.zeros((2 * n, 0)), np.eye(STATES)
    lin = Linear(np.zeros((n, 2)), ways, unit, unit, none, np.ones(n, bool), np.zeros((STATES, 0)))
    fit = solve(image, unit, lin, lin.valid)
    assert np.flatnonzero(~fit.keep).tolist() == [3]
    np.testing.assert_allclose(fit.dx, e, atol=0.01)


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
