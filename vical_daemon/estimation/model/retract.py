"""Apply errors to the state: one at a time (`retract`) and a whole set of sigma points at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.inertial.imu_model import Motion
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.imu_scale import apart_of, positions_m
from vical_daemon.estimation.model.state import (
    ACCEL_BIAS,
    ATTITUDE,
    GRAVITY,
    GYRO_BIAS,
    LOWER,
    LOWER_FLAT,
    POSITION,
    VELOCITY,
    CameraSlices,
    CameraState,
    Layout,
    State,
    gravity_difference,
    grp_from_rotation,
    moved_gravity,
    rotation_from_grp,
    rotation_of_grp,
)


class MotionPoints(NamedTuple):
    """Sigma points of what moves the imu; batch of S (see `State` for meanings and units)."""

    R: FloatArray
    p: FloatArray
    v: FloatArray
    gyro_bias: FloatArray
    accel_bias: FloatArray
    gravity: FloatArray
    gyro_matrix: FloatArray | None
    accel_matrix: FloatArray | None
    accel_positions: FloatArray | None = None
    accel_lag_s: FloatArray | None = None


class CameraPoints(NamedTuple):
    """Sigma points of one camera; batch of S."""

    R_imu_cam: FloatArray
    p_imu_cam: FloatArray
    timeshift_s: FloatArray
    intrinsics: FloatArray
    distortion: FloatArray
    readout_s: FloatArray


def motion_points(state: State, layout: Layout, errors: FloatArray) -> MotionPoints:
    """Apply errors (S, >= dynamic) to the motion, biases, gravity and imu matrices."""
    gyro_matrix = accel_matrix = None
    if layout.gyro_matrix is not None and layout.accel_matrix is not None:
        gyro_matrix = state.gyro_matrix + errors[:, layout.gyro_matrix].reshape(-1, 3, 3)
        accel_matrix = np.repeat(state.accel_matrix[None], len(errors), axis=0)
        accel_matrix[:, LOWER[:, 0], LOWER[:, 1]] += errors[:, layout.accel_matrix]
    positions = None
    if layout.accel_positions is not None:
        positions = state.accel_positions + positions_m(errors[:, layout.accel_positions])
    return MotionPoints(
        state.R_world_imu @ rotation_from_grp(errors[:, ATTITUDE]),
        state.p_world_imu + errors[:, POSITION],
        state.v_world_imu + errors[:, VELOCITY],
        state.gyro_bias + errors[:, GYRO_BIAS],
        state.accel_bias + errors[:, ACCEL_BIAS],
        moved_gravity(state.gravity, errors[:, GRAVITY]),
        gyro_matrix,
        accel_matrix,
        positions,
        None if layout.accel_lag is None else state.accel_lag_s + errors[:, layout.accel_lag],
    )


def pose_points(state: State, errors: FloatArray) -> Motion:
    """Apply errors (S, >= 9) to attitude, position and velocity only (what an image depends on)."""
    return Motion(
        state.R_world_imu @ rotation_from_grp(errors[:, ATTITUDE]),
        state.p_world_imu + errors[:, POSITION],
        state.v_world_imu + errors[:, VELOCITY],
    )


def camera_points(camera: CameraState, layout: Layout, name: str, errors: FloatArray) -> CameraPoints:
    """Apply errors (S, n) to one camera; what is not estimated keeps a batch of 1 and broadcasts."""
    where = layout.cameras[name]
    R, p = camera.R_imu_cam[None], camera.p_imu_cam[None]
    shift, readout = np.array([camera.timeshift_s]), np.array([camera.readout_s])
    K, D = camera.intrinsics[None], camera.distortion[None]
    if where.rotation is not None and where.position is not None:
        R = R @ rotation_from_grp(errors[:, where.rotation])
        p = p + errors[:, where.position]
    if where.timeshift is not None:
        shift = shift + errors[:, where.timeshift]
    if where.intrinsics is not None and where.distortion is not None:
        K = K + errors[:, where.intrinsics]
        D = D + errors[:, where.distortion]
    if where.readout is not None:
        readout = readout + errors[:, where.readout]
    return CameraPoints(R, p, shift, K, D, readout)


def retract(state: State, layout: Layout, dx: FloatArray) -> State:
    """Return the state moved by one error vector, shape (n,). The argument is not changed."""
    gyro_matrix, accel_matrix = state.gyro_matrix, state.accel_matrix
    if layout.gyro_matrix is not None and layout.accel_matrix is not None:
        gyro_matrix = gyro_matrix + dx[layout.gyro_matrix].reshape(3, 3)
        accel_matrix = accel_matrix.copy()
        accel_matrix.ravel()[LOWER_FLAT] += dx[layout.accel_matrix]
    positions = state.accel_positions
    if layout.accel_positions is not None:
        positions = positions + positions_m(dx[layout.accel_positions])
    lag_s = state.accel_lag_s
    if layout.accel_lag is not None:
        lag_s += float(dx[layout.accel_lag])
    scale = state.target_scale
    if layout.target_scale is not None:
        scale += float(dx[layout.target_scale])
    shape = state.target_shape
    if layout.target_shape is not None:
        shape = shape + dx[layout.target_shape]
    return State(
        state.t_s,
        orthonormal(state.R_world_imu @ rotation_of_grp(dx[ATTITUDE])),
        state.p_world_imu + dx[POSITION],
        state.v_world_imu + dx[VELOCITY],
        state.gyro_bias + dx[GYRO_BIAS],
        state.accel_bias + dx[ACCEL_BIAS],
        moved_gravity(state.gravity, dx[GRAVITY]),
        {name: moved_camera(camera, layout.cameras[name], dx) for name, camera in state.cameras.items()},
        gyro_matrix,
        accel_matrix,
        positions,
        lag_s,
        scale,
        shape,
    )


def difference(state: State, origin: State, layout: Layout) -> FloatArray:
    """Errors that move `origin` to `state`, shape (n,): the inverse of `retract`."""
    dx = np.zeros(layout.size)
    dx[ATTITUDE] = grp_from_rotation(origin.R_world_imu.T @ state.R_world_imu)
    dx[POSITION], dx[VELOCITY] = (
        state.p_world_imu - origin.p_world_imu,
        state.v_world_imu - origin.v_world_imu,
    )
    dx[GYRO_BIAS], dx[ACCEL_BIAS] = state.gyro_bias - origin.gyro_bias, state.accel_bias - origin.accel_bias
    dx[GRAVITY] = gravity_difference(state.gravity, origin.gravity)
    if layout.gyro_matrix is not None and layout.accel_matrix is not None:
        dx[layout.gyro_matrix] = (state.gyro_matrix - origin.gyro_matrix).ravel()
        dx[layout.accel_matrix] = (state.accel_matrix - origin.accel_matrix)[LOWER[:, 0], LOWER[:, 1]]
    if layout.accel_positions is not None:
        dx[layout.accel_positions] = apart_of(state.accel_positions - origin.accel_positions)
    if layout.accel_lag is not None:
        dx[layout.accel_lag] = state.accel_lag_s - origin.accel_lag_s
    if layout.target_scale is not None:
        dx[layout.target_scale] = state.target_scale - origin.target_scale
    if layout.target_shape is not None:
        dx[layout.target_shape] = state.target_shape - origin.target_shape
    for name, where in layout.cameras.items():
        dx += camera_difference(state.cameras[name], origin.cameras[name], where, layout.size)
    return dx


def camera_difference(camera: CameraState, origin: CameraState, where: CameraSlices, size: int) -> FloatArray:
    """Errors that move `origin` to `camera`, zero elsewhere, shape (size,): the inverse of `moved_camera`."""
    dx = np.zeros(size)
    if where.rotation is not None and where.position is not None:
        dx[where.rotation] = grp_from_rotation(origin.R_imu_cam.T @ camera.R_imu_cam)
        dx[where.position] = camera.p_imu_cam - origin.p_imu_cam
    if where.timeshift is not None:
        dx[where.timeshift] = camera.timeshift_s - origin.timeshift_s
    if where.skew is not None:
        dx[where.skew] = camera.skew - origin.skew
    if where.intrinsics is not None and where.distortion is not None:
        dx[where.intrinsics] = camera.intrinsics - origin.intrinsics
        dx[where.distortion] = camera.distortion - origin.distortion
    if where.readout is not None:
        dx[where.readout] = camera.readout_s - origin.readout_s
    return dx


def moved_camera(camera: CameraState, where: CameraSlices, dx: FloatArray) -> CameraState:
    """Return the camera moved by its errors in `dx`, shape (n,). The argument is not changed."""
    R, p, K, D = camera.R_imu_cam, camera.p_imu_cam, camera.intrinsics, camera.distortion
    shift, readout, skew = camera.timeshift_s, camera.readout_s, camera.skew
    if where.rotation is not None and where.position is not None:
        R, p = orthonormal(R @ rotation_of_grp(dx[where.rotation])), p + dx[where.position]
    if where.timeshift is not None:
        shift += float(dx[where.timeshift])
    if where.skew is not None:
        skew += float(dx[where.skew])
    if where.intrinsics is not None and where.distortion is not None:
        K, D = K + dx[where.intrinsics], D + dx[where.distortion]
    if where.readout is not None:
        readout += float(dx[where.readout])
    model, axis = camera.distortion_model, camera.readout_axis
    return CameraState(R, p, shift, K, D, model, camera.resolution, readout, skew, axis, camera.term)


def orthonormal(R: FloatArray) -> FloatArray:
    """One Newton step towards the nearest rotation, (..., 3, 3): rounding never accumulates."""
    out: FloatArray = 1.5 * R - 0.5 * R @ (R.swapaxes(-1, -2) @ R)
    return out
