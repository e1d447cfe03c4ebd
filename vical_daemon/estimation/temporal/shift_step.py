"""A step of the time shift, with the mounting known: where do the camera's orientations fit the gyro's curve?

Camera and gyro trace one curve in the rotation group; with the mounting known, only the time shift and the
rotation between the two worlds are free. [docs/math/td_icp.md]
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from vical_daemon.estimation import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.temporal.rotation_curves import RotationCurve

_GRID_S = 5e-3  # a turn of 2 rad/s is 0.6 deg off there: well inside the basin of the fit
_LEAST_IMAGES = 8
_FITS_P = 1e-6  # chance that orientations which fit are said not to
_MISFIT = 4.0  # times the sum of squares that noise gives: orientations from corners err by the lens, too
_SURE = 25.0  # of the sum of squares: five sigma
_APART_S = 0.05  # other places on the curve begin so far from the best


class ShiftFit(NamedTuple):
    """Where the camera's orientations fit.

    Attributes:
        timeshift_s: t_imu = t_cam + shift, s.
        sigma_s: Of it.
        stepped: The time shift so far fits worse, beyond five sigma.
    """

    timeshift_s: float
    sigma_s: float
    stepped: bool


def find_shift(
    curve: RotationCurve,
    t_cam_s: FloatArray,
    R_world_cam: FloatArray,
    sigma_rad: FloatArray,
    R_imu_cam: FloatArray,
    present_s: float,
    most_s: float,
) -> ShiftFit | None:
    """Find the one time shift at which the orientations of camera and gyro agree.

    Args:
        curve: The gyro's, about its bias.
        t_cam_s: Stamps of the camera's orientations, s, shape (n,).
        R_world_cam: Orientations, shape (n, 3, 3).
        sigma_rad: Their noise about each axis, shape (n,).
        R_imu_cam: The mounting, held, shape (3, 3).
        present_s: Time shift so far, s.
        most_s: Largest step looked for, s.

    Returns:
        The fit; None where none fits, more than one does, or the curve does not reach.
    """
    if len(t_cam_s) < _LEAST_IMAGES:
        return None
    low_s = max(present_s - most_s, curve.span_s[0] - float(t_cam_s[0]))
    high_s = min(present_s + most_s, curve.span_s[1] - float(t_cam_s[-1]))
    if not low_s <= present_s <= high_s:
        return None

    def errors(shifts_s: FloatArray) -> FloatArray:
        """Whitened errors of all orientations, the two worlds aligned at each shift, shape (k, 3 n)."""
        by_gyro = so3.matrix_from_quat(curve.quaternion(t_cam_s + shifts_s[:, None])) @ R_imu_cam
        weighed = by_gyro / np.square(sigma_rad)[:, None, None]
        align = _nearest_rotation(np.einsum("nij,knlj->kil", R_world_cam, weighed))
        missed = np.swapaxes(align[:, None] @ by_gyro, -1, -2) @ R_world_cam
        return np.asarray((so3.log(missed) / sigma_rad[:, None]).reshape(len(shifts_s), -1))

    grid = np.append(np.arange(low_s, high_s, _GRID_S), present_s)
    cost = (errors(grid) ** 2).sum(axis=1)
    shift_s = float(grid[np.argmin(cost)])
    step_s = 1e-4
    for _ in range(5):
        at, ahead = errors(np.array([shift_s, shift_s + step_s]))
        slope = (ahead - at) / step_s
        curvature = float(slope @ slope)
        if curvature <= 0.0:
            return None
        shift_s -= float(slope @ at) / curvature
    if not low_s <= shift_s <= high_s:
        return None
    best = float((errors(np.array([shift_s])) ** 2).sum())
    elsewhere = cost[:-1][np.abs(grid[:-1] - shift_s) > _APART_S]
    dof = 3 * len(t_cam_s) - 4
    level = max(best / dof, 1.0)
    if best > _MISFIT * float(chdtri(dof, _FITS_P)):
        return None
    sure = best + _SURE * level
    if float(elsewhere.min(initial=np.inf)) < sure:
        return None
    return ShiftFit(shift_s, float(np.sqrt(level / curvature)), float(cost[-1]) > sure)


def _nearest_rotation(M: FloatArray) -> FloatArray:
    """Rotations that maximise trace(R' M), shape (k, 3, 3)."""
    U, _, Vt = np.linalg.svd(M)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    return np.asarray(U @ Vt)
