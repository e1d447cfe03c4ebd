"""Motion as a linear function of the unknowns of a start: velocity, gravity, lever arm, accelerometer bias.

With attitudes and the gyro's bias known, from images of a target or from the gyro, a camera on the imu is at

    p_cam(t_k) = p_0 + D_k + A_k z,   z = (v_0, gravity, p_imu_cam, b_a),

with D_k the double integral of the rotated specific force, and A_k = [T, T^2/2, R_k, -B_k], B_k the double
integral of the rotation. All starts solve parts of this for z: with a target (here), without one
(`track_start`), after a gap (`motion_restart`), for another recording. [Dong-Si and
Mourikis, "Estimator initialization in vision-aided inertial navigation with unknown camera-IMU calibration",
2012]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from vical_daemon.estimation.filter.unobservable_directions import HELD_M, STILL_RAD
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.imu_model import over_intervals, strapdown
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import ACCEL_BIAS_SIGMA_MPS2

LEAST_IMAGES = 3  # two intervals: with one, no acceleration shows
SPEED, GRAVITY, ARM, BIAS = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
"""Places in z."""


class LinearMotion(NamedTuple):
    """Positions that are linear in z.

    Attributes:
        T: Instants since the first, s, shape (n,).
        D: Double integral of the specific force, m, shape (n, 3).
        A: Derivatives of the positions by z, shape (n, 3, 12).
    """

    T: FloatArray
    D: FloatArray
    A: FloatArray

    @classmethod
    def between(
        cls, buffer: ImuBuffer, t_s: FloatArray, R_world_imu: FloatArray, gyro_bias: FloatArray
    ) -> LinearMotion | None:
        """Integrate readings between instants of the imu's clock (s, increasing, shape (n,)).

        Args:
            buffer: Inertial readings.
            t_s: Instants.
            R_world_imu: Attitudes there, shape (n, 3, 3).
            gyro_bias: rad/s.

        Returns:
            The motion, or None where readings do not cover the instants.
        """
        found = buffer.intervals(t_s)
        if found is None:
            return None
        segment, begin = found
        x = over_intervals(strapdown(segment, gyro_bias[None], np.zeros((1, 3))), begin)
        return cls.along(R_world_imu, x.dt, x.dR, x.dv, x.dp)

    @classmethod
    def along(
        cls, R: FloatArray, dt: FloatArray, dR: FloatArray, dv: FloatArray, dp: FloatArray
    ) -> LinearMotion:
        """Add up relative motions, see `Intervals`, between attitudes (n, 3, 3)."""
        # Half of the attitude mismatch at the far end is put at the near one: errors of vision do not add up.
        near = R[:-1] @ so3.exp(0.5 * so3.log(np.swapaxes(R[:-1] @ dR, 1, 2) @ R[1:]))
        middle = near @ so3.exp(0.5 * so3.log(dR))
        forces = np.matmul(near, np.stack([dv, dp], axis=-1))
        h = dt[:, None, None]
        D = _summed(dt, forces[..., 0], forces[..., 1])
        B = _summed(dt, (h * middle).reshape(-1, 9), (0.5 * h * h * middle).reshape(-1, 9))
        T = np.concatenate([[0.0], np.cumsum(dt)])
        A = np.empty((len(T), 3, 12))
        A[:, :, SPEED], A[:, :, ARM], A[:, :, BIAS] = T[:, None, None] * so3.IDENTITY, R, -B.reshape(-1, 3, 3)
        A[:, :, GRAVITY] = (0.5 * T * T)[:, None, None] * so3.IDENTITY
        return cls(T, D, A)


def _summed(dt: FloatArray, gained: FloatArray, moved: FloatArray) -> FloatArray:
    """Positions (n, k) by what speed (n - 1, k) and position gain in each interval."""
    speed = np.cumsum(gained, axis=0) - gained
    return np.concatenate([np.zeros((1, gained.shape[1])), np.cumsum(dt[:, None] * speed + moved, axis=0)])


@dataclass(frozen=True, slots=True)
class LinearStart:
    """Result of `linear_start` (world = target frame).

    Attributes:
        p_world_cam: Position at the first pose, m, shape (3,); of the imu where the lever arm was zero.
        v_world_imu: Velocity of the imu there, m/s.
        gravity: Acceleration of free fall, m/s^2; as found, it does not have the right length yet.
        p_imu_cam: Lever arm, m, shape (3,).
        accel_bias: m/s^2.
        size: True size of the target over the stated one; 1 where that was not asked for.
        sigma_size: Its standard deviation; 0 likewise.
    """

    p_world_cam: FloatArray
    v_world_imu: FloatArray
    gravity: FloatArray
    p_imu_cam: FloatArray
    accel_bias: FloatArray
    size: float = 1.0
    sigma_size: float = 0.0


def linear_start(
    motion: LinearMotion,
    p_world_cam: FloatArray,
    position_sigma: FloatArray,
    *,
    unknown: Sequence[slice] = (SPEED, GRAVITY, ARM, BIAS),
    known: FloatArray | None = None,
    held_axes: FloatArray | None = None,
    free_size: bool = False,
    force_sigma: float = 0.0,
) -> LinearStart:
    """Solve velocity, gravity, lever arm and accelerometer bias, or some of them, from positions.

    Args:
        motion: At the instants of the positions, with attitudes by vision (mounting from TD-ICP).
        p_world_cam: Camera positions, m, shape (n, 3); of the imu, where its lever arm is taken as zero.
        position_sigma: Standard deviation of each, m, shape (n,).
        unknown: Parts of z that are unknown, in their order.
        known: z, where it is known; the accelerometer bias is known to its prior in any case; None: zeros.
        held_axes: Of the imu, along which the lever arm is held at zero, shape (k, 3): where an axis hardly
            turns (`still_axes`), errors of the attitudes would be taken for a lever arm along it.
        free_size: Find the size of the target, too. Noise of positions that are scaled by it would make it
            small; so its inverse scales the integrals of the readings.
        force_sigma: Of the acceleration at each instant, m/s^2: gravity times the error of an attitude.
    """
    n, z = len(p_world_cam), np.zeros(12) if known is None else known.copy()
    free = np.concatenate([np.arange(12)[part] for part in unknown])
    fixed = np.setdiff1d(np.arange(12), free)
    columns = [motion.A[:, :, free], np.broadcast_to(np.eye(3), (n, 3, 3))]  # z and p_0
    columns += [motion.D[:, :, None]] if free_size else []
    A = np.concatenate(columns, axis=2)
    left = p_world_cam - (0.0 if free_size else motion.D) - motion.A[:, :, fixed] @ z[fixed]
    noise = np.diag(position_sigma**2) + drift_covariance(motion.T, force_sigma)
    both = np.concatenate([A, left[:, :, None]], axis=2)
    white = solve_triangular(np.linalg.cholesky(noise), both.reshape(n, -1), lower=True).reshape(3 * n, -1)
    rows, y = white[:, :-1], white[:, -1]
    prior = np.zeros((6, 12))
    prior[:3, BIAS] = np.eye(3) / ACCEL_BIAS_SIGMA_MPS2
    if held_axes is not None:
        prior[3:, ARM] = held_axes.T @ held_axes / HELD_M
    A_all = np.vstack([rows, np.zeros((6, A.shape[2]))])
    A_all[-6:, : len(free)] = prior[:, free]
    x, *_ = np.linalg.lstsq(A_all, np.concatenate([y, prior[:, free] @ z[free]]), rcond=None)
    k, size = len(free), (1.0, 0.0)
    if free_size:  # all of x is in stated sizes: the integrals times 1/s
        variance = max(float(np.mean((y - rows @ x) ** 2)), 1.0)
        sigma = float(np.sqrt(variance * np.linalg.pinv(A_all.T @ A_all)[-1, -1]))
        s = 1.0 / float(x[-1])
        x, size = x * s, (s, sigma * s * s)
    z[free] = x[:k]
    return LinearStart(x[k : k + 3], z[SPEED], z[GRAVITY], z[ARM], z[BIAS], *size)


def drift_covariance(T: FloatArray, force_sigma: float) -> FloatArray:
    """Covariance of positions that drift with white errors of the acceleration, by axis, m^2, shape (n, n).

    With the density q^2 = sigma^2 dt the double integral has the covariance q^2 s^2 (3 t - s) / 6 at s <= t.

    Args:
        T: Instants since the first, s, shape (n,).
        force_sigma: Of the acceleration at each, m/s^2.
    """
    near, far = np.minimum(T[:, None], T), np.maximum(T[:, None], T)
    density = force_sigma**2 * T[-1] / max(len(T) - 1, 1)
    return np.asarray(density * near**2 * (3.0 * far - near) / 6.0)


def still_axes(mean_R_world_imu: FloatArray) -> FloatArray:
    """Axes of the imu that kept their direction, from the mean of its attitudes (3, 3); shape (k, 3).

    A unit axis a that turns by small angles of RMS s has a mean R a of squared length 1 - s^2.
    """
    moved, axes = np.linalg.eigh(np.eye(3) - mean_R_world_imu.T @ mean_R_world_imu)
    still: FloatArray = axes[:, moved < STILL_RAD**2].T
    return still
