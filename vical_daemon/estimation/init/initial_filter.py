"""The filter that a start begins with: its sigmas are many times the errors of the closed form."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.unobservable_directions import UNKNOWN_M, UnobservableDirections
from vical_daemon.estimation.measurements import CalibrationOptions, FloatArray
from vical_daemon.estimation.model import unscented
from vical_daemon.estimation.model.priors import (
    ACCEL_BIAS_SIGMA_MPS2,
    ENTRY_SIGMA,
    FILTER_START,
    GRAVITY_SIGMA_RAD,
    GYRO_BIAS_SIGMA_RPS,
    KNOWN_OFF_SIGMA,
    KNOWN_SIZE_SIGMA,
    SIZE_SIGMA,
)
from vical_daemon.estimation.model.start_sigmas import start_sigmas
from vical_daemon.estimation.model.state import (
    ACCEL_BIAS,
    ATTITUDE,
    GRAVITY,
    GYRO_BIAS,
    MOTION,
    POSITION,
    VELOCITY,
    CameraSlices,
    CameraState,
    Layout,
    MotionStart,
    State,
    gravity_root,
)
from vical_daemon.estimation.noise.consistency import Consistency
from vical_daemon.estimation.noise.corner_noise import CornerNoise
from vical_daemon.estimation.noise.lens_agreement import LensAgreement
from vical_daemon.estimation.noise.shared_errors import SharedErrors
from vical_daemon.estimation.selection.model_selection import IMU, LAG, SIZE, SIZE_EFFECT, TARGET


def initial_filter(
    state: State,
    layout: Layout,
    options: CalibrationOptions,
    still_axes: FloatArray | None = None,
    turn_axis_cam: FloatArray | None = None,
    absent: Iterable[str] = (),
) -> CalibrationFilter:
    """Build a filter about a start, with sigmas many times what the start is worth.

    Lever arms have the prior of any rig, about zero: in slow motion the closed form may be half a metre off.

    Args:
        state: The start.
        layout: Where the errors live.
        options: Noise.
        still_axes: Of a partial start, see `StartResult`.
        turn_axis_cam: Likewise.
        absent: Cameras that have not seen the target.
    """
    cameras = {name: _without_arm(camera, layout.cameras[name]) for name, camera in state.cameras.items()}
    state = replace(state, cameras=cameras)
    noise = {name: CornerNoise(options.corner_sigma_px) for name in layout.cameras}
    consistency = {name: Consistency() for name in layout.cameras}
    walk = np.zeros(layout.size)
    off = {IMU, LAG, SIZE, SIZE_EFFECT, TARGET} & options.estimate
    root = np.diag(filter_sigmas(state, layout, off))
    root[GRAVITY, GRAVITY] = gravity_root(state.gravity, GRAVITY_SIGMA_RAD, options.gravity_sigma_mps2)
    unobservable = None if still_axes is None else UnobservableDirections(still_axes, turn_axis_cam)
    if unobservable is not None:
        for where in layout.cameras.values():
            unobservable.hold(root, where)
    agreement = {name: LensAgreement() for name in layout.cameras}
    shared = {name: SharedErrors() for name in layout.cameras}
    return CalibrationFilter(
        state,
        layout,
        unscented.upper_root(root),
        options.imu_noise,
        noise,
        walk,
        consistency,
        agreement,
        shared,
        unobservable,
        frozenset(absent),
        off=off,
    )


def with_camera(known: CalibrationFilter, name: str, start: State) -> CalibrationFilter:
    """A filter as another one, which a camera joins; with sigmas many times what the start is worth.

    Args:
        known: What is known but for the camera; stays as it is.
        name: The camera.
        start: Its numbers, and the motion at the first of its images, as its own images show them.
    """
    out, layout = deepcopy(known), known.layout
    sigmas = filter_sigmas(start, layout, out.off)
    elapsed_s = max(start.t_s - known.state.t_s, 0.0)
    motion = start.t_s, start.R_world_imu, start.p_world_imu, start.v_world_imu
    out.restart_motion(MotionStart(*motion, sigmas[MOTION], elapsed_s))
    where = layout.cameras[name]
    out.state.cameras[name] = _without_arm(start.cameras[name], where)
    root = np.diag(sigmas)[:, layout.errors_of(name)]
    out.S[layout.errors_of(name)] = 0.0
    out.inflate_covariance(root)
    out.absent, out.passed = out.absent - {name}, []  # nothing is known of a change before this
    return out


def _without_arm(camera: CameraState, where: CameraSlices) -> CameraState:
    """A camera with the lever arm of any rig, where it is estimated."""
    return camera if where.position is None else replace(camera, p_imu_cam=np.zeros(3))


def filter_sigmas(state: State, layout: Layout, off: set[str]) -> FloatArray:
    """Standard deviations the filter starts with, but for gravity: many times what the start is worth.

    The images of the start are filtered again: with its own (small) sigmas they would count twice. A lever
    arm that is not known leaves the position of the IMU as unknown.
    """
    start = FILTER_START
    s = start_sigmas(
        layout,
        state.cameras,
        start,
        imu_sigma=KNOWN_OFF_SIGMA if IMU in off else ENTRY_SIGMA,
        size_sigma=KNOWN_SIZE_SIGMA if SIZE in off else SIZE_SIGMA,
    )
    s[ATTITUDE], s[POSITION], s[VELOCITY] = start.attitude_rad, 3.0 * UNKNOWN_M, start.velocity_mps
    s[GYRO_BIAS], s[ACCEL_BIAS] = GYRO_BIAS_SIGMA_RPS, ACCEL_BIAS_SIGMA_MPS2
    return s
