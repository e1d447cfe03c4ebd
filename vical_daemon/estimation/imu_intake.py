"""Where inertial readings enter an estimator: put on one even axis, repeated ones left out, gaps reported."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vical_daemon.estimation.imu_buffer import GAP_S, ImuBuffer
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.stamp_steps import StampSteps


class ImuIntake:
    """Fills the buffer of inertial readings from one stream.

    A device or driver that hangs repeats its last reading bit by bit. Six noisy channels never do that by
    themselves, so such readings are left out: what remains is a gap like any other.

    Attributes:
        stamps: Steps in the stamps, and how to report estimates by the stamps as they are now.
        buffer: The readings, s since the first stamp; None before the first one.
        base_ns: First stamp, ns.
        repeated: Readings left out because they repeat the one before, bit by bit.
        gap_end_s: Where readings resumed after the latest gap, s; -inf: there was none.
    """

    def __init__(self) -> None:
        self.stamps = StampSteps()
        self.buffer: ImuBuffer | None = None
        self.base_ns = 0
        self.repeated = 0
        self.gap_end_s = -np.inf
        self._last = np.full(6, np.nan)
        self._repeats = 0  # of the newest reading
        self._news: list[str] = []

    def take(
        self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]
    ) -> tuple[FloatArray, FloatArray] | None:
        """Add one reading.

        Args:
            t_imu_ns: Stamp in the imu's clock, ns.
            gyro_rps: Measured rate, rad/s.
            specific_force_mps2: Measured specific force, m/s^2.

        Returns:
            Rate and force as arrays where the reading was added; None where it is not newer than the last,
            not finite, or a repetition.
        """
        if self.buffer is None:
            self.base_ns = t_imu_ns
            self.buffer = ImuBuffer(t_imu_ns)
        reading = np.array([*gyro_rps, *specific_force_mps2], dtype=np.float64)
        t_s = self.stamps.even((t_imu_ns - self.base_ns) * 1e-9)
        if (reading == self._last).all():
            self.repeated += 1
            self._repeats += 1
            return None
        gap_s = t_s - self.buffer.newest_s
        bridged = gap_s <= GAP_S or gap_s <= self.buffer.usual_gap_s or not len(self.buffer)
        if not self.buffer.append(t_s, reading[:3], reading[3:]):
            return None
        if not bridged:
            what = "in which the IMU repeated one reading" if self._repeats else "without inertial data"
            self._news.append(f"{gap_s:.1f} s {what}")
            self.gap_end_s = t_s
        self._last, self._repeats = reading, 0
        return reading[:3], reading[3:]

    def news(self) -> list[str]:
        """What happened to the stream since the last call, in words."""
        news, self._news = self._news + self.stamps.news(), []
        return news
