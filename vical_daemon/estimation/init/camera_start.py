"""A camera before its lever arm is known: as given, and as rotations show it. With a target and without."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.measurements import CameraPrior, FloatArray
from vical_daemon.estimation.model.state import CameraState


def starting_camera(prior: CameraPrior) -> CameraState:
    """Camera as given; a lens of 60 degrees across where nothing is."""
    R, p = (np.eye(3), np.zeros(3)) if prior.T_imu_cam is None else prior.T_imu_cam
    return CameraState(
        np.array(R, np.float64),
        np.array(p, np.float64),
        prior.timeshift_cam_imu_s or 0.0,
        prior.start_intrinsics(),
        prior.coefficients(),
        prior.distortion_model,
        prior.resolution,
        prior.readout_s,
        readout_axis=prior.readout_axis,
        term=prior.term,
    )


def camera_by_rotations(
    camera: CameraState, prior: CameraPrior, fix: Collection[str], R_imu_cam: FloatArray, timeshift_s: float
) -> CameraState:
    """A camera with mounting (3, 3) and time shift (s) as found, but for what is given and held fixed."""
    camera = replace(camera)
    if prior.T_imu_cam is None or "extrinsics" not in fix:
        camera.R_imu_cam = R_imu_cam
    if prior.timeshift_cam_imu_s is None or "timeshift" not in fix:
        camera.timeshift_s = timeshift_s
    return camera


def not_sure_yet(timeshift_sigma_s: float, rotation_sigma_rad: float, most_s: float, most_rad: float) -> str:
    """Why delay or mounting are known too badly for a start, worse than `most_s` or `most_rad`; or empty."""
    if timeshift_sigma_s > most_s:
        known = 1e3 * timeshift_sigma_s
        return f"time shift known to {known:.1f} ms so far: turn the rig faster, about changing axes"
    if rotation_sigma_rad > most_rad:
        worst = np.rad2deg(rotation_sigma_rad)
        return f"mounting rotation known to {worst:.1f} deg so far: turn the rig about a second axis"
    return ""
