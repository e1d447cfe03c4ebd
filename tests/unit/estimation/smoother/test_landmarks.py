"""Landmarks in a step: to first order as if anchors stayed, exact if all cameras move alike."""

import numpy as np

from vical_daemon.estimation.geometry.so3 import tangents
from vical_daemon.estimation.smoother.window import Landmarks


def some(count=6):
    rng = np.random.default_rng(7)
    bearing = rng.standard_normal((count, 3))
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    return Landmarks(np.arange(count), rng.standard_normal((count, 3)), bearing, rng.uniform(0.1, 2.0, count))


def places(marks):
    return marks.anchor + marks.bearing / marks.inverse[:, None]


def step_of(marks, moves):
    """Two tangents and the inverse distance by which points move so, to first order, if anchors stay."""
    aside = np.einsum("nij,ni->nj", tangents(marks.bearing), moves) * marks.inverse[:, None]
    ahead = np.vecdot(marks.bearing, moves)
    return np.concatenate([aside, -(marks.inverse**2 * ahead)[:, None]], axis=1)


def test_a_step_that_moves_all_alike_is_exact():
    marks, move = some(), np.array([0.3, -0.5, 0.4])
    along = np.broadcast_to(move, marks.anchor.shape)
    there = marks.moved(step_of(marks, along), along)
    np.testing.assert_allclose(places(there), places(marks) + move, rtol=1e-12)
    apart = marks.moved(step_of(marks, along), np.zeros_like(marks.anchor))
    assert np.abs(places(apart) - places(marks) - move).max() > 0.1


def test_anchors_that_move_change_a_step_in_second_order_only():
    marks, rng = some(), np.random.default_rng(8)
    moves, along = rng.standard_normal((2, 6, 3))
    off = []
    for small in (1e-2, 1e-3):
        there = marks.moved(step_of(marks, small * moves), small * along)
        off.append(np.abs(places(there) - places(marks) - small * moves).max())
    assert off[1] < 0.02 * off[0]
