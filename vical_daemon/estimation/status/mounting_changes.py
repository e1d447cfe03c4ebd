"""Whether the mounting of a camera, its time shift or its lens is another than in an earlier estimate."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.result import CameraEstimate
from vical_daemon.estimation.significance import LIKELY_SIGMAS, chi_square_limit

IRRELEVANT_M, _IRRELEVANT_RAD, IRRELEVANT_S = 2e-3, math.radians(0.1), 2e-4
"""Smaller changes are not announced, however significant: thermal play of a mount."""
IRRELEVANT_PX = 1.0  # likewise of fx: 1 px at the edge of an image 90 deg wide


def differences(
    camera: str, before: CameraEstimate, now: CameraEstimate, t_s: float, cause: Cause
) -> list[Event]:
    """Return the significant differences of a mounting from an earlier one that are not irrelevant.

    Moves and turns are significant if their direction and size are, by the sum of both covariances.

    Args:
        camera: Name of the camera.
        before: Earlier estimate.
        now: Current estimate.
        t_s: Time of the comparison, s since the first inertial reading.
        cause: What the earlier estimate is.
    """
    old, new = before.T_imu_cam, now.T_imu_cam
    covariance = np.asarray(old.covariance) + np.asarray(new.covariance)
    move_m = np.subtract(new.p_m, old.p_m)
    R_old, R_new = (so3.matrix_from_quat(np.asarray(pose.q_wxyz)) for pose in (old, new))
    turn_rad = so3.log(R_old.T @ R_new)
    shift_s = now.timeshift_cam_imu_s - before.timeshift_cam_imu_s
    found: list[tuple[EventKind, float, float]] = []
    if _differs(move_m, covariance[:3, :3], IRRELEVANT_M):
        found.append((EventKind.CAMERA_MOVED, *_length(move_m, covariance[:3, :3])))
    if _differs(turn_rad, covariance[3:, 3:], _IRRELEVANT_RAD):
        found.append((EventKind.CAMERA_TURNED, *_length(turn_rad, covariance[3:, 3:])))
    sigma_s = math.hypot(before.timeshift_sigma_s, now.timeshift_sigma_s)
    if abs(shift_s) > max(LIKELY_SIGMAS * sigma_s, IRRELEVANT_S):
        found.append((EventKind.TIMESHIFT_CHANGED, shift_s, sigma_s))
    return [Event(kind, camera, value, sigma, t_s, cause) for kind, value, sigma in found]


def lens_difference(camera: str, before: CameraEstimate, now: CameraEstimate, t_s: float) -> list[Event]:
    """Return the significant difference of the focal length fx, of 1 px and more; arguments as above."""
    step_px = now.intrinsics[0] - before.intrinsics[0]
    sigma_px = math.hypot(now.intrinsics_sigma[0], before.intrinsics_sigma[0])
    if abs(step_px) <= max(LIKELY_SIGMAS * sigma_px, IRRELEVANT_PX):
        return []
    return [Event(EventKind.LENS_STEPPED, camera, step_px, sigma_px, t_s)]


def visible_move_m(before: CameraEstimate, now: CameraEstimate) -> float:
    """Return the least move of a camera, in any direction, that `differences` reports, m."""
    covariance = np.asarray(before.T_imu_cam.covariance) + np.asarray(now.T_imu_cam.covariance)
    widest = max(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]), 0.0)
    return max(IRRELEVANT_M, math.sqrt(chi_square_limit(3, LIKELY_SIGMAS) * widest))


def _differs(vector: npt.NDArray[np.float64], covariance: npt.NDArray[np.float64], irrelevant: float) -> bool:
    """Whether a vector is longer than `irrelevant`, and not zero by its covariance, shape (3, 3)."""
    if float(np.linalg.norm(vector)) <= irrelevant:
        return False
    values, axes = np.linalg.eigh(covariance)  # one of a fixed mounting is zero
    along = (axes.T @ vector) ** 2
    square = np.sum(along / np.maximum(values, 1e-12 * irrelevant**2))
    return bool(square > chi_square_limit(3, LIKELY_SIGMAS))


def _length(vector: npt.NDArray[np.float64], covariance: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Return the length of a vector, and its standard deviation."""
    length = float(np.linalg.norm(vector))
    along = vector / length
    return length, math.sqrt(max(float(along @ covariance @ along), 0.0))
