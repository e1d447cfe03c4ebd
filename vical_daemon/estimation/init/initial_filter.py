"""The filter that a start begins with: sigmas many times what the start is really worth."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.unobservable_directions import UNKNOWN_M, UnobservableDirections
from vical_daemon.estimation.measurements import CalibrationOptions, FloatArray
from vical_daemon.estimation.model import unscented
from vical_daemon.estimation.model.priors import (
    ACCEL_BIAS_SIGMA_MPS2,
    ARM_SHARE,
    ENTRY_SIGMA,
    FILTER_START,
    GRAVITY_SIGMA_RAD,
    GYRO_BIAS_SIGMA_RPS,
    KNOWN_OFF_SIGMA,
    KNOWN_SIZE_SIGMA,
    LAG_SIGMA_S,
    PARTIAL_START_RAD,
    POSITION_SHARE,
    SIZE_SIGMA,
    SKEW_SIGMA,
    START_POSITION_M,
)
from vical_daemon.estimation.model.state import (
    ACCEL_BIAS,
    ATTITUDE,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    VELOCITY,
    Layout,
    State,
)
from vical_daemon.estimation.noise.consistency import Consistency
from vical_daemon.estimation.noise.corner_noise import CornerNoise
from vical_daemon.estimation.noise.lens_agreement import LensAgreement
from vical_daemon.estimation.noise.shared_errors import SharedErrors
from vical_daemon.estimation.selection.model_selection import IMU, LAG, SIZE, TARGET


def initial_filter(
    state: State,
    layout: Layout,
    options: CalibrationOptions,
    still_axes: FloatArray | None = None,
    turn_axis_cam: FloatArray | None = None,
) -> CalibrationFilter:
    """Build a filter about a start, with sigmas many times what the start is worth.

    Args:
        state: The start.
        layout: Where the errors live.
        options: Noise.
        still_axes: Of a partial start, see `StartResult`.
        turn_axis_cam: Likewise.
    """
    noise = {name: CornerNoise(options.corner_sigma_px) for name in layout.cameras}
    consistency = {name: Consistency() for name in layout.cameras}
    walk = np.zeros(layout.size)
    off = {IMU, LAG, SIZE, TARGET} & options.estimate
    root = np.diag(start_sigmas(state, layout, partial=still_axes is not None, off=off))
    unobservable = None if still_axes is None else UnobservableDirections(still_axes, turn_axis_cam)
    if unobservable is not None:
        for where in layout.cameras.values():
            unobservable.hold(root, where)
    agreement = {name: LensAgreement(state.cameras[name].distortion_model) for name in layout.cameras}
    shared = {name: SharedErrors() for name in layout.cameras}
    return CalibrationFilter(
        state,
        layout,
        unscented.lower_root(root),
        options.imu_noise,
        noise,
        walk,
        consistency,
        agreement,
        shared,
        unobservable,
        off=off,
    )


def _before_board_m(state: State, camera: str) -> float:
    """How far a camera is from the plane of the board: sigma points must not put it behind."""
    return max(abs(float((state.p_world_imu + state.R_world_imu @ state.cameras[camera].p_imu_cam)[2])), 0.02)


def start_sigmas(state: State, layout: Layout, *, partial: bool, off: Collection[str]) -> FloatArray:
    """Standard deviations the filter starts with: many times what the start is really worth.

    The frames of the start are filtered again; were its own (small) sigmas used they would count twice.
    """
    s = np.zeros(layout.size)
    # Whoever does not know the lever arm must not know where the imu is, nor bend it by a wide attitude.
    start = FILTER_START
    lever_arm, position, angle = UNKNOWN_M, 3.0 * UNKNOWN_M, PARTIAL_START_RAD
    if not partial:
        before_m = min(_before_board_m(state, name) for name in layout.cameras)
        lever_arm, angle = min(start.lever_arm_m, ARM_SHARE * before_m), start.attitude_rad
        position = min(START_POSITION_M, POSITION_SHARE * before_m)
    s[ATTITUDE], s[POSITION], s[VELOCITY] = angle, position, start.velocity_mps
    s[GYRO_BIAS], s[ACCEL_BIAS], s[GRAVITY] = GYRO_BIAS_SIGMA_RPS, ACCEL_BIAS_SIGMA_MPS2, GRAVITY_SIGMA_RAD
    if layout.gyro_matrix is not None and layout.accel_matrix is not None:
        s[layout.gyro_matrix] = s[layout.accel_matrix] = KNOWN_OFF_SIGMA if IMU in off else ENTRY_SIGMA
    if layout.accel_lag is not None:
        s[layout.accel_lag] = LAG_SIGMA_S
    if layout.target_scale is not None:
        s[layout.target_scale] = KNOWN_SIZE_SIGMA if SIZE in off else SIZE_SIGMA
    if layout.target_modes is not None and layout.target_shape is not None:
        s[layout.target_shape] = layout.target_modes.sigma_m
    for name, where in layout.cameras.items():
        focal = float(state.cameras[name].intrinsics[0])
        if where.position is not None and where.rotation is not None:
            s[where.position], s[where.rotation] = lever_arm, angle
        if where.timeshift is not None and where.skew is not None:
            s[where.timeshift], s[where.skew] = start.timeshift_s, SKEW_SIGMA
        if where.intrinsics is not None and where.distortion is not None:
            s[where.intrinsics], s[where.distortion] = start.focal * focal, start.distortion
            if name in layout.held:
                s[where.intrinsics.start : where.distortion.stop] = layout.held[name].off_sigma
        if where.readout is not None:
            s[where.readout] = start.readout_s
    return s
