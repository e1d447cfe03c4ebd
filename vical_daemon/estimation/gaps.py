"""Words for what a calibration lacks: which directions are not known yet and which motion would show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.measurements import ConvergenceTargets, FloatArray

_AXES = ("along the image's x axis", "along the image's y axis", "along the optical axis")
_TURN = (
    "about the image's x axis (nod)",
    "about the image's y axis (shake)",
    "about the optical axis (roll)",
)


@dataclass(frozen=True, slots=True)
class Gap:
    """One thing that is not known well enough.

    Attributes:
        name: What, e.g. "lever arm along the optical axis".
        excess: Its sigma over the target; above 1.
        said: In words with the figure.
        motion: The motion that would reveal it.
    """

    name: str
    excess: float
    said: str
    motion: str


def gaps(
    pose_covariance: FloatArray, R_imu_cam: FloatArray, timeshift_sigma_s: float, targets: ConvergenceTargets
) -> list[Gap]:
    """Name the directions whose sigma exceeds its target, worst first.

    Directions are eigenvectors of the lever-arm and rotation blocks, told in the camera's axes.

    Args:
        pose_covariance: Of T_imu_cam, order [p r], m and rad, shape (6, 6).
        R_imu_cam: Present mounting, for naming, shape (3, 3).
        timeshift_sigma_s: s.
        targets: Limits.

    Returns:
        The gaps; empty when everything is known well enough.
    """
    found = []
    values, vectors = np.linalg.eigh(pose_covariance[:3, :3])
    for value, vector in zip(values, vectors.T, strict=True):
        sigma = float(np.sqrt(max(value, 0.0)))
        if sigma > targets.position_m:
            found.append(_lever_arm(sigma, R_imu_cam.T @ vector, targets))
    values, vectors = np.linalg.eigh(pose_covariance[3:, 3:])
    for value, vector in zip(values, vectors.T, strict=True):
        sigma = float(np.sqrt(max(value, 0.0)))
        if sigma > targets.rotation_rad:
            found.append(_mounting(sigma, vector, targets))
    if timeshift_sigma_s > targets.timeshift_s:
        said = f"time shift: +-{1e3 * timeshift_sigma_s:.2f} ms"
        motion = "turn the rig back and forth faster, changing direction"
        found.append(Gap("time shift", timeshift_sigma_s / targets.timeshift_s, said, motion))
    return sorted(found, key=lambda g: -g.excess)


def _lever_arm(sigma: float, in_camera: FloatArray, targets: ConvergenceTargets) -> Gap:
    axis = int(np.argmax(np.abs(in_camera)))
    name = f"lever arm {_AXES[axis]}"
    others = [_TURN[i] for i in range(3) if i != axis]
    motion = f"rotate {others[0]} and {others[1]}"
    return Gap(name, sigma / targets.position_m, f"{name}: +-{1e3 * sigma:.1f} mm", motion)


def _mounting(sigma: float, local: FloatArray, targets: ConvergenceTargets) -> Gap:
    axis = int(np.argmax(np.abs(local)))
    name = f"rotation {_TURN[axis]}"
    others = [_TURN[i] for i in range(3) if i != axis]
    motion = f"rotate {others[0]} and {others[1]}"
    return Gap(name, sigma / targets.rotation_rad, f"{name}: +-{np.rad2deg(sigma):.2f} deg", motion)
