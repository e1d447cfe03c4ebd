"""A log of a computer without a battery-backed clock, which starts in 1970."""

from __future__ import annotations

import pytest

from vical_daemon.bus import messages as m
from vical_daemon.bus.topics import IMU, TF_STATIC
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.logs.summary import summarise_logs


def test_the_length_of_a_list_is_no_stamp(tmp_path):
    """Transforms came at 1000000000 Hz and 39 s late: their number, 1, was read as a second of 1970."""
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        for k in range(20):
            t_ns = 30 * 10**9 + k * 10**9
            transform = m.Transform(t_ns, "imu0", "cam0", [0.0] * 3, [1.0, 0.0, 0.0, 0.0])
            log.write(TF_STATIC.key("rig0"), m.encode_transforms([transform]), t_ns)
            log.write(IMU.key("rig0", "imu0"), m.encode_imu(t_ns, "imu0", (0.0,) * 3, (0.0,) * 3), t_ns)
    for topic in summarise_logs(path, [path]).topics:
        assert topic.rate_hz == pytest.approx(1.0) and topic.missing == 0
