"""Calibration without a target: tracks of unknown points and an IMU in, calibration out. No clock, no I/O.

Flow: buffer -> `free.starter.Starter` (rotations and delay from the epipolar constraint, then speed, gravity
and structure linearly) -> one inertial bundle adjustment per window of a few seconds, grown as images arrive
-> what the window knows is carried into the next as a prior on tilt, speed, biases and calibration. How far a
window's own data moved the calibration, against how far they may, says whether to believe it.
[docs/math/target_free.md]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.events import Cause
from vical_daemon.estimation.filter.image_intake import (
    ImageIntake,
    by_present_stamps,
    trace_by_present_stamps,
)
from vical_daemon.estimation.filter.unobservable_directions import has_turned
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.imu_intake import ImuIntake
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.plausible import stamp_sigma_problem
from vical_daemon.estimation.result import CalibrationEstimate, TracePoint
from vical_daemon.estimation.smoother.bundle import Bundle, Fit
from vical_daemon.estimation.smoother.carry import DRIFT, FULL, LENS, SHIFT, Carry
from vical_daemon.estimation.smoother.handover import afresh, aged, next_window, of_another_recording
from vical_daemon.estimation.smoother.judge import FreeJudge
from vical_daemon.estimation.smoother.reports import window_reports
from vical_daemon.estimation.smoother.starter import Starter
from vical_daemon.estimation.smoother.thinning import Thinning
from vical_daemon.estimation.smoother.waiting_tracks import SLACK_S, STEP_S, Ready, Stamped, cleaned, ready
from vical_daemon.estimation.smoother.window import Window

MAX_RATE_HZ = 23.0  # images beyond are thinned
WINDOW_FRAMES = 61  # a window is closed at this many images or at this age: its cost grows with the cube
WINDOW_S = 6.0
_MIN_PARALLAX_DEG = 0.4
_KEEP_S = 12.0
_LATE_S = 0.02  # inertial data must reach this far beyond an image
_LEAST_S = 2.5  # a window shorter than this is not kept when it breaks off
_STEPS_GROW, _STEPS_START = 12, 30


class TargetFreeCalibrator:
    """Calibrates one camera against one IMU, online, from feature tracks.

    Args:
        options: Switches and noise.
        cameras: What is known about the camera (one).

    Raises:
        ValueError: More than one camera, or the size of a target to be found.
    """

    def __init__(self, options: CalibrationOptions, cameras: dict[str, CameraPrior]) -> None:
        if len(cameras) != 1:
            raise ValueError(
                f"target-free calibration takes one camera at a time, not {len(cameras)}; choose one"
            )
        for block in sorted({"target_scale", "target_shape"} & options.estimate):
            raise ValueError(f"without a target there is no {block} to estimate")
        self.options = options
        self.camera, self.prior = next(iter(cameras.items()))
        self.active = np.ones(FULL, dtype=bool)
        self.active[:6] = "extrinsics" not in options.fix
        self.active[[SHIFT, DRIFT]] = "timeshift" not in options.fix
        self.active[LENS] = "intrinsics" not in options.fix
        rolling = "readout" in options.estimate or self.prior.readout_s != 0.0
        self.judge = FreeJudge(options, self.camera, self.active, rolling=rolling)
        self.starter = Starter(options, self.prior)
        self.window: Window | None = None
        self.carry: Carry | None = None  # before the window
        self.latest: Carry | None = None  # after its last adjustment
        self._closed = 0
        self._noise = (options.corner_sigma_px, 1.0, 0.0)  # px, how long errors last, jitter of stamps in s
        self._imu = ImuIntake()
        self._images = ImageIntake()
        self._pending: list[Stamped] = []
        self._newest_s = -np.inf  # stamp of the last image, used or not
        self._thinning = Thinning(MAX_RATE_HZ)
        self._doubted: Carry | None = None
        self._reports: list[FrameReport] = []
        self._stepped_s = 0.0  # by how much stamps of the imu were moved in the recording before
        self._anew = False  # another recording has begun: what it starts with is to be found as in the first

    # ------------------------------------------------------------------ input
    def stamps_known_to(self, sigma_s: float) -> None:
        """Take how well the imu's driver knows its device's clock now, one sigma, s; nonsense is ignored."""
        if stamp_sigma_problem(sigma_s):
            return
        self.judge.doubts.stamp_sigma_s = sigma_s

    def add_imu(self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]) -> None:
        """Take one reading (imu clock, ns; rad/s; m/s^2); old or non-finite ones are only counted."""
        refused = self._imu.refused
        for reading in self._imu.take(t_imu_ns, gyro_rps, specific_force_mps2):
            self.judge.saw_imu(reading.t_imu_ns, reading.gyro_rps)
        self.judge.imu_refused += self._imu.refused - refused
        self.judge.announce_all(self._imu.news())

    @property
    def _buffer(self) -> ImuBuffer | None:
        return self._imu.buffer

    def add_points(self, frame: PointsFrame) -> None:
        """Take the tracks of one image; those of other cameras, or out of order, are only counted."""
        count, frame = len(frame.ids), cleaned(frame)
        nonsense = count > 0 and not len(frame.ids)  # its stamp is worth no more than its tracks
        if frame.camera != self.camera or self._buffer is None or self._imu.between or nonsense:
            self.judge.frames_ignored += 1
            return
        stamp_s = (frame.t_cam_ns - self._imu.base_ns) * 1e-9
        t_cam_s = self._images.take(frame, stamp_s, self._buffer.newest_s)
        self.judge.announce_all(self._images.news())
        if t_cam_s is None or t_cam_s <= self._newest_s:
            self.judge.frames_ignored += 1
            return
        self._newest_s = t_cam_s
        if not self._thinning.takes(t_cam_s):
            return
        self.judge.saw_points(t_cam_s, len(frame.ids))
        if len(frame.ids) >= 4:
            self._pending.append((t_cam_s, frame))

    @property
    def waiting(self) -> int:
        """Images that wait for inertial data; before there is a window, all are tried again and again."""
        return 0 if self.window is None else len(self._pending)

    # ------------------------------------------------------------------ work
    def process(self) -> list[FrameReport]:
        """Do what can be done with what has arrived; reports on the images of windows that are complete."""
        return self._work(flush=False)

    def finish(self) -> list[FrameReport]:
        """End of the data: everything that inertial data cover."""
        return self._work(flush=True)

    def _work(self, *, flush: bool) -> list[FrameReport]:
        if self._buffer is None:
            return []
        while True:
            if self.window is None:
                if not self._try_start(flush):
                    break
                continue
            window = self.window
            found = self._ready(window)
            if not found.frames:
                break
            new_s = found.frames[-1][0] - window.frames[-1][0]
            if new_s < STEP_S - SLACK_S and not (flush or found.gap_follows):
                break
            self._grow(window, found.frames)
        self._trim()
        reports, self._reports = self._reports, []
        return reports

    def _ready(self, window: Window) -> Ready:
        """Images that inertial data cover, at most a step's worth, up to the first gap."""
        assert self._buffer is not None
        end_s = self._buffer.newest_s - window.shift_s - _LATE_S
        found = ready(self._pending, window.frames[-1][0], end_s)
        if found.hole_s:
            self._lost(Cause.NO_IMAGES, float(found.hole_s), keep=True)
        return found

    def _trim(self) -> None:
        """Memory stays bounded whatever happens."""
        assert self._buffer is not None
        newest = self._buffer.newest_s
        if self.window is None:
            self._pending = [x for x in self._pending if x[0] > newest - _KEEP_S]
            self._buffer.trim(newest - 2.0 * _KEEP_S)
        else:
            self._buffer.trim(self.window.frames[0][0] + self.window.shift_s - 2.0)

    # ------------------------------------------------------------------ start
    def _try_start(self, flush: bool) -> bool:
        """Attempt to start from what waits; True when there is a window now."""
        assert self._buffer is not None
        end = self._buffer.newest_s - _LATE_S
        known = self._doubted or self.latest
        hint = None if self._anew else known
        attempt = self.starter.attempt(self._buffer, self._pending, end, hint, last=flush)
        if attempt is None:
            return False
        if isinstance(attempt, str):
            self.judge.waiting(attempt, self.starter.motion_missing)
            return False
        window = attempt
        if self._anew and known is not None:
            if self.starter.held is not None:
                self.judge.waiting(
                    "the rig turns about one axis only so far: turn it about a second one", True
                )
                return False
            known = of_another_recording(known, window, self._stepped_s)
        carry = afresh(window, known, self.active, self.starter.held, self.judge.doubts.imu_sigma)
        bundle = Bundle(window, carry, *self._noise)
        fit = bundle.solve(self._buffer, _STEPS_START)
        if fit is None or not (fit.settled and self.judge.fits(fit, first=True)):
            self.judge.waiting(
                "the first seconds do not fit together yet: keep moving in all directions", True
            )
            return False
        last = window.frames[-1][0]
        self._pending = [x for x in self._pending if x[0] > last]
        self.window, self.carry, self.latest = window, carry, fit.carry
        self._noise = (fit.sigma_px, fit.spread, fit.jitter_s)
        self._closed = 0 if known is None else self._closed
        self._anew = False
        self.judge.held = self.starter.held
        self.judge.started(window.frames[0][0])
        self.judge.saw_fit(fit, last + window.shift_s)
        if _full(window):
            self._close(fit, bundle)
        return True

    # ------------------------------------------------------------------ windows
    def _grow(self, window: Window, frames: list[Stamped]) -> None:
        """Take images into the window and adjust it; close it when it is long enough."""
        assert self._buffer is not None
        assert self.carry is not None
        added = window.extend(self._buffer, frames)
        done = {id(f) for _, f in frames}
        self._pending = [x for x in self._pending if id(x[1]) not in done]
        if added < len(frames):
            self._lost(Cause.INERTIAL_GAP, keep=True)
            return
        if len(window.frames) < 8:
            return
        bundle = Bundle(window, self.carry, *self._noise)
        fit = bundle.solve(self._buffer, 2 * _STEPS_GROW if _full(window) else _STEPS_GROW)
        if fit is None:
            self._lost(Cause.TOO_FEW_FEATURES)
            return
        if not fit.settled:  # gross outliers among the new features; the next images may tell
            if _full(window):
                self._lost(Cause.FEATURES_CONTRADICT)
            return
        if not self.judge.fits(fit):
            self._lost(*self.judge.misfit)
            return
        if self.starter.held is not None and has_turned(window.R, self.starter.held):
            self._start_whole()
            return
        self.latest, self._noise = fit.carry, (fit.sigma_px, fit.spread, fit.jitter_s)
        self.judge.saw_fit(fit, window.frames[-1][0] + window.shift_s)
        if _full(window):
            self._close(fit, bundle)

    def _close(self, fit: Fit, bundle: Bundle) -> None:
        """Carry what the window knows into the next; see whether it agrees with what was known before."""
        window, carry = self.window, self.carry
        assert window is not None
        assert carry is not None
        if fit.parallax_deg < _MIN_PARALLAX_DEG:
            self.latest = carry if self._closed else None
            self._lost(Cause.NO_PARALLAX)
            return
        if self._closed and not self.judge.agrees(fit, carry):
            self._disagreed(carry)
            return
        self._doubted = None
        self._closed += 1
        self.judge.closed()
        if bundle.seen is not None:
            self._reports += window_reports(bundle.problem, bundle.seen)
        drifting, noise = self.judge.doubts.drifting, self.options.imu_noise
        self.carry = aged(fit.carry, noise, self.active, window.span_s, drifting=drifting)
        self.window = next_window(window, self.carry)

    def _disagreed(self, carry: Carry) -> None:
        """A window contradicts what was known: once may be a bad window, twice is a changed rig."""
        if self._doubted is None:
            self._doubted = carry
            self.latest = carry
            self._lost(Cause.WINDOW_CONTRADICTED)
            return
        self._doubted = None
        lens = carry.camera
        self.prior = replace(
            self.prior,
            intrinsics=tuple(lens.intrinsics.tolist()),
            distortion=tuple(lens.distortion.tolist()),
            T_imu_cam=None if self.active[0] else self.prior.T_imu_cam,
            readout_s=lens.readout_s,
        )
        self.starter = Starter(self.options, self.prior)
        self.latest = None
        self._closed = 0
        self.judge.changed()
        self.window = self.carry = None

    def _start_whole(self) -> None:
        """After a partial start, the rig turns about a second axis: all of the calibration will show."""
        self.window = self.carry = self.latest = self._doubted = None
        self._closed = 0
        self.starter.again()
        self.judge.lost(Cause.SECOND_AXIS, None, None)

    def _lost(self, why: Cause, value: float | None = None, *, keep: bool = False) -> None:
        """Go back to waiting; the calibration stays as before this window, or as adjusted last (`keep`)."""
        window = self.window
        self.window = None
        if window is not None and self.carry is not None:
            if keep and window.span_s > _LEAST_S:
                self._closed += 1
                self.judge.closed()
            else:
                self.latest = self.carry if self._closed else None
        self.carry = None
        self.starter.again()
        self.judge.lost(why, value, self.latest)

    @property
    def can_go_on(self) -> bool:
        """Whether another recording can go on with this calibration: no direction of it is unknown."""
        return self.latest is not None and self.starter.held is None

    def next_recording(self) -> None:
        """What comes from now on is another recording of the same rig; see `Calibrator.next_recording`."""
        if self.can_go_on:
            self._lost(Cause.NONE, keep=True)
        if not self.can_go_on:
            self.window = self.carry = self.latest = None
            self._closed = 0
        if self.latest is not None:
            camera = self.latest.camera
            self.latest.camera = replace(camera, timeshift_s=camera.timeshift_s + self._offset_s)
        self._doubted, self._anew = None, self.latest is not None
        self.starter.again()
        self._stepped_s = abs(self._imu.stepped_s)
        self._imu.next_recording()
        self._images, self._pending, self._newest_s = ImageIntake(), [], -np.inf

    # ------------------------------------------------------------------ output
    def estimate(self) -> CalibrationEstimate:
        """Return what is known now; takes the events since the last call along."""
        gravity = [] if self.latest is None else [0.0, 0.0, -self.options.gravity_mps2]
        known = self._doubted or self.latest
        if known is not None and self._buffer is not None:
            known = known.at(self._buffer.newest_s - known.camera.timeshift_s)
        estimate = self.judge.estimate(known, running=self.window is not None, gravity=gravity)
        return by_present_stamps(estimate, {self.camera: self._offset_s}, self.judge.doubts.stamp_sigma_s)

    @property
    def _offset_s(self) -> float:
        """Time shift by the stamps as they come now, minus that of the windows, s."""
        return self._imu.shift_s + self._images.offset_s(self.camera)

    def trace(self, camera: str) -> list[TracePoint]:
        """Return how the calibration developed."""
        if camera != self.camera:
            return []
        return trace_by_present_stamps(self.judge.trace(), self._offset_s)


def _full(window: Window) -> bool:
    """Whether the next step would make the window too long."""
    step = STEP_S / max(window.span_s, 1e-3) * len(window.frames)
    return window.span_s + 0.5 * STEP_S > WINDOW_S or len(window.frames) + 0.5 * step > WINDOW_FRAMES
