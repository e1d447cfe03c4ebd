"""From a start to a running filter: wide sigmas, some runs to learn, and the run that counts."""

from __future__ import annotations

from collections.abc import Callable, Collection
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation import so3, unscented
from vical_daemon.estimation.calibration_filter import CalibrationFilter
from vical_daemon.estimation.frame_report import FrameReport
from vical_daemon.estimation.measurements import CalibrationOptions, FloatArray, PointsFrame
from vical_daemon.estimation.state import (
    ACCEL_BIAS,
    ATTITUDE,
    GRAVITY,
    GYRO_BIAS,
    MOTION,
    POSITION,
    VELOCITY,
    Layout,
    State,
)
from vical_daemon.estimation.trust.beyond_doubt import KNOWN_OFF_SIGMA, KNOWN_SIZE_SIGMA
from vical_daemon.estimation.trust.clock_drift import SKEW_SIGMA
from vical_daemon.estimation.trust.consistency import MODES, Consistency
from vical_daemon.estimation.trust.corner_noise import CornerNoise
from vical_daemon.estimation.trust.hypotheses import (
    ENTRY_SIGMA,
    IMU,
    LAG,
    LAG_SIGMA_S,
    SIZE,
    SIZE_SIGMA,
    TARGET,
    averaged,
)
from vical_daemon.estimation.trust.lens_agreement import LensAgreement
from vical_daemon.estimation.trust.shared_errors import SharedErrors
from vical_daemon.estimation.trust.target_doubt import TargetDoubt
from vical_daemon.estimation.unshown_axes import UNKNOWN_M, UnshownAxes

_MOST_RUNS = 8
_STANDS = 1.5  # sigmas by which the answer may have moved: the next run moves it by far less
_CHANCE = 2.0  # standard deviations of it up to which larger innovations are not the stamps' fault
_DOUBTED_S = 2e-3  # jitter; a larger one is that of a broken driver
REHEARSED = 5.0  # sigmas after the rehearsal: so much wider for the run that counts

_FAR = 0.03  # from here to the right size of a target the filter is not straight
_SURE = 5.0  # sigmas

Frames = list[tuple[float, PointsFrame]]
Step = Callable[[CalibrationFilter, PointsFrame, float], FrameReport | None]


class Rehearsed(NamedTuple):
    """What the runs over the start gave.

    Attributes:
        filter: Starts again from the same place.
        size: How large the target is, relative to what was stated, where that is surely and by far not as
            stated: to be started with anew. None: it may be.
    """

    filter: CalibrationFilter
    size: float | None


def rehearsed(
    state: State,
    frames: Frames,
    make: Callable[[State], CalibrationFilter],
    step: Step,
) -> Rehearsed | None:
    """Run over the start to learn; return a filter that starts again from the same place.

    The first run is far from straight: what it says of mounting and delay counts, what it says of the noise
    does not (its innovations are large for other reasons). The second one, about its answer, measures the
    noise. Each next run takes what the last one tells as its mean, and five times its sigmas: so wide that
    the data, counted again, add 4 % of information; so narrow that the model is straight from the first
    image on, and nothing is lost to its curvature. Where the answer still moved a lot, the last run was not
    straight either (lever arms that are hardly shown), and there is another one.

    Where images then miss by more than their noise, or nothing holds together, it is done again with stamps
    that may jitter. If all fits then, that counts where they do (believed, they had put delays off by ten
    sigmas), and where nothing held together before: corners so many and sharp that a first run far from
    straight had refused all that followed.

    Args:
        state: Where the start thinks the rig is, and its calibration.
        frames: (stamp in the camera's clock in s, points) of the start, in order.
        make: Builds a filter with wide sigmas.
        step: Propagates a filter to an image and corrects it.

    Returns:
        What they gave, or None where the start does not hold together.
    """
    believed = _rehearse(state, frames, make, step, 0.0)
    if believed is not None and (believed.size is not None or _fits(believed.filter)):
        return believed
    doubted = _rehearse(state, frames, make, step, _DOUBTED_S)
    if doubted is None or not _fits(doubted.filter):
        return believed
    shared = any(e.jitter_s or e.shift_px for e in doubted.filter.shared.values())
    return doubted if shared or believed is None else believed


def _rehearse(
    state: State, frames: Frames, make: Callable[[State], CalibrationFilter], step: Step, doubted_s: float
) -> Rehearsed | None:
    """The runs; until the noise is known, stamps are allowed a jitter of `doubted_s`."""
    trial = make(deepcopy(state))
    last: CalibrationFilter | None = None
    _doubt(trial, doubted_s)
    for _ in range(_MOST_RUNS):
        if not _holds_together(trial, frames, step):
            return None
        fresh = _about(trial, state, make)
        if last is None:
            _doubt(fresh, doubted_s)
        else:
            fresh.shared, fresh.consistency = trial.shared, trial.consistency
            for shared in fresh.shared.values():
                shared.begin()
            for consistency in fresh.consistency.values():
                consistency.settle()
        stands = last is not None and _moved(last, trial) < _STANDS
        trial, last = fresh, trial
        if stands:
            break
    return Rehearsed(trial, None if last is None else _by_far(last))


def _by_far(f: CalibrationFilter) -> float | None:
    """See `Rehearsed.size`."""
    where = f.layout.target_scale
    if where is None:
        return None
    size, sigma = f.state.target_scale, float(f.sigmas()[where])
    return size if abs(size - 1.0) > max(_FAR, _SURE * sigma) else None


def _fits(trial: CalibrationFilter) -> bool:
    """Whether innovations have their size, but for what chance adds in so few images."""
    return all(
        c.level < 1.0 + _CHANCE * np.sqrt(2.0 / (MODES * max(c.images, 1)))
        for c in trial.consistency.values()
    )


def _doubt(trial: CalibrationFilter, jitter_s: float) -> None:
    if jitter_s:
        trial.shared = {name: SharedErrors.assumed(jitter_s) for name in trial.shared}


def _moved(before: CalibrationFilter, after: CalibrationFilter) -> float:
    """The largest change of a mounting, lever arm or delay, in sigmas."""
    sigmas, most = after.sigmas(), 0.0
    for name, where in after.layout.cameras.items():
        old, new = before.state.cameras[name], after.state.cameras[name]
        if where.position is not None and where.rotation is not None:
            arm = np.abs(new.p_imu_cam - old.p_imu_cam) / sigmas[where.position]
            turn = np.abs(so3.log(old.R_imu_cam.T @ new.R_imu_cam)) / sigmas[where.rotation]
            most = max(most, float(arm.max()), float(turn.max()))
        if where.timeshift is not None:
            most = max(most, abs(new.timeshift_s - old.timeshift_s) / float(sigmas[where.timeshift]))
    return most


def _holds_together(trial: CalibrationFilter, frames: Frames, step: Step) -> bool:
    """Run over the start; whether it stays plausible and most images fit."""
    used = refused = 0
    for t_cam_s, frame in frames:
        report = step(trial, frame, t_cam_s)
        used += report is not None and report.used
        refused += report is not None and not report.used
        if not trial.plausible():
            return False
    return refused <= used


def _about(
    trial: CalibrationFilter, state: State, make: Callable[[State], CalibrationFilter]
) -> CalibrationFilter:
    """A filter that begins where `trial` did, with the calibration it found and five times its sigmas."""
    told = averaged(trial)
    begin = replace(
        told.state,
        t_s=state.t_s,
        R_world_imu=state.R_world_imu,
        p_world_imu=state.p_world_imu,
        v_world_imu=state.v_world_imu,
        cameras={name: replace(camera, skew=0.0) for name, camera in told.state.cameras.items()},
        # expected as stated, not near what was found last
        target_scale=state.target_scale,
        target_shape=state.target_shape,
        gyro_matrix=state.gyro_matrix,
        accel_matrix=state.accel_matrix,
        accel_lag_s=state.accel_lag_s,
    )
    fresh = make(begin)
    wide = np.diag(fresh.S)
    narrow = np.minimum(wide, REHEARSED * told.sigmas())
    narrow[: MOTION.stop] = wide[: MOTION.stop]
    for where in (trial.layout.target_shape, trial.layout.gyro_matrix, trial.layout.accel_matrix):
        if where is not None:
            narrow[where] = wide[where]
    for at in (trial.layout.accel_lag, trial.layout.target_scale):
        if at is not None:
            narrow[at] = wide[at]
    fresh.S = fresh.S * (narrow / wide)[:, None]
    fresh.corner_noise = trial.corner_noise
    return fresh


def wide_filter(
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
    unshown = None if still_axes is None else UnshownAxes(still_axes, turn_axis_cam)
    if unshown is not None:
        for where in layout.cameras.values():
            unshown.hold(root, where)
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
        _doubts(layout),
        unshown,
        off=off,
    )


def _doubts(layout: Layout) -> dict[str, TargetDoubt]:
    """Whether the target is as stated is asked where its shape is no state."""
    modes = layout.target_modes
    if modes is None or layout.target_shape is not None:
        return {}
    return {name: TargetDoubt(modes) for name in layout.cameras}


def _before_board_m(state: State, camera: str) -> float:
    """How far a camera is from the plane of the board: sigma points must not put it behind."""
    return max(abs(float((state.p_world_imu + state.R_world_imu @ state.cameras[camera].p_imu_cam)[2])), 0.02)


def start_sigmas(state: State, layout: Layout, *, partial: bool, off: Collection[str]) -> FloatArray:
    """Standard deviations the filter starts with: many times what the start is really worth.

    The frames of the start are filtered again; were its own (small) sigmas used they would count twice.
    """
    s = np.zeros(layout.size)
    # Whoever does not know the lever arm must not know where the imu is, nor bend it by a wide attitude.
    lever_arm, position, angle = (UNKNOWN_M, 3.0 * UNKNOWN_M, 0.03)
    if not partial:
        before_m = min(_before_board_m(state, name) for name in layout.cameras)
        lever_arm, position, angle = min(0.15, 0.35 * before_m), min(0.1, 0.25 * before_m), 0.1
    s[ATTITUDE], s[POSITION], s[VELOCITY] = angle, position, 0.5
    s[GYRO_BIAS], s[ACCEL_BIAS], s[GRAVITY] = 0.02, 0.3, 0.1
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
            s[where.timeshift], s[where.skew] = 5e-3, SKEW_SIGMA
        if where.intrinsics is not None and where.distortion is not None:
            s[where.intrinsics], s[where.distortion] = 0.05 * focal, 0.1
        if where.readout is not None:
            s[where.readout] = 0.01
    return s
