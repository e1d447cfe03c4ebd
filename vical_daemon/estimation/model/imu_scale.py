"""Scale and misalignment of an IMU as fifteen numbers, and the lag of its accelerometer as the sixteenth.

omega = M_g (omega_m - b_g), f = M_a (f_m - b_a). Of M_a only the lower triangle: a full matrix could be
traded against the mounting of the camera. Entries are those of M_g - I, row by row, and of M_a - I.
The lag, s, is by how much the accelerometer is later than the gyro.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.inertial.imu_model import Influence
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import LOWER, LOWER_FLAT, State

ENTRIES = 15  # of the matrices of gyro (9) and accelerometer (6, lower triangle)
NUMBERS = ENTRIES + 1  # and the accelerometer's lag


def numbers_of(state: State) -> FloatArray:
    """Those of a state, shape (16,)."""
    gyro, accel = state.gyro_matrix - np.eye(3), state.accel_matrix - np.eye(3)
    return np.concatenate([gyro.ravel(), accel[LOWER[:, 0], LOWER[:, 1]], [state.accel_lag_s]])


def matrices(numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
    """M_g and M_a (..., 3, 3) of their entries (..., 15), which the lag may follow; identity without any."""
    gyro, accel = (np.zeros((*numbers.shape[:-1], 3, 3)) + np.eye(3) for _ in range(2))
    if numbers.shape[-1]:
        gyro += numbers[..., :9].reshape(gyro.shape)
        accel[..., LOWER[:, 0], LOWER[:, 1]] += numbers[..., 9:ENTRIES]
    return gyro, accel


def by_entries(
    errors: Influence,
    readings: FloatArray,
    gyro_matrix: FloatArray,
    accel_matrix: FloatArray,
) -> FloatArray:
    """Derivatives of the end of a segment by biases and entries.

    An error of M_g acts as an error of the rate, dM_g (omega_m - b_g), at each reading; one of the bias as
    -M_g db_g; the accelerometer alike. (tested against differences)

    Args:
        errors: What errors of rate and force do to the end.
        readings: [gyro, accel] without the biases, rad/s and m/s^2, shape (n + 1, 6).
        gyro_matrix: M_g in force.
        accel_matrix: M_a in force.

    Returns:
        By [bias 6, entries 15], rows as in `Influence`, shape (9, 21).
    """
    weighted = errors.weights[:, None] * readings
    both = (errors.at.reshape(-1, 54).T @ weighted).reshape(9, 6, 6)  # end, error of rate or force, reading
    out, by_bias = np.empty((9, 6 + ENTRIES)), errors.by_bias()
    out[:, :3], out[:, 3:6] = by_bias[:, :3] @ gyro_matrix, by_bias[:, 3:] @ accel_matrix
    out[:, 6:15] = both[:, :3, :3].reshape(9, 9)
    out[:, 15:] = both[:, 3:, 3:].reshape(9, 9)[:, LOWER_FLAT]
    return out
