"""The correction of one image where its model bends."""

import numpy as np

from vical_daemon.estimation.filter.image_update import solve
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
