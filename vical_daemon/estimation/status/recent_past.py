"""What an estimator remembers of the last seconds, to tell what has changed when images no longer fit."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.passed import Corrected, Moved
from vical_daemon.estimation.filter.sensor_intake import SEARCHED_S
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.target_poses import TargetPose, attitude_sigmas, poses_of
from vical_daemon.estimation.measurements import FloatArray, Frames, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.state import State
from vical_daemon.estimation.significance import EVERY_S
from vical_daemon.estimation.status.motion_levels import MotionLevels
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve
from vical_daemon.estimation.temporal.shift_step import (
    Orientations,
    ShiftFit,
    find_shift,
    first_after_step,
    level_at,
)

BEFORE_S = 3.0  # a change is noticed within
_STRETCHES = (10, 15, 30)  # images in which a step is looked for; the most show how well they usually fit
_LATE_IMAGES = 2  # of these the newest: the inertial readings that belong to them may not have come
_MOST = 200  # images kept, a camera

_Poses = dict[float, TargetPose | None]
"""Poses of a camera by the stamps of its images, s; None: the image shows none."""


class Taken(NamedTuple):
    """An image that the filter has taken.

    Attributes:
        image: Its stamp, s, and points.
        used: Whether it was used.
        log_likelihood: See `FrameReport`.
        state: After it.
        passed: What it did to the filter.
    """

    image: tuple[float, PointsFrame]
    used: bool
    log_likelihood: float
    state: State
    passed: Sequence[Moved | Corrected]


class _Copy(NamedTuple):
    """A copy of the filter, and the images that the filter has taken since, of all cameras, in order."""

    filter: CalibrationFilter
    since: list[Taken]


@dataclass(slots=True)
class RecentPast:
    """Images of the last seconds by camera, and copies of the filter from before.

    Attributes:
        motion: Of the rig.
    """

    motion: MotionLevels = field(default_factory=MotionLevels)
    _frames: dict[str, deque[tuple[float, PointsFrame, bool]]] = field(default_factory=dict)
    _copies: deque[_Copy] = field(default_factory=deque)

    def saw(self, f: CalibrationFilter, report: FrameReport, frame: PointsFrame, t_cam_s: float) -> None:
        """Remember an image, whether it was used, and once a second the filter."""
        self.motion.look(f)
        frames = self._frames.setdefault(frame.camera, deque(maxlen=_MOST))
        frames.append((t_cam_s, frame, report.used))
        likelihood, passed = report.log_likelihood, tuple(f.passed)
        taken = Taken((t_cam_s, frame), report.used, likelihood, replace(f.state), passed)
        f.passed.clear()
        for copy in self._copies:
            copy.since.append(taken)
        while self._copies and self._copies[0].filter.state.t_s < f.state.t_s - BEFORE_S - EVERY_S:
            self._copies.popleft()
        if not self._copies or f.state.t_s >= self._copies[-1].filter.state.t_s + EVERY_S:
            self._copies.append(_Copy(deepcopy(f), []))

    def changed(self, f: CalibrationFilter) -> None:
        """Go on with another filter: copies from before know of no change."""
        f.passed.clear()
        self._copies = deque([_Copy(deepcopy(f), [])])

    def filter(self, f: CalibrationFilter) -> CalibrationFilter:
        """The filter as it was before a change that is noticed now, or as long ago as it is remembered."""
        return deepcopy(self._copies[0].filter if self._copies else f)

    def find_shift(
        self, f: CalibrationFilter, camera: str, buffer: ImuBuffer, target: FloatArray
    ) -> ShiftFit | None:
        """Whether the latest images fit the gyro at another time shift, and only there.

        Nobody knows when it stepped: the shortest stretch that gives an answer is as good as any.
        """
        frames = [(t, frame) for t, frame, _ in self._frames.get(camera, ())]
        poses: _Poses = {}
        sound_s = frames[-_STRETCHES[-1] :][0][0] if frames else 0.0
        for count in _STRETCHES:
            if len(frames) < count:
                break
            fit = self.shift_of(frames[-count:-_LATE_IMAGES], f, buffer, target, poses, sound_s)
            if fit is not None and fit.stepped:
                return fit
        return None

    def since(self) -> list[Taken]:
        """Images that `filter` has not taken yet, of all cameras, in order."""
        return list(self._copies[0].since) if self._copies else []

    def images(self) -> Frames:
        """These images alone: stamps, s, and points."""
        return [taken.image for taken in self.since()]

    def before_step(
        self, f: CalibrationFilter, fit: ShiftFit, camera: str, buffer: ImuBuffer, target: FloatArray
    ) -> Frames:
        """Images that `f`, the filter from before, has not taken yet, and that are surely from before a step.

        Args:
            f: As `filter` returns it.
            fit: Of the images after the step.
            camera: Of which the time shift stepped.
            buffer: Inertial readings.
            target: Points of the target, m, shape (n, 3).

        Returns:
            Stamps, s, and points, of all cameras, oldest first.
        """
        newer = self.images()
        own = [(t, frame) for t, frame in newer if frame.camera == camera]
        seen = _orientations(own, f, target, {})
        if seen is None or len(buffer) < 2:
            return []
        curve, known = _curve(buffer, f), f.state.cameras
        shift_s = known[camera].timeshift_s
        at = first_after_step(curve, seen, known[camera].R_imu_cam, (shift_s, fit.timeshift_s))
        if at is None:
            return []
        step_s = float(seen.t_cam_s[at]) + shift_s
        return [(t, frame) for t, frame in newer if t + known[frame.camera].timeshift_s < step_s]

    def shift_of(
        self,
        frames: Frames,
        f: CalibrationFilter,
        buffer: ImuBuffer,
        target: FloatArray,
        poses: _Poses | None = None,
        sound_s: float = math.inf,
    ) -> ShiftFit | None:
        """Whether images of one camera fit the gyro at one time shift, and only there.

        Args:
            frames: Stamp, s, and points.
            f: With the calibration as it is known.
            buffer: Inertial readings.
            target: Points of the target, m, shape (n, 3).
            poses: Of images looked at before, with the same lens; others are added.
            sound_s: Images used before this stamp, s, and before `frames`, show how well they usually fit:
                some of those since may have been used with a time shift that had stepped.
        """
        poses = {} if poses is None else poses
        seen = _orientations(frames, f, target, poses)
        if seen is None or len(buffer) < 2:
            return None
        curve, known = _curve(buffer, f), f.state.cameras[frames[0][1].camera]
        used = [(t, frame) for t, frame, ok in self._frames.get(frames[0][1].camera, ()) if ok]
        sound_s = min(sound_s, frames[0][0], f.state.t_s - known.timeshift_s)
        before = _orientations([x for x in used if x[0] < sound_s][-_STRETCHES[-1] :], f, target, poses)
        level = 1.0 if before is None else level_at(curve, before, known.R_imu_cam, known.timeshift_s)
        return find_shift(curve, seen, known.R_imu_cam, known.timeshift_s, SEARCHED_S, level)


def _curve(buffer: ImuBuffer, f: CalibrationFilter) -> GyroCurve:
    """Turns of the imu by the readings and the bias that a filter knows."""
    return GyroCurve.integrate(buffer.rows[:, 0], buffer.rows[:, 1:4], f.state.gyro_bias)


def _orientations(
    frames: Frames, f: CalibrationFilter, target: FloatArray, poses: _Poses
) -> Orientations | None:
    """What the camera's orientations are by the target alone; None where no image shows one."""
    if not frames:
        return None
    known = f.state.cameras[frames[0][1].camera]
    new = [(t, frame) for t, frame in frames if t not in poses]
    poses.update(zip((t for t, _ in new), poses_of(new, known, target), strict=True))
    shown = [p for p in (poses[t] for t, _ in frames) if p is not None]
    if not shown:
        return None
    return Orientations(
        np.array([p.t_cam_s for p in shown]),
        np.array([p.R_target_cam for p in shown]),
        attitude_sigmas(shown, known),
    )
