"""Whether a rig moves, from its angular rates: a rig at rest shows nothing of its calibration. No I/O."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import MessageError, admit_imu

LISTEN_S = 1.0
"""Stretch of readings that are looked at together, s."""
_STILL_RPS = float(np.deg2rad(1.0))
"""Standard deviation of the angular rate below which the rig counts as still, rad/s: there, a time shift of
1 ms turns the image by 0.001 deg, a hundredth of a pixel."""
_MOTION_HZ = 50.0  # readings that are looked at for motion; a hand's motion stays below 10 Hz


class Motion:
    """Whether the rig moves, from the angular rate of the last second.

    Args:
        rate_hz: Readings per second that arrive.
    """

    def __init__(self, rate_hz: float) -> None:
        self._every = max(1, round(rate_hz / _MOTION_HZ))
        self._count = 0
        self._rates: list[tuple[float, float, float]] = []
        self.moved_s = -np.inf  # steady time of the last motion
        self.looked = False

    def take(self, sample: Sample, now_s: float) -> None:
        """Take an inertial sample; most are not decoded."""
        self._count += 1
        if self._count % self._every:
            return
        with suppress(MessageError):
            gx, gy, gz = admit_imu(sample.payload).gyro_rps
            self._rates.append((gx, gy, gz))
        if len(self._rates) < _MOTION_HZ * LISTEN_S:
            return
        spread = float(np.linalg.norm(np.std(self._rates, axis=0)))
        self._rates.clear()
        self.looked = True
        if spread > _STILL_RPS:
            self.moved_s = now_s
