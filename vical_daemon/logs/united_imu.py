"""Makes one IMU of a gyro and an accelerometer that were recorded as two topics.

Drivers of RealSense, ZED and OAK cameras publish a sensor_msgs/Imu for each sensor, each at its own rate and
with zeros in place of the other. Rates need the forces of the same instants: they are interpolated.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray

_LOST = 2.5
"""Intervals of the accelerometer without a reading from which on nothing is interpolated: one reading may be
lost. At 60 Hz two intervals are 33 ms; a cubic leaves 0.4 % of a motion of 3 Hz."""
_LEAST = 4  # readings: those of a cubic


def lacks(values: FloatArray) -> str:
    """Name the sensor of which a topic holds nothing: gyro, accelerometer; empty where it holds both or none.

    Args:
        values: Rates and forces, shape (n, 6).
    """
    gyro, force = (bool((values[:, k] != 0.0).any()) for k in (slice(0, 3), slice(3, 6)))
    if gyro == force:
        return ""
    return "accelerometer" if gyro else "gyro"


def forces_at(t_ns: IntArray, accel_ns: IntArray, force: FloatArray) -> FloatArray:
    """Interpolate specific forces to the stamps of a gyro by cubic splines.

    Args:
        t_ns: Where they are wanted, ns, shape (n,).
        accel_ns: Stamps of the accelerometer, ns, shape (m,), in any order.
        force: Its readings, m/s^2, shape (m, 3).

    Returns:
        Shape (n, 3); NaN before the first reading, after the last, and where readings were lost.
    """
    from scipy.interpolate import CubicSpline

    out = np.full((len(t_ns), 3), np.nan)
    good = np.isfinite(force).all(axis=1)
    stamps, first = np.unique(accel_ns[good], return_index=True)
    if len(stamps) < _LEAST:
        return out
    force = force[good][first]
    steps = np.diff(stamps)
    ends = np.flatnonzero(steps > _LOST * np.median(steps)) + 1
    for begin, end in pairwise([0, *ends.tolist(), len(stamps)]):
        if end - begin < _LEAST:
            continue
        since_s = (stamps[begin:end] - stamps[begin]) * 1e-9
        inside = np.flatnonzero((t_ns >= stamps[begin]) & (t_ns <= stamps[end - 1]))
        at_s = (t_ns[inside] - stamps[begin]) * 1e-9
        out[inside] = CubicSpline(since_s, force[begin:end])(at_s)
    return out
