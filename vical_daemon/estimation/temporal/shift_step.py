"""A step of the time shift, with the mounting known: where do the camera's orientations fit the gyro's curve?

Camera and gyro trace one curve in the rotation group; with the mounting known, only the time shift and the
rotation between the two worlds are free. [docs/math/td_icp.md]
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.significance import LIKELY_SIGMAS, SURE_SIGMAS, chi_square_limit
from vical_daemon.estimation.temporal.rotation_curves import RotationCurve
from vical_daemon.estimation.temporal.rotation_start import GRID_S
from vical_daemon.estimation.temporal.rotation_turns import MIN_PAIRS

_GRID_S = 0.5 * GRID_S  # a turn of 2 rad/s is 0.6 deg off there: well inside the basin of the fit
_STEPS, _DERIVATIVE_S = 5, 1e-4  # Gauss-Newton from the nearest place on the grid
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


class Orientations(NamedTuple):
    """Orientations of a camera.

    Attributes:
        t_cam_s: Stamps, s, shape (n,).
        R_world_cam: In any fixed world, shape (n, 3, 3).
        sigma_rad: Noise about each axis, shape (n,).
    """

    t_cam_s: FloatArray
    R_world_cam: FloatArray
    sigma_rad: FloatArray


def level_at(curve: RotationCurve, seen: Orientations, R_imu_cam: FloatArray, timeshift_s: float) -> float:
    """Sum of squares over its degrees of freedom, of orientations that fit: at least 1; 1 if not covered."""
    t_s = seen.t_cam_s + timeshift_s
    inside = (t_s > curve.span_s[0]) & (t_s < curve.span_s[1])
    if inside.sum() < MIN_PAIRS:
        return 1.0
    e = _errors(curve, Orientations(*(x[inside] for x in seen)), R_imu_cam, np.array([timeshift_s]))
    return max(float((e**2).sum()) / (e.size - 3), 1.0)


def find_shift(
    curve: RotationCurve,
    seen: Orientations,
    R_imu_cam: FloatArray,
    present_s: float,
    most_s: float,
    usual_level: float,
) -> ShiftFit | None:
    """Find the one time shift at which the orientations of camera and gyro agree.

    Args:
        curve: The gyro's, about its bias.
        seen: The camera's orientations.
        R_imu_cam: The mounting, held, shape (3, 3).
        present_s: Time shift so far, s.
        most_s: Largest step looked for, s.
        usual_level: See `level_at`; of orientations from before the change.

    Returns:
        The fit; None where none fits, more than one does, or the curve does not reach.
    """
    t_cam_s = seen.t_cam_s
    if len(t_cam_s) < MIN_PAIRS:
        return None
    low_s = max(present_s - most_s, curve.span_s[0] - float(t_cam_s[0]))
    high_s = min(present_s + most_s, curve.span_s[1] - float(t_cam_s[-1]))
    if not low_s <= present_s <= high_s:
        return None
    grid = np.append(np.arange(low_s, high_s, _GRID_S), present_s)
    cost = (_errors(curve, seen, R_imu_cam, grid) ** 2).sum(axis=1)
    shift_s = float(grid[np.argmin(cost)])
    for _ in range(_STEPS):
        at, ahead = _errors(curve, seen, R_imu_cam, np.array([shift_s, shift_s + _DERIVATIVE_S]))
        slope = (ahead - at) / _DERIVATIVE_S
        curvature = float(slope @ slope)
        if curvature <= 0.0:
            return None
        shift_s -= float(slope @ at) / curvature
    if not grid.min() <= shift_s <= grid.max():
        return None
    best = float((_errors(curve, seen, R_imu_cam, np.array([shift_s])) ** 2).sum())
    dof = 3 * len(t_cam_s) - 4
    if best > usual_level * chi_square_limit(dof, SURE_SIGMAS):
        return None
    sure = best + LIKELY_SIGMAS**2 * usual_level
    if float(cost[:-1][np.abs(grid[:-1] - shift_s) > _APART_S].min(initial=np.inf)) < sure:
        return None
    return ShiftFit(shift_s, float(np.sqrt(usual_level / curvature)), float(cost[-1]) > sure)


def first_after_step(
    curve: RotationCurve, seen: Orientations, R_imu_cam: FloatArray, shifts_s: tuple[float, float]
) -> int | None:
    """Index of the earliest orientation that may be from after a step of the time shift.

    Each place of the step has a sum of squares: those before it at the first time shift, the others at the
    second, with the worlds aligned on either side. All places within six sigma of the best are possible.

    Args:
        curve: The gyro's, about its bias.
        seen: The camera's orientations, in the order of their stamps.
        R_imu_cam: The mounting, held, shape (3, 3).
        shifts_s: Time shift before and after the step, s.

    Returns:
        None where the curve covers too few of the orientations, or not the first.
    """
    t_cam_s = seen.t_cam_s
    covered = t_cam_s + max(shifts_s) < curve.span_s[1]
    if covered.sum() < MIN_PAIRS or t_cam_s[0] + min(shifts_s) < curve.span_s[0]:
        return None
    seen = Orientations(*(x[covered] for x in seen))
    t_cam_s = seen.t_cam_s
    cost = np.zeros(len(t_cam_s))
    for k in range(len(t_cam_s)):
        for part, shift_s in ((slice(k), shifts_s[0]), (slice(k, None), shifts_s[1])):
            if len(t_cam_s[part]):
                one_side = Orientations(*(x[part] for x in seen))
                cost[k] += float((_errors(curve, one_side, R_imu_cam, np.array([shift_s])) ** 2).sum())
    level = max(float(cost.min()) / (3 * len(t_cam_s) - 6), 1.0)
    return int(np.flatnonzero(cost <= cost.min() + SURE_SIGMAS**2 * level)[0])


def _errors(
    curve: RotationCurve, seen: Orientations, R_imu_cam: FloatArray, shifts_s: FloatArray
) -> FloatArray:
    """Whitened errors of all orientations, the two worlds aligned at each shift, shape (k, 3 n)."""
    by_gyro = so3.matrix_from_quat(curve.quaternion(seen.t_cam_s + shifts_s[:, None])) @ R_imu_cam
    weighed = by_gyro / np.square(seen.sigma_rad)[:, None, None]
    align = so3.nearest_rotation(np.einsum("nij,knlj->kil", seen.R_world_cam, weighed))
    missed = np.swapaxes(align[:, None] @ by_gyro, -1, -2) @ seen.R_world_cam
    return np.asarray((so3.log(missed) / seen.sigma_rad[:, None]).reshape(len(shifts_s), -1))
