"""How an IMU differs from an ideal one, as numbers: matrices, positions of the accelerometer's axes, lag.

omega = M_g (omega_m - b_g), f = M_a (f_m - b_a). Of M_a only the lower triangle: a full matrix could be
traded against the mounting of the camera. Entries are those of M_g - I, row by row, and of M_a - I.
An axis of the accelerometer at r measures alpha x r + omega x (omega x r) besides the force at the origin
("size effect") [Rehder et al., "Extending kalibr", 2016]. The origin is the mean of the three positions: what
they have in common could be traded against the lever arm of the camera.
The lag, s, is the last number: by how much the accelerometer is later than the gyro.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.inertial.imu_model import Influence
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import LOWER, LOWER_FLAT, State

ENTRIES = 9 + len(LOWER)  # of the matrices of gyro (9) and accelerometer (6, lower triangle)
APART = slice(ENTRIES, -1)  # m, positions of the accelerometer's axes; none without a start
NUMBERS = ENTRIES + 6 + 1  # matrices, positions, lag
# Positions of three axes whose mean is zero, by two vectors; orthonormal, so that no axis is special.
_SPREAD = np.array([[1.0, 1.0], [-1.0, 1.0], [0.0, -2.0]]) / np.sqrt([2.0, 6.0])


def numbers_of(state: State) -> FloatArray:
    """Those of a state, with positions, shape (22,)."""
    gyro, accel = state.gyro_matrix - np.eye(3), state.accel_matrix - np.eye(3)
    entries = gyro.ravel(), accel[LOWER[:, 0], LOWER[:, 1]]
    return np.concatenate([*entries, apart_of(state.accel_positions), [state.accel_lag_s]])


def apart_of(positions: FloatArray) -> FloatArray:
    """The six numbers of the positions of axes x, y, z, m, shape (3, 3), without what they have in common."""
    return np.asarray((_SPREAD.T @ positions).ravel())


def positions_m(apart: FloatArray) -> FloatArray:
    """Positions of axes x, y, z, m, shape (..., 3, 3), of their six numbers (..., 6)."""
    return np.asarray(_SPREAD @ apart.reshape(*apart.shape[:-1], 2, 3))


def matrices(numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
    """M_g and M_a (..., 3, 3) of their entries (..., 15), which others may follow; identity without any."""
    gyro, accel = (np.zeros((*numbers.shape[:-1], 3, 3)) + np.eye(3) for _ in range(2))
    if numbers.shape[-1]:
        gyro += numbers[..., :9].reshape(gyro.shape)
        accel[..., LOWER[:, 0], LOWER[:, 1]] += numbers[..., 9:ENTRIES]
    return gyro, accel


def by_apart(errors: Influence, felt: FloatArray) -> FloatArray:
    """Derivatives of the end of a segment by the six numbers of the positions, shape (9, 6).

    Args:
        errors: What errors of rate and force do to the end.
        felt: `size_effect` at each reading, shape (n + 1, 3, 3).
    """
    force = (-errors.weights[:, None, None] * felt)[:, :, None] * _SPREAD[:, :, None]  # node, axis, number
    return np.asarray(errors.at[:, :, 3:6].transpose(1, 0, 2).reshape(9, -1) @ force.reshape(-1, 6))


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
