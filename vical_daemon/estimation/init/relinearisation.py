"""From a start to a running filter: wide sigmas, some runs to learn, and the run that counts."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.state import (
    MOTION,
    State,
)
from vical_daemon.estimation.noise.consistency import MODES
from vical_daemon.estimation.noise.shared_errors import SharedErrors
from vical_daemon.estimation.selection.model_selection import (
    averaged,
)

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
        # expected as stated, not near what was found last (as a lens that is held is told)
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
    for name in trial.layout.held:
        lens = trial.layout.lens(name)
        narrow[lens] = wide[lens]
    for at in (trial.layout.accel_lag, trial.layout.target_scale):
        if at is not None:
            narrow[at] = wide[at]
    fresh.S = fresh.S * (narrow / wide)[:, None]
    fresh.corner_noise = trial.corner_noise
    return fresh
