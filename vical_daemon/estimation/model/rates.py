"""How fast a rig turns and accelerates at one instant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuSegment
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import State

RATE_BLOCK_S = 0.1  # over which rates are averaged before their changes are looked at


class Rates(NamedTuple):
    """Nominal rates at the state's instant, for moving the pose over the uncertain part of the delay.

    Attributes:
        omega: Angular rate in the imu frame, rad/s, shape (3,).
        accel: Acceleration in the world (gravity included), m/s^2, shape (3,).
        alpha: Angular acceleration in the imu frame, rad/s^2, shape (3,). Half a readout of 20 ms later a
            hand has turned by 0.1 deg more than its rate says.
        jerk: Its derivative, rad/s^3, shape (3,).
        jolt: Derivative of the acceleration as seen in the imu frame, m/s^3, shape (3,).
    """

    omega: FloatArray
    accel: FloatArray
    alpha: FloatArray = np.zeros(3)
    jerk: FloatArray = np.zeros(3)
    jolt: FloatArray = np.zeros(3)


def rates_at(
    state: State, R: FloatArray, gyro: FloatArray, accel: FloatArray, trend: FloatArray | None, before: Rates
) -> Rates:
    """Rates at an instant.

    Args:
        state: Biases, matrices and gravity.
        R: R_world_imu, shape (3, 3).
        gyro: Measured rate, rad/s, shape (3,).
        accel: Measured specific force, m/s^2, shape (3,).
        trend: Derivatives of both, see `ImuBuffer.trend`, or None.
        before: What it was thought to be; stands for derivatives that nothing shows.
    """
    omega = state.gyro_matrix @ (gyro - state.gyro_bias)
    force = R @ (state.accel_matrix @ (accel - state.accel_bias))
    if trend is None:
        return Rates(omega, force + state.gravity, *before[2:])
    alpha, jerk = trend[:, :3] @ state.gyro_matrix.T
    jolt = state.accel_matrix @ trend[0, 3:] - so3.hat(omega) @ (state.gravity @ R)
    return Rates(omega, force + state.gravity, alpha, jerk, jolt)


def rates_after(state: State, segment: ImuSegment, before: Rates) -> Rates:
    """Rates at the end of a segment, where the state is; see `rates_at`."""
    return rates_at(state, state.R_world_imu, segment.gyro[-1], segment.accel[-1], segment.trend, before)
