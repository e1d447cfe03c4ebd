"""Puts readings of gyro and accelerometer together that were taken at the same time.

An accelerometer behind a slow filter is late by tens of milliseconds. The estimator knows a lag to first
order, f + lag f', which is good to 0.2 % of a motion of 3 Hz up to 3 ms. In a recording the accelerometer's
readings can be moved by a whole number of intervals instead; what remains is less than one interval.
"""

from __future__ import annotations

from collections import deque

from vical_daemon.logs.channel import force_of, stamp_of, with_force

STRAIGHT_S = 3e-3
"""Up to this lag, s, the first order will do: (2 pi 3 Hz * 3 ms)**2 / 2 = 0.2 %."""
_GAP_NS = 100_000_000  # readings on both sides of such a gap do not belong together


class AccelShift:
    """Gives the rates of each reading the specific force of a later, or an earlier, one.

    Args:
        readings: By how many the accelerometer is behind the gyro; negative: ahead.
    """

    def __init__(self, readings: int) -> None:
        self._readings = readings
        self._held: deque[bytes] = deque()
        self._newest_ns = 0

    def take(self, payload: bytes) -> bytes | None:
        """Take the next reading (sensor_msgs/Imu); return one that is complete, or None."""
        if not self._readings or (stamp_ns := stamp_of(payload)) is None:
            return payload
        if stamp_ns - self._newest_ns > _GAP_NS:
            self._held.clear()
        self._newest_ns = stamp_ns
        self._held.append(payload)
        if len(self._held) <= abs(self._readings):
            return None
        other = self._held.popleft()
        if self._readings > 0:
            return with_force(other, force_of(payload))
        return with_force(payload, force_of(other))
