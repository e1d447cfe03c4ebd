"""Which images of a stream with holes go on together."""

import numpy as np
import pytest

from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.smoother.window import STEP_S, cleaned, ready


def images(*stamps_s):
    return [(t, PointsFrame("cam0", int(t * 1e9), np.arange(4), np.zeros((4, 2)))) for t in stamps_s]


def stamps(found):
    return [t for t, _ in found.frames]


def test_a_step_at_most_and_nothing_that_inertial_data_do_not_cover():
    waiting = images(*np.arange(0.1, 4.0, 0.1))
    assert stamps(ready(waiting, 0.0, 1.05)) == pytest.approx(np.arange(0.1, 1.05, 0.1))
    assert stamps(ready(waiting, 0.0, 4.0))[-1] == pytest.approx(STEP_S)


def test_a_hole_ends_what_is_taken_and_one_at_once_is_told():
    before, after = ready(images(0.1, 0.2, 2.0, 2.1), 0.0, 3.0), ready(images(2.0, 2.1), 0.2, 3.0)
    assert (stamps(before), before.gap_follows, before.hole_s) == ([0.1, 0.2], True, 0.0)
    assert (after.frames, after.gap_follows, after.hole_s) == ([], True, pytest.approx(1.8))


def test_images_that_inertial_data_never_reach_are_a_hole_only_after_a_while():
    assert ready(images(9.0), 0.0, 2.9).hole_s == 0.0
    assert ready(images(9.0), 0.0, 3.1).hole_s == pytest.approx(3.1)


def test_each_identity_once_and_finite():
    uv = np.array([[1.0, 1.0], [np.nan, 2.0], [3.0, 3.0], [4.0, 4.0]])
    frame = cleaned(PointsFrame("cam0", 0, np.array([7, 8, 7, 9]), uv))
    assert frame.ids.tolist() == [7, 9]
    assert frame.uv_px.tolist() == [[1.0, 1.0], [4.0, 4.0]]
