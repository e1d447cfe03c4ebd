"""How fast a rig turns and accelerates at one instant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.inertial.imu_buffer import ImuSegment
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import State

SLOPE_S = 0.02  # of readings over which the slope of a rate is taken: two or more at 100 Hz
RATE_BLOCK_S = 0.1  # over which rates are averaged before their changes are looked at


class Rates(NamedTuple):
    """Nominal rates at the state's instant, for moving the pose over the uncertain part of the delay.

    Attributes:
        omega: Angular rate in the imu frame, rad/s, shape (3,).
        accel: Acceleration in the world (gravity included), m/s^2, shape (3,).
        alpha: Angular acceleration in the imu frame, rad/s^2, shape (3,). Half a readout of 20 ms later a
            hand has turned by 0.1 deg more than its rate says.
    """

    omega: FloatArray
    accel: FloatArray
    alpha: FloatArray = np.zeros(3)


def rates_after(state: State, segment: ImuSegment, before: Rates) -> Rates:
    """Rates at the end of a segment.

    Args:
        state: At that instant.
        segment: Readings that lead there; may have no length.
        before: What it was thought to be; stands for the angular acceleration where nothing shows it.
    """
    omega = state.gyro_matrix @ (segment.gyro[-1] - state.gyro_bias)
    force = state.accel_matrix @ (segment.accel[-1] - state.accel_bias)
    alpha = before.alpha
    if segment.t_s[-1] > segment.t_s[0]:
        alpha = state.gyro_matrix @ _late_slope(segment.t_s, segment.gyro)
    return Rates(omega, state.R_world_imu @ force + state.gravity, alpha)


def _late_slope(t_s: FloatArray, values: FloatArray) -> FloatArray:
    """Derivative of readings (n, 3) over the last hundredths of a second, by least squares."""
    recent = slice(max(int(np.searchsorted(t_s, t_s[-1] - SLOPE_S)) - 1, 0), None)
    t = t_s[recent] - t_s[recent].mean()
    return np.asarray(t @ values[recent] / (t @ t))
