"""The estimator as the roles see it: measurements in, calibration out. No clock, no thread, no I/O.

Flow: the initializer collects data until an initialisation succeeds -> the filter processes all of them -> it
follows the stream behind a short lag, so that inertial data always bracket each image -> `evaluator` decides
the status.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from vical_daemon.estimation.events import ROLLING, Cause, Event, EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.frame_queue import FrameQueue
from vical_daemon.estimation.filter.image_pace import ImagePace
from vical_daemon.estimation.filter.linearised_filter import LinearisedFilter
from vical_daemon.estimation.filter.sensor_intake import SensorIntake
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.board_window import LATE_S
from vical_daemon.estimation.init.initializer import Attempt, Initializer
from vical_daemon.estimation.init.late_camera import LateCameras
from vical_daemon.estimation.init.motion_restart import MotionRestart, RecordingStart, motion_is_lost
from vical_daemon.estimation.init.rig_model import RigModel
from vical_daemon.estimation.measurements import (
    LEAST_POINTS,
    CalibrationOptions,
    CameraPrior,
    FloatArray,
    Frames,
    PointsFrame,
)
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.priors import AGAIN_SIGMAS
from vical_daemon.estimation.plausible import usable_points
from vical_daemon.estimation.result import CalibrationEstimate, HeldOutCheck
from vical_daemon.estimation.selection import clock_drift, model_selection
from vical_daemon.estimation.selection.model_acceptance import ModelAcceptance
from vical_daemon.estimation.status.change_watch import Action, ChangeWatch, suspect
from vical_daemon.estimation.status.holdout_check import HoldoutCheck
from vical_daemon.estimation.status.pending_change import MOST_CHANGES, Known, PendingChange
from vical_daemon.estimation.status.recent_past import RecentPast
from vical_daemon.estimation.status.status_evaluator import StatusEvaluator
from vical_daemon.estimation.status.what_jumped import Part, what_jumped
from vical_daemon.estimation.temporal.shift_step import ShiftFit
from vical_daemon.estimation.temporal.td_icp_input import MIN_ORIENTATIONS

_KEEP_S = 5.0  # of readings before the oldest image that may still be used


class Calibrator:
    """Calibrates cameras against one IMU, online, from target points.

    Args:
        options: Switches and noise.
        cameras: What is known about each camera.
        target_points_m: Points of the target in its frame, m, shape (n, 3); row = point id.
    """

    def __init__(
        self, options: CalibrationOptions, cameras: dict[str, CameraPrior], target_points_m: FloatArray | None
    ) -> None:
        if target_points_m is None:
            raise ValueError("target-free calibration needs TargetFreeCalibrator")
        self.options = options
        self.rig = RigModel(options, cameras, np.asarray(target_points_m, dtype=np.float64))
        self.evaluator = StatusEvaluator(options)
        self.filter: CalibrationFilter | None = None
        self._intake, self._pace = SensorIntake(), ImagePace(options.imu_noise)
        self._pending = FrameQueue(list(cameras))
        self._initializer = self._new_initializer()
        self._late = LateCameras(options, self.rig, self._step)
        self.watch = ChangeWatch()
        self._stale: CalibrationFilter | None = None
        self._lost: MotionRestart | None = None
        self._used_ns: dict[str, int] = {}  # stamp of the last image used, by camera
        self._held_back = HoldoutCheck()
        self._acceptance = ModelAcceptance()
        self._past = RecentPast()
        self._change: PendingChange | None = None  # the last, until images confirm it
        self._seek_shift: set[str] = set()  # cameras whose time shift is to be found before the motion
        self._reports: list[FrameReport] = []  # of the images of a start

    def _new_initializer(self, off: Collection[str] = ()) -> Initializer:
        """Make an initializer that keeps the accepted models (IMU, target)."""
        return Initializer(self.options, self.rig, self._step, off)

    # ------------------------------------------------------------------ input
    def stamps_known_to(self, sigma_s: float) -> None:
        """Set the one-sigma uncertainty of the driver's clock mapping, s; implausible values are ignored."""
        if self._intake.stamps_known_to(sigma_s) and self.filter is not None:
            self.filter.stamp_sigma_s = sigma_s

    def add_imu(self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]) -> None:
        """Add one reading (IMU clock, ns; rad/s; m/s^2); old and non-finite ones are only counted."""
        for reading in self._intake.take_imu(t_imu_ns, gyro_rps, specific_force_mps2):
            self.evaluator.saw_reading(*reading[:3])
        self.evaluator.announce_all(self._intake.imu_news())

    @property
    def _buffer(self) -> ImuBuffer:
        """Inertial readings; made with the first one."""
        assert self._intake.buffer is not None
        return self._intake.buffer

    def add_points(self, frame: PointsFrame) -> None:
        """Add the points of one image; those of unknown cameras or off the board are only counted."""
        ok = usable_points(frame) & (frame.ids < len(self.rig.target))
        nonsense = len(ok) > 0 and not ok.any()  # its stamp is worth no more than its points
        if frame.camera not in self.rig.priors or not self._intake.takes_images or nonsense:
            self._intake.images_ignored += 1
            return
        frame = frame if ok.all() else frame.only(ok)
        t_cam_s = self._intake.take_image(frame)
        self.evaluator.announce_all(self._intake.image_news())
        if t_cam_s is None:
            self._intake.images_ignored += 1
            return
        if self._intake.clock_was_set(frame.camera):
            self._clock_was_set(frame.camera)
        self.evaluator.saw_points(t_cam_s, len(frame.ids))
        if self._pace.takes(
            frame.camera, t_cam_s, self.evaluator.motion.rate_change_rps2, self._intake.buffer
        ):
            self._pending.push(
                t_cam_s, self.rig.turns.numbered(frame, t_cam_s, self.filter, self._intake.buffer)
            )

    def _clock_was_set(self, camera: str) -> None:
        """Stamps have moved by seconds: the time shift is known only roughly until images show it."""
        self._late.anew()
        if self.filter is not None and camera not in self.filter.absent:
            self._lose_motion()
            self._seek_shift.add(camera)
            self.watch.shift_reopened()

    def do_without(self, cameras: frozenset[str]) -> None:
        """Do not wait for these cameras: they send no data now."""
        self.rig.silent = self.evaluator.silent = cameras

    @property
    def waiting(self) -> int:
        """Images that wait for inertial data."""
        return len(self._pending)

    @property
    def left_out(self) -> dict[str, int]:
        """Readings and images that were not used, by cause."""
        return self._intake.left_out

    # ------------------------------------------------------------------ work
    def process(self) -> list[FrameReport]:
        """Process the data that have arrived, as far as possible."""
        if self._intake.buffer is None:
            return []
        if self.filter is None or self.filter.unobservable is not None:
            self._maybe_start()
        self._maybe_join()
        return self._follow(flush=False)

    def finish(self) -> list[FrameReport]:
        """End of the data: try to initialise a last time, and process all frames that inertial data cover."""
        if self._intake.buffer is None:
            return []
        if self.filter is None:
            self._maybe_start(at_end=True)
        reports = self._follow(flush=True)
        self._maybe_join(at_end=True)
        return reports + self._follow(flush=True)

    def _maybe_start(self, *, at_end: bool = False) -> None:
        """Try to initialise a filter; a full one replaces a partial one."""
        if self.filter is None:
            self._initializer.take(self._pending.take_all())
            self._buffer.cut(self._intake.gap_end_s)  # a start needs motion in one piece
            self._buffer.trim(self._initializer.oldest_s - _KEEP_S)
        if not (at_end or self._initializer.due(self._buffer.newest_s)):
            return
        found = self._initializer.attempt(self._buffer, may_be_partial=self.filter is None, at_end=at_end)
        self.evaluator.announce_all(found.news)
        if found.filter is None:
            if self.filter is None:
                self.evaluator.waiting(found.reason, found.motion_missing)
            return
        if self.rig.size != 1.0:
            event = Event(EventKind.TARGET_SIZE, value=self.rig.size - 1.0)
            self.evaluator.announce(event, once=model_selection.SIZE)
        self._begin(found.filter, found)

    def _maybe_join(self, *, at_end: bool = False) -> None:
        """Let a camera that sees the target for the first time join the others."""
        f = self.filter
        found = None if f is None else self._late.attempt(self._buffer, at_end=at_end)
        if found is None:
            return
        if found.rolling is not None:  # one more unknown: everything anew
            self.rig.estimate_readout(*found.rolling)
            self.evaluator.announce(Event(ROLLING[found.rolling[1]], found.rolling[0]))
            self.filter = None
            self._initializer.anew()
            self._late.anew()
        elif found.filter is None:
            self.evaluator.not_joined = found.reason
        else:
            self._begin(found.filter, found)

    def _begin(self, f: LinearisedFilter, found: Attempt) -> None:
        """Continue from an initialisation: process its images, then the stream."""
        later = self._pending.take_all()
        f.stamp_sigma_s = self._intake.stamp_sigma_s
        self._stale = None
        self._held_back, self._lost, self._past = HoldoutCheck(), None, RecentPast()
        self.evaluator.started(f.state.t_s, found.reason)
        self.watch.started()
        self._initializer.anew()
        self._late.anew()
        left = self._take_start(f, found.frames)
        self.filter = f.plain()
        for t, frame in [*left, *later]:
            self._pending.push(t, frame)

    def _take_start(self, f: LinearisedFilter, frames: Frames) -> Frames:
        """Process the images of an initialisation; return those that readings do not cover yet."""
        for k, (t_cam_s, frame) in enumerate(frames):
            if t_cam_s + f.state.cameras[frame.camera].timeshift_s > self._buffer.settled_s:
                return frames[k:]
            report = self._step(f, frame, t_cam_s)
            if report is None:
                self._intake.images_ignored += 1
                continue
            if f.unobservable is not None:
                self._initializer.take([(t_cam_s, frame)])
                f.unobservable.turned(f)
            self._note(f.plain(), report, frame, t_cam_s)
            self._reports.append(report)
        return []

    def _follow(self, *, flush: bool) -> list[FrameReport]:
        """Filter every pending frame that inertial data already bracket."""
        reports, self._reports = self._reports, []
        while self.filter is not None:
            shifts = {name: c.timeshift_s for name, c in self.filter.state.cameras.items()}
            covered_s = self._buffer.newest_s if flush else self._buffer.settled_s
            item = self._pending.pop(shifts, covered_s, flush=flush)
            if item is None:
                break
            if self._late.take(self.filter, *item):
                if self.filter.unobservable is not None:  # a full start is still to come
                    self._initializer.take([item])
                continue
            if self._lost is None and motion_is_lost(self.filter, self._buffer, *item, self.rig.target):
                self._lose_motion()
            if self._lost is None:
                reports += self._one(item[1], item[0])
            else:
                reports += self._find_motion(self._lost, item[1], item[0])
        return reports

    def _lose_motion(self, *, jumped: bool = False) -> None:
        """Drop the motion, keep the calibration; the next images re-initialise the motion."""
        self._lost = MotionRestart(self.rig.target, self._used_ns, jumped=jumped)
        self._held_back = HoldoutCheck()

    def _find_motion(self, lost: MotionRestart, frame: PointsFrame, t_cam_s: float) -> list[FrameReport]:
        """Re-initialise the motion as soon as images determine it, and process these images."""
        f = self.filter
        assert f is not None
        lost.take(frame, t_cam_s, f.state, self._buffer)
        if frame.camera in self._seek_shift:
            lost = self._seek(f, lost, frame.camera)
        if lost.saw_lately(self._seek_shift, t_cam_s):
            return []
        lost.leave_out(self._seek_shift)
        self._trim(lost.frames[0][0] if lost.frames else t_cam_s)
        motion = lost.motion(f, self._buffer)
        if motion is None:
            return []
        self._lost = None
        f.restart_motion(motion)
        if motion.turned is not None or not lost.jumped:  # copies from before know nothing of this motion
            self._past.changed(f)
        self.watch.motion_restarted(motion.t_s)
        return [r for t, kept in lost.frames for r in self._one(kept, t)]

    def _trim(self, needed_s: float) -> None:
        """Drop readings from before `needed_s`."""
        self._buffer.trim(min(needed_s, self._initializer.oldest_s, self._late.oldest_s) - _KEEP_S)

    def _step(self, f: CalibrationFilter, frame: PointsFrame, t_cam_s: float) -> FrameReport | None:
        """Propagate a filter to one image and correct it; None where inertial data are missing."""
        t_s = t_cam_s + f.state.cameras[frame.camera].timeshift_s
        if t_s < f.state.t_s - LATE_S:
            return None
        segment = self._buffer.segment(f.state.t_s, max(t_s, f.state.t_s))
        if segment is None:
            return None
        if t_s - f.state.t_s > self._intake.longest_s(frame.camera):
            f.doubt_motion()
        f.predict(segment)  # of no length at the first image: that one, too, must know how the rig turns
        if len(frame.ids) < LEAST_POINTS:
            return None
        return f.update(f.image(frame, t_cam_s, self.rig.target[frame.ids]))

    def _one(self, frame: PointsFrame, t_cam_s: float) -> list[FrameReport]:
        """Process one image of the stream; return its verdict, or None if it could not be used."""
        f = self.filter
        if f is None:  # an image before this one ended it
            return []
        report = self._step(f, frame, t_cam_s)
        if report is None:
            self._intake.images_ignored += 1
            return []
        if f.unobservable is not None:
            self._initializer.take([(t_cam_s, frame)])
            if f.unobservable.turned(f):
                self.filter = None
                return [report]
        self._trim(f.state.t_s)
        ratio = self._held_back.follow(f, report, frame, t_cam_s, self.rig.target, self._buffer)
        if ratio is not None:
            self.evaluator.held_back(ratio, f, frame.camera)
        if not f.finite():
            self.watch.why = Cause.ESTIMATE_IMPLAUSIBLE
            self._restart(f)
            return [report]
        self._note(f, report, frame, t_cam_s)
        if self._change is not None and self._change.confirmed(f.state.t_s):
            news, self._change = self._change.news(f, self._past.motion), None
            self.evaluator.announce_all([] if news is None else [news])
        if f.unobservable is None and self._change is None and not self.watch.undecided:
            for block, event in self._acceptance.look(f).items():
                self.evaluator.announce(event, once=block)
        self._act(self.watch.look(report, f, early=self.evaluator.confirms(f.state.t_s)), frame)
        return [report]

    def _note(self, f: CalibrationFilter, report: FrameReport, frame: PointsFrame, t_cam_s: float) -> None:
        """Record an image and its verdict."""
        self._used_ns[frame.camera] = frame.t_cam_ns
        self._past.saw(f, report, frame, t_cam_s)
        self.evaluator.saw_frame(report, f)

    def _act(self, action: Action, frame: PointsFrame) -> None:
        """Carry out what the change detection requests."""
        f = self.filter
        assert f is not None
        if action.asks and self._part_changed(f, suspect(f, frame)):
            return
        if action is Action.POSE:
            self._lose_motion(jumped=True)
            if f.unobservable is None:
                self.evaluator.announce(Event(EventKind.POSE_LOST))
        elif action in (Action.SKEW, Action.WANDER) and f.unobservable is None:
            anew = action is Action.WANDER
            once = f"wander {frame.camera}" if anew else ""
            self.evaluator.announce(clock_drift.let_drift(f, frame.camera, anew=anew), once=once)
        elif action is Action.RESTART:
            self._restart(f)

    def _part_changed(self, f: CalibrationFilter, camera: str) -> bool:
        """Test whether a jump explains the misfit of the images; continue with its parts unknown."""
        if f.unobservable is not None:
            return False
        before, fit = self._past.filter(f), None  # images since have moved the present one
        stepped = self._change is not None and self._change.shift_stepped
        if not stepped and self.rig.layout.cameras[camera].timeshift is not None:
            fit = self._past.find_shift(before, camera, self._buffer, self.rig.target)
        if fit is None or not fit.stepped:
            return self._part_jumped(before, camera, stepped=stepped)
        change = PendingChange(Part.SHIFT, frozenset(), camera, f.state.t_s, Known.of(before))
        self._change = change.after(self._change)
        self.filter = before
        for t_cam_s, kept in self._past.before_step(before, fit, camera, self._buffer, self.rig.target):
            self._step(before, kept, t_cam_s)
        self._set_shift(before, camera, fit)
        self._past.changed(before)
        self._lose_motion()
        return True

    def _part_jumped(self, before: CalibrationFilter, camera: str, *, stepped: bool) -> bool:
        """Find the most likely jump among those that orientations do not show."""
        if self._change is not None and self._change.number >= MOST_CHANGES:
            return False
        after_gap = self._change is None and self.watch.motion_is_new(before.state.t_s)
        found = what_jumped(before, self._past.since(), camera, self._step, after_gap=after_gap)
        if found is None or (stepped and found.part in (Part.SHIFT, Part.DRIFT)):
            return False
        part, possible, f, known = found
        change = PendingChange(part, possible, camera, f.state.t_s, Known.of(known)).after(self._change)
        change.tell(f, before, self.evaluator, self.watch.why)
        self.filter, self._change = f, change
        self._past.changed(f)
        if part is Part.TARGET and not change.moved:
            self._lose_motion(jumped=True)
        self.watch.shift_reopened()
        return True

    def _set_shift(self, f: CalibrationFilter, camera: str, fit: ShiftFit) -> None:
        """Set a re-estimated time shift; keep everything else."""
        index = self.rig.layout.cameras[camera].timeshift
        assert index is not None
        f.state.cameras[camera].timeshift_s = fit.timeshift_s
        f.forget(index, AGAIN_SIGMAS * fit.sigma_s)
        self.watch.shift_reopened()
        self.evaluator.reopened(f.state.t_s)

    def _restart(self, f: CalibrationFilter) -> None:
        """Nothing explains the images: start again from new data."""
        if f.unobservable is not None:  # nothing has changed: the guesses were wrong
            self.filter = None
            self._initializer.anew()
            return
        before = self._past.filter(f)
        sound = before if before.finite() else None
        if sound is not None:
            self.rig.start_from_lenses_of(sound.state)
        self._change = None
        self._late.anew()
        self.evaluator.changed(self.watch.why)
        self._stale, self.filter = sound, None
        self._initializer = self._new_initializer(sound.off if sound else ())

    def _seek(self, f: CalibrationFilter, lost: MotionRestart, camera: str) -> MotionRestart:
        """Find the time shift of a camera from the images collected, once they suffice.

        After its clock was set, or in another recording.
        """
        if isinstance(lost, RecordingStart):
            fit, more = lost.shift(f.state, self._buffer, camera)
            if fit is None and more:
                return lost
        else:
            own = [x for x in lost.frames if x[1].camera == camera]
            if len(lost.frames) < MIN_ORIENTATIONS:
                return lost
            fit = self._past.shift_of(own, f, self._buffer, self.rig.target)
        self._seek_shift.discard(camera)
        if fit is None:
            return lost
        self._set_shift(f, camera, fit)
        again = MotionRestart(self.rig.target, self._used_ns)
        if isinstance(lost, RecordingStart):
            again = RecordingStart(self.rig.target, self._used_ns, seeking=bool(self._seek_shift))
        self._lost, cameras = again, f.state.cameras
        for t_cam_s, frame in sorted(lost.frames, key=lambda x: x[0] + cameras[x[1].camera].timeshift_s):
            again.take(frame, t_cam_s, f.state, self._buffer)
        return again

    @property
    def can_go_on(self) -> bool:
        """Whether another recording can continue this calibration: no direction is unobservable."""
        return self.filter is not None and self.filter.unobservable is None

    def next_recording(self, *, common_clock: bool = True) -> None:
        """Continue with another recording of the same rig; call `finish` first.

        Cameras (mounting, lens, time shift), IMU and target are the same; motion, biases and the direction of
        gravity in the target's frame are new. If the calibration cannot continue, nothing is kept.

        Args:
            common_clock: The time shift is the same, too; otherwise it is estimated again.
        """
        if not self.can_go_on:
            self.filter = None
        f = self.filter
        cameras = self.rig.layout.cameras
        for name, where in cameras.items():
            if f is not None:
                f.state.cameras[name].timeshift_s += self._intake.offset_s(name)
            if f is not None and where.timeshift is not None:  # drivers find the clock once more
                f.reopen(where.timeshift, abs(self._intake.imu_stepped_s))
        self._intake.next_recording()
        self._pending = FrameQueue(list(self.rig.priors))
        self._past, self._change = RecentPast(), None
        self._used_ns.clear()
        self._seek_shift.clear()
        self._initializer.anew()
        self._late.anew()
        self._held_back, self._lost = HoldoutCheck(), None
        if f is not None:
            self.watch.shift_reopened()
            self._seek_shift |= f.drifting  # who knows how far, in the time between
            if not common_clock:
                self._seek_shift |= {n for n, c in cameras.items() if c.timeshift is not None}
            self._seek_shift -= f.absent
            self._lost = RecordingStart(self.rig.target, {}, seeking=bool(self._seek_shift))

    # ------------------------------------------------------------------ output
    def estimate(self) -> CalibrationEstimate:
        """Return the present estimate."""
        self.evaluator.clocks_doubtful = self.watch.doubtful
        estimate = self.evaluator.estimate(self.filter, self._stale)
        return self._intake.by_present_stamps(estimate, self.options.targets.timeshift_s)

    def held_out(self) -> list[HeldOutCheck]:
        """Return how well the IMU alone predicted images before they were used, oldest first."""
        return list(self.evaluator.held_out)
