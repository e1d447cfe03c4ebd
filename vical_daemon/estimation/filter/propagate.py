"""How inertial readings move the motion and its spread: by sigma points, or derivatives where these agree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuSegment
from vical_daemon.estimation.inertial.imu_model import (
    Influence,
    Motion,
    Strapdown,
    compose,
    influence,
    strapdown,
)
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model import unscented
from vical_daemon.estimation.model.imu_scale import by_apart, by_entries
from vical_daemon.estimation.model.retract import motion_points
from vical_daemon.estimation.model.state import (
    ATTITUDE,
    BIASES,
    GRAVITY,
    POSITION,
    VELOCITY,
    Layout,
    State,
    grp_from_rotation,
    rotation_from_grp,
)


class Propagated(NamedTuple):
    """Motion at the end of a segment.

    Attributes:
        R, p, v: Mean.
        linear: F S of [attitude, position, velocity], shape (9, n).
        curved: Square root of the second-order covariance, shape (9, k); k = 0 by derivatives.
        influence: What errors of the readings do to it.
        slopes: Of itself by the motion at the start and constant biases, shape (9, 15).
        seconds: Length of the segment.
    """

    R: FloatArray
    p: FloatArray
    v: FloatArray
    linear: FloatArray
    curved: FloatArray
    influence: Influence
    slopes: FloatArray
    seconds: float


def move_by_sigma_points(state: State, layout: Layout, S: FloatArray, segment: ImuSegment) -> Propagated:
    """Statistical linearisation of the strapdown equations over a segment; S: rows of the dynamic errors."""
    L = unscented.lower_root(S)
    points = motion_points(state, layout, unscented.offsets(L))
    relative = strapdown(
        segment,
        points.gyro_bias,
        points.accel_bias,
        points.gyro_matrix,
        points.accel_matrix,
        points.accel_lag_s,
        points.accel_positions,
    )
    end = compose(Motion(points.R, points.p, points.v), relative, points.gravity)
    values = np.concatenate(
        [grp_from_rotation(end.R[0].T @ end.R[1:]), end.p[1:] - end.p[0], end.v[1:] - end.v[0]], axis=1
    )
    m = unscented.moments(values)
    errors = influence(state.R_world_imu, relative)
    return Propagated(
        end.R[0] @ rotation_from_grp(m.shift[ATTITUDE]),
        end.p[0] + m.shift[POSITION],
        end.v[0] + m.shift[VELOCITY],
        m.linear @ unscented.solve_lower(L, S),
        m.curved,
        errors,
        motion_slopes(state, relative, errors),
        float(relative.t_s[-1]),
    )


def motion_slopes(state: State, relative: Strapdown, errors: Influence) -> FloatArray:
    """Derivatives of the motion at the end by that at the start and by constant biases, shape (9, 15)."""
    T = float(relative.t_s[-1])
    F = np.zeros((9, BIASES.stop))
    hats = so3.hat(np.array([relative.dp[0, -1], relative.dv[0, -1]]))
    F[ATTITUDE, ATTITUDE] = relative.dR[0, -1].T
    F[POSITION, ATTITUDE], F[VELOCITY, ATTITUDE] = -state.R_world_imu @ hats
    F[POSITION, POSITION] = F[VELOCITY, VELOCITY] = so3.IDENTITY
    F[POSITION, VELOCITY] = T * so3.IDENTITY
    F[:, BIASES] = errors.by_bias()
    return F


def move_by_derivatives(state: State, layout: Layout, S: FloatArray, segment: ImuSegment) -> Propagated:
    """The same to first order about the nominal state."""
    entries = layout.gyro_matrix is not None and layout.accel_matrix is not None
    M_g, M_a = (state.gyro_matrix[None], state.accel_matrix[None]) if entries else (None, None)
    lag_s = None if layout.accel_lag is None else np.array([state.accel_lag_s])
    positions_m = None if layout.accel_positions is None else state.accel_positions[None]
    relative = strapdown(segment, state.gyro_bias[None], state.accel_bias[None], M_g, M_a, lag_s, positions_m)
    T = float(relative.t_s[-1])
    dR, dv, dp = relative.dR[0, -1], relative.dv[0, -1], relative.dp[0, -1]
    R, g = state.R_world_imu, state.gravity
    errors = influence(R, relative)
    F = np.zeros((9, len(S)))
    F[:, : BIASES.stop] = motion_slopes(state, relative, errors)
    F[POSITION, GRAVITY], F[VELOCITY, GRAVITY] = (0.5 * T * T) * so3.IDENTITY, T * so3.IDENTITY
    if layout.gyro_matrix is not None and layout.accel_matrix is not None:
        readings = np.concatenate([segment.gyro - state.gyro_bias, segment.accel - state.accel_bias], axis=1)
        by = by_entries(errors, readings, state.gyro_matrix, state.accel_matrix)
        F[:, BIASES], F[:, layout.gyro_matrix.start : layout.accel_matrix.stop] = by[:, :6], by[:, 6:]
    if layout.accel_positions is not None and relative.felt is not None:
        F[:, layout.accel_positions] = by_apart(errors, relative.felt)
    if layout.accel_lag is not None and segment.accel_slope is not None:
        F[:, layout.accel_lag] = errors.by_force(segment.accel_slope @ state.accel_matrix.T)
    return Propagated(
        R @ dR,
        state.p_world_imu + T * state.v_world_imu + (0.5 * T * T) * g + R @ dp,
        state.v_world_imu + T * g + R @ dv,
        F @ S,
        np.zeros((9, 0)),
        errors,
        F[:, : BIASES.stop],
        T,
    )
