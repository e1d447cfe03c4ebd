"""Measurement model: where the points of a target appear, for a whole set of sigma points at once.

uv = project( R_imu_cam^T ( R_world_imu(t + shift)^T (X - p_world_imu(t + shift)) - p_imu_cam ) )
with the motion moved from the state's instant by d = t_cam + shift - t_state:
R Exp(omega d), p + v d + a d^2 / 2. [docs/math/filter.md, eq. (7)]
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import project
from vical_daemon.estimation.inertial.imu_model import Motion
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.rates import Rates
from vical_daemon.estimation.model.retract import CameraPoints


def moved(motion: Motion, rates: Rates, delay_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return attitude and position `delay_s` later; delay shape (S,) or (1,)."""
    d = delay_s[:, None]
    R = motion.R @ so3.exp(rates.omega * d + (0.5 * d * d) * rates.alpha)
    p = motion.p + motion.v * d + (0.5 * d * d) * rates.accel
    return R, p


def view(
    points: FloatArray,
    motion: Motion,
    camera: CameraPoints,
    rates: Rates,
    t_cam_minus_state_s: float,
    model: str,
    rows: FloatArray | None = None,
) -> FloatArray:
    """Project target points for a batch of states.

    Args:
        points: Points in the world, m, shape (n, 3) or (S, n, 3).
        motion: Sigma points of the motion, batch S.
        camera: Sigma points of the camera, batch S or 1.
        rates: Rates at the state's instant.
        t_cam_minus_state_s: Image stamp (camera clock) minus the state's instant (imu clock), s.
        model: radtan or equidistant.
        rows: For a rolling shutter: (v / height - 1/2) of each point, shape (n,); None: global shutter.

    Returns:
        Pixels, shape (S, n, 2); not-a-number behind the camera.
    """
    R, p = moved(motion, rates, t_cam_minus_state_s + camera.timeshift_s)
    x_imu = np.matmul(points - p[:, None, :], R)
    if rows is not None:
        x_imu = x_imu + _rolling(x_imu, motion, R, rates, camera.readout_s, rows)
    x_cam = np.matmul(x_imu - camera.p_imu_cam[:, None, :], camera.R_imu_cam)
    return project(x_cam, camera.intrinsics[:, None, :], camera.distortion[:, None, :], model)


def _rolling(
    x_imu: FloatArray,
    motion: Motion,
    R: FloatArray,
    rates: Rates,
    readout_s: FloatArray,
    rows: FloatArray,
) -> FloatArray:
    """Displacement in the imu frame of points seen `rows * readout` after the middle row, to third order.

    A point X of the world lies at x = R' (X - p), so that x' = -omega x x - u with u = R' v, and likewise for
    the derivatives of both.
    """
    e = (readout_s[:, None] * rows)[..., None]
    w, alpha = rates.omega, rates.alpha
    u = np.matmul(motion.v[:, None, :], R)
    u1 = np.matmul(rates.accel, R)[:, None, :] - so3.cross(w, u)
    u2 = rates.jolt - so3.cross(alpha, u) - so3.cross(w, u1)
    x1 = -so3.cross(w, x_imu) - u
    x2 = -so3.cross(alpha, x_imu) - so3.cross(w, x1) - u1
    x3 = -so3.cross(rates.jerk, x_imu) - 2.0 * so3.cross(alpha, x1) - so3.cross(w, x2) - u2
    return np.asarray(e * (x1 + (0.5 * e) * (x2 + (e / 3.0) * x3)))
