"""Prior sigmas of the constants of a rig at a start, with a target and without."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vical_daemon.estimation.geometry.camera_model import EQUIDISTANT
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import APART_SIGMA_M, LAG_SIGMA_S, SKEW_SIGMA, StartSigmas
from vical_daemon.estimation.model.state import CameraState, Layout


def start_sigmas(
    layout: Layout,
    cameras: Mapping[str, CameraState],
    start: StartSigmas,
    *,
    imu_sigma: float,
    size_sigma: float = 0.0,
    gravity_sigma_mps2: float = 0.0,
) -> FloatArray:
    """Standard deviations of the constants: many times what a start is worth; zero for the core; shape (n,).

    Args:
        layout: Where the errors live.
        cameras: By name; focal length and model of the lens count.
        start: Of the cameras.
        imu_sigma: Of the entries of the imu's matrices.
        size_sigma: Of the size of the target, relative.
        gravity_sigma_mps2: Of the magnitude of gravity, of a window.
    """
    s = np.zeros(layout.size)
    if layout.gravity is not None:
        s[layout.gravity] = gravity_sigma_mps2
    if layout.gyro_matrix is not None and layout.accel_matrix is not None:
        s[layout.gyro_matrix] = s[layout.accel_matrix] = imu_sigma
    if layout.accel_positions is not None:
        s[layout.accel_positions] = APART_SIGMA_M
    if layout.accel_lag is not None:
        s[layout.accel_lag] = LAG_SIGMA_S
    if layout.target_scale is not None:
        s[layout.target_scale] = size_sigma
    if layout.target_modes is not None and layout.target_shape is not None:
        s[layout.target_shape] = layout.target_modes.sigma_m
    for name, where in layout.cameras.items():
        camera = cameras[name]
        if where.position is not None and where.rotation is not None:
            s[where.position], s[where.rotation] = start.lever_arm_m, start.rotation_rad
        if where.timeshift is not None and where.skew is not None:
            s[where.timeshift], s[where.skew] = start.timeshift_s, SKEW_SIGMA
        if where.intrinsics is not None and where.distortion is not None:
            held = layout.held.get(name)
            s[layout.lens(name)] = _of_lens(camera, start) if held is None else held.off_sigma
        if where.readout is not None:
            s[where.readout] = start.readout_s
    return s


def _of_lens(camera: CameraState, start: StartSigmas) -> FloatArray:
    """Of fx fy cx cy and the distortion, shape (n,)."""
    s = np.full(4 + len(camera.distortion), start.distortion)
    s[:2], s[2:4] = np.array([start.focal, start.centre]) * float(camera.intrinsics[0])
    if camera.distortion_model == EQUIDISTANT:
        s[4:] = start.equidistant
    else:
        s[6:8] = start.tangential
    return s
