"""When a stretch of data ends: no motion, no points, or enough."""

from __future__ import annotations

import numpy as np
import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import encode_imu, encode_points
from vical_daemon.calibrate.motion import Motion
from vical_daemon.calibrate.stretch import LONGEST_S, Stretch

IMU, POINTS = topics.IMU.key("rig0", "imu0"), topics.POINTS.key("rig0", "cam0")


def length_s(*, moves_until_s=1e9, seen_until_s=1e9, per_second=1.0):
    """Seconds that a stretch lasts, which begins while the rig moves; `per_second`: data used."""
    motion = Motion(50.0)
    motion.moved_s = 0.0
    stretch = Stretch(IMU, motion, 0.0, 100.0)
    nowhere = encode_points(1, "cam0", np.zeros(0, np.int64), np.zeros((0, 2)))
    board = encode_points(1, "cam0", np.arange(4), np.ones((4, 2)))
    for now_s in np.arange(0.0, 60.0, 0.02):
        rate = 0.3 * np.sin(9.0 * now_s) if now_s < moves_until_s else 0.0
        stretch.take(Sample(IMU, encode_imu(1, "imu0", (rate, 0.0, 0.0), (0.0, 0.0, 9.8)), 0), now_s)
        stretch.take(Sample(POINTS, board if now_s < seen_until_s else nowhere, 0), now_s)
        if stretch.over(now_s, 100.0 + per_second * now_s):
            return now_s
    return 60.0


def test_it_ends_after_enough_data():
    assert length_s() == pytest.approx(LONGEST_S, abs=0.05)
    assert length_s(per_second=0.0) == 60.0  # what is not used does not count


def test_it_ends_soon_after_the_rig_stands_still():
    assert 12.0 < length_s(moves_until_s=10.0) < 15.0


def test_it_ends_when_the_board_is_out_of_view():
    assert length_s(seen_until_s=10.0) == pytest.approx(15.0, abs=0.1)
