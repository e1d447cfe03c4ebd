"""Pairs of images that share features."""

import numpy as np

from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.temporal.epipolar_pairs import make_pairs


def frames(count=40, features=20):
    """Feature k has the pixel (k, image); twelve of twenty are in view, others every ten images."""
    out = []
    for i in range(count):
        ids = np.sort((np.arange(12) + i // 10) % features)
        out.append((0.05 * i, PointsFrame("cam0", i, ids, np.stack([ids, np.full(12, i)], axis=1) * 1.0)))
    return out


def test_rows_refer_to_sightings_and_each_is_there_once():
    pairs = make_pairs(frames())
    first, second = pairs.uv[pairs.at_1], pairs.uv[pairs.at_2]
    np.testing.assert_array_equal(first, np.stack([pairs.ids, pairs.first[pairs.of]], axis=1))
    np.testing.assert_array_equal(second, np.stack([pairs.ids, pairs.second[pairs.of]], axis=1))
    assert len(np.unique(pairs.uv, axis=0)) == len(pairs.uv)
    assert len(pairs.of) > len(pairs.uv)


def test_rows_can_be_moved_each_by_itself():
    pairs = make_pairs(frames())
    by_1, by_2 = np.random.default_rng(1).standard_normal((2, len(pairs.of), 2))
    moved = pairs.moved(by_1, by_2)
    np.testing.assert_allclose(moved.uv[moved.at_1], pairs.uv[pairs.at_1] + by_1)
    np.testing.assert_allclose(moved.uv[moved.at_2], pairs.uv[pairs.at_2] + by_2)
