"""The start of the filter from the first seconds of data: nothing about the mounting need be known.

Rotations, gyro bias and time shift come from `td_icp`; then velocity, gravity, accelerometer bias and lever
arm are *linear* in the camera's positions (closed form of Dong-Si & Mourikis, "Estimator initialization in
vision-aided inertial navigation with unknown camera-IMU calibration", 2012, with a known target).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.filter.unobservable_directions import HELD_M, STILL_RAD
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.imu_model import strapdown
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import ACCEL_BIAS_SIGMA_MPS2


@dataclass(frozen=True, slots=True)
class LinearStart:
    """Result of `linear_start` (world = target frame).

    Attributes:
        p_imu_cam: Lever arm, m, shape (3,).
        v_world_imu: Velocity of the imu at the first pose, m/s.
        gravity: Acceleration of free fall, m/s^2, as found (not yet of the right length).
        accel_bias: m/s^2.
        sigma_p_imu_cam: Standard deviations, m, shape (3,).
        size: True size of the target over the stated one; 1 where that was not asked for.
        sigma_size: Its standard deviation; 0 likewise.
    """

    p_imu_cam: FloatArray
    v_world_imu: FloatArray
    gravity: FloatArray
    accel_bias: FloatArray
    sigma_p_imu_cam: FloatArray
    size: float = 1.0
    sigma_size: float = 0.0


def linear_start(
    buffer: ImuBuffer,
    t_imu_s: FloatArray,
    R_world_imu: FloatArray,
    p_world_cam: FloatArray,
    gyro_bias: FloatArray,
    position_sigma: FloatArray,
    held_axes: FloatArray | None = None,
    *,
    free_size: bool = False,
) -> LinearStart | None:
    """Solve velocity, gravity, accelerometer bias and lever arm from poses of the camera.

    s p_cam(t_k) = p_0 + v_0 t + g t^2/2 + D_k - B_k b_a + R_k p_imu_cam, with D_k the double integral of
    the rotated specific force and B_k that of the rotation itself; s is the true size of the target over the
    stated one, by which positions scale, and 1 unless `free_size`.

    Args:
        buffer: Inertial readings that cover all instants.
        t_imu_s: Instants of the poses in the imu's clock, s, increasing, shape (n,).
        R_world_imu: Attitudes at these instants (vision, mounting from TD-ICP), shape (n, 3, 3).
        p_world_cam: Camera positions, m, shape (n, 3).
        gyro_bias: rad/s.
        position_sigma: Standard deviation of each camera position, m, shape (n,).
        held_axes: Of the imu, along which the lever arm is held at zero, shape (k, 3): where an axis hardly
            turns (`still_axes`), errors of the attitudes would be taken for a lever arm along it.
        free_size: Find the size of the target, too.

    Returns:
        The solution, or None where the readings do not cover the instants.
    """
    integrals = integrate_twice(buffer, t_imu_s, R_world_imu, gyro_bias)
    if integrals is None:
        return None
    D, B = integrals
    A = _design(t_imu_s, R_world_imu, p_world_cam, B, free_size=free_size)
    w = 1.0 / position_sigma
    rows = (A * w[:, None, None]).reshape(-1, A.shape[2])
    y = (((0.0 if free_size else p_world_cam) - D) * w[:, None]).ravel()
    prior = np.zeros((6, A.shape[2]))
    prior[:3, 12:15] = np.eye(3) / ACCEL_BIAS_SIGMA_MPS2
    if held_axes is not None:
        prior[3:, 9:12] = held_axes.T @ held_axes / HELD_M
    A_all, y_all = np.vstack([rows, prior]), np.concatenate([y, np.zeros(6)])
    x, *_ = np.linalg.lstsq(A_all, y_all, rcond=None)
    residual = (y - rows @ x).reshape(-1, 3)
    variance = float(np.mean(residual**2))
    cov = np.linalg.pinv(A_all.T @ A_all) * max(variance, 1.0)
    sigma = np.sqrt(np.diag(cov))
    size, sigma_size = (float(x[15]), float(sigma[15])) if free_size else (1.0, 0.0)
    return LinearStart(x[9:12], x[3:6], x[6:9], x[12:15], sigma[9:12], size, sigma_size)


def _design(
    t_s: FloatArray, R_world_imu: FloatArray, p_world_cam: FloatArray, B: FloatArray, *, free_size: bool
) -> FloatArray:
    """Derivatives of the camera's positions by [p_0, v_0, g, p_imu_cam, b_a (, s)], (n, 3, 15 or 16)."""
    T, eye = t_s - t_s[0], np.eye(3)
    A = np.zeros((len(T), 3, 15 + free_size))
    A[:, :, 0:3] = eye
    A[:, :, 3:6] = T[:, None, None] * eye
    A[:, :, 6:9] = (0.5 * T * T)[:, None, None] * eye
    A[:, :, 9:12] = R_world_imu
    A[:, :, 12:15] = -B
    if free_size:
        A[:, :, 15] = -p_world_cam
    return A


def still_axes(mean_R_world_imu: FloatArray) -> FloatArray:
    """Axes of the imu that kept their direction, from the mean of its attitudes (3, 3); shape (k, 3).

    A unit axis a that turns by small angles of RMS s has a mean R a of squared length 1 - s^2.
    """
    moved, axes = np.linalg.eigh(np.eye(3) - mean_R_world_imu.T @ mean_R_world_imu)
    still: FloatArray = axes[:, moved < STILL_RAD**2].T
    return still


def integrate_twice(
    buffer: ImuBuffer, t_s: FloatArray, R_world_imu: FloatArray, gyro_bias: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return double integrals D (n, 3) of R f and B (n, 3, 3) of R, re-anchored to vision at each pose.

    None where readings do not cover the instants.
    """
    n = len(t_s)
    D, B = np.zeros((n, 3)), np.zeros((n, 3, 3))
    Vd, Vb = np.zeros(3), np.zeros((3, 3))
    zero = np.zeros((1, 3))
    for k in range(n - 1):
        segment = buffer.segment(float(t_s[k]), float(t_s[k + 1]))
        if segment is None:
            return None
        relative = strapdown(segment, gyro_bias[None], zero)
        dt = float(t_s[k + 1] - t_s[k])
        # Half of the attitude mismatch at the far end is put at the near one: errors of vision do not add up.
        miss = so3.log(relative.dR[0, -1].T @ R_world_imu[k].T @ R_world_imu[k + 1])
        R = R_world_imu[k] @ so3.exp(0.5 * miss)
        turning = R @ so3.exp(0.5 * so3.log(relative.dR[0, -1]))
        D[k + 1] = D[k] + Vd * dt + R @ relative.dp[0, -1]
        B[k + 1] = B[k] + Vb * dt + turning * (0.5 * dt * dt)
        Vd = Vd + R @ relative.dv[0, -1]
        Vb = Vb + turning * dt
    return D, B
