"""Calibration without a target: tracks of unknown points and an IMU in, calibration out. No clock, no I/O.

Flow: buffer -> `TargetFreeInitializer` (rotations and delay from the epipolar constraint, then speed, gravity
and structure linearly) -> one inertial bundle adjustment per window of a few seconds, grown as images arrive
-> what the window knows is carried into the next as a prior on tilt, speed, biases and calibration. How far a
window's own data moved the calibration, against how far they may, says whether to believe it.
[docs/math/target_free.md]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.events import Cause
from vical_daemon.estimation.filter.image_pace import Thinning
from vical_daemon.estimation.filter.sensor_intake import SensorIntake
from vical_daemon.estimation.filter.unobservable_directions import has_turned
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import (
    LEAST_POINTS,
    CalibrationOptions,
    CameraPrior,
    Frames,
    PointsFrame,
)
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.model.priors import WINDOW_START
from vical_daemon.estimation.model.state import make_layout
from vical_daemon.estimation.noise.lens_limit import LensMisfit
from vical_daemon.estimation.result import CalibrationEstimate, HeldOutCheck
from vical_daemon.estimation.robust import MOST_STEPS
from vical_daemon.estimation.selection.model_selection import IMU, LAG, SIZE_EFFECT
from vical_daemon.estimation.significance import LIKELY_SIGMAS
from vical_daemon.estimation.smoother.bundle import LEAST_PARALLAX, Bundle, Fit, window_reports
from vical_daemon.estimation.smoother.changed_blocks import changed_blocks, clock, mounting
from vical_daemon.estimation.smoother.clock_changes import opened
from vical_daemon.estimation.smoother.first_window import DOES_NOT_FIT, Begun, FirstWindow
from vical_daemon.estimation.smoother.marginal_prior import (
    BIASES,
    CORE,
    MarginalPrior,
    calibration_difference,
    next_window,
    with_process_noise,
)
from vical_daemon.estimation.smoother.normal import ImageNoise
from vical_daemon.estimation.smoother.target_free_initializer import TargetFreeInitializer
from vical_daemon.estimation.smoother.target_free_status import TargetFreeStatus
from vical_daemon.estimation.smoother.window import SLACK_S, STEP_S, Ready, Window, cleaned, ready
from vical_daemon.estimation.status.evaluator import PATIENCE_S

MAX_RATE_HZ = 23.0  # images beyond are thinned
WINDOW_FRAMES = 61  # a window is closed at this many images or at this age: its cost grows with the cube
WINDOW_S = 6.0  # likewise, see `WINDOW_FRAMES`
_KEEP_S = 2.0 * WINDOW_S  # of images that wait for a start or for inertial data
_ALWAYS = frozenset({IMU, LAG, SIZE_EFFECT, "readout"})  # is estimated besides what is asked for


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
        ((self.camera, given),) = cameras.items()
        prior = given.with_next_term()
        lens = FixedLens.considered(prior, options.fix)
        self.layout = make_layout(
            {self.camera: prior.distortion_model},
            fix=options.fix,
            estimate=_ALWAYS,
            held=None if lens is None else {self.camera: lens},
            core=CORE,
        )
        rolling = "readout" in options.estimate or prior.readout_s != 0.0
        self.evaluator = TargetFreeStatus(options, self.layout, rolling=rolling)
        self._first = FirstWindow(options, prior, self.layout, self.evaluator)
        self.window: Window | None = None
        self.carry: MarginalPrior | None = None  # before the window
        self.latest: MarginalPrior | None = None  # after its last adjustment
        self._closed = 0
        self._noise = ImageNoise(options.corner_sigma_px)
        self._misfit = LensMisfit()
        self._intake = SensorIntake()
        self._pending: Frames = []
        self._fitted_s = -np.inf  # stamp of the last image that fitted
        self._confirmed = False  # a second window contradicts what was known
        self._seek_shift = False  # the time shift is to be found again, and its step has been reported
        self._newest_s = -np.inf  # stamp of the last image, used or not
        self._thinning = Thinning()
        self._reports: list[FrameReport] = []
        self._stepped_s = 0.0  # by how much the imu's stamps were moved in the recording before
        self._anew = False  # another recording begins: its biases are not known
        self.window_closed: Callable[[Window, Fit], None] | None = None  # is given each complete window

    # ------------------------------------------------------------------ input
    def stamps_known_to(self, sigma_s: float) -> None:
        """Take how well the imu's driver knows its device's clock now, one sigma, s; nonsense is ignored."""
        if self._intake.stamps_known_to(sigma_s):
            self.evaluator.models.stamp_sigma_s = sigma_s

    def add_imu(self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]) -> None:
        """Take one reading (imu clock, ns; rad/s; m/s^2); old or non-finite ones are only counted."""
        for reading in self._intake.take_imu(t_imu_ns, gyro_rps, specific_force_mps2):
            self.evaluator.saw_reading(*reading[:3])
        self.evaluator.announce_all(self._intake.imu_news())

    @property
    def initializer(self) -> TargetFreeInitializer:
        """What tries to start."""
        return self._first.initializer

    @property
    def _buffer(self) -> ImuBuffer:
        """Readings, once there are any."""
        assert self._intake.buffer is not None
        return self._intake.buffer

    def add_points(self, frame: PointsFrame) -> None:
        """Take the tracks of one image; those of other cameras, or out of order, are only counted."""
        count, frame = len(frame.ids), cleaned(frame)
        nonsense = count > 0 and not len(frame.ids)  # its stamp is worth no more than its tracks
        if frame.camera != self.camera or not self._intake.takes_images or nonsense:
            self._intake.images_ignored += 1
            return
        t_cam_s = self._intake.take_image(frame)
        self.evaluator.announce_all(self._intake.image_news())
        if t_cam_s is None or t_cam_s <= self._newest_s:
            self._intake.images_ignored += 1
            return
        if self._intake.clock_was_set(frame.camera):
            self._clock_was_set()
        self._newest_s = t_cam_s
        if not self._thinning.takes(t_cam_s, 1.0 / MAX_RATE_HZ):
            return
        self.evaluator.saw_points(t_cam_s, len(frame.ids))
        if len(frame.ids) >= LEAST_POINTS:
            self._pending.append((t_cam_s, frame))

    def _clock_was_set(self) -> None:
        """Stamps have moved by seconds: the time shift is known only roughly until images show it."""
        self._pending.clear()
        if self.latest is not None:
            self._lost(Cause.CLOCK_SET, keep=True)
            self.evaluator.contradicted(0.0)
        self._seek_shift = self.latest is not None

    def do_without(self, cameras: frozenset[str]) -> None:
        """Nothing comes from these cameras now; one camera alone waits for no other."""

    @property
    def waiting(self) -> int:
        """Images that wait for inertial data; before there is a window, all are tried again and again."""
        return 0 if self.window is None else len(self._pending)

    @property
    def left_out(self) -> dict[str, int]:
        """Readings and images that were not used, by cause."""
        return self._intake.left_out

    # ------------------------------------------------------------------ work
    def process(self) -> list[FrameReport]:
        """Do what can be done with what has arrived; reports on the images of windows that are complete."""
        return self._work(flush=False)

    def finish(self) -> list[FrameReport]:
        """End of the data: everything that inertial data cover."""
        return self._work(flush=True)

    def _work(self, *, flush: bool) -> list[FrameReport]:
        if self._intake.buffer is None:
            return []
        while True:
            window = self.window
            if window is None:
                if not self._try_start(flush):
                    break
                continue
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
        """Images about which a window finds readings, at most a step's worth, up to the first gap."""
        end_s = self._buffer.settled_s - window.shift_s - WINDOW_START.readout_s
        found = ready(self._pending, window.frames[-1][0], end_s)
        if found.hole_s:
            self._lost(Cause.NO_IMAGES, float(found.hole_s), keep=True)
        return found

    def _trim(self) -> None:
        """Memory stays bounded whatever happens."""
        newest = self._buffer.newest_s
        if self.window is None:
            self._pending = [x for x in self._pending if x[0] > newest - _KEEP_S]
            self._buffer.trim(newest - 2.0 * _KEEP_S)
        else:
            self._buffer.trim(self.window.frames[0][0] + self.window.shift_s - 2.0)

    # ------------------------------------------------------------------ start
    def _try_start(self, flush: bool) -> bool:
        """Attempt to start from what waits; True when there is a window now."""
        end = self._buffer.settled_s - WINDOW_START.readout_s
        known = self.latest
        self._buffer.cut(self._intake.gap_end_s)  # a start needs motion in one piece
        hint = None if self._anew else known
        frames = self.initializer.stretch(self._buffer, self._pending, end, hint, last=flush)
        if frames is None:
            return False
        begun = frames if isinstance(frames, str) else self._begin(self._buffer, frames, known)
        if isinstance(begun, str):
            self.evaluator.waiting(begun, self.initializer.motion_missing)
            return False
        window, fit = begun.bundle.window, begun.fit
        self._fitted_s = last = window.frames[-1][0]
        self._pending = [x for x in self._pending if x[0] > last]
        self.window, self.carry, self.latest = window, begun.bundle.carry, fit.carry
        self._noise = fit.noise
        self._anew = False
        self.evaluator.held = self.initializer.held
        self.evaluator.started(window.frames[0][0])
        self.evaluator.saw_fit(fit, last + window.shift_s)
        if _full(window):
            self._close(fit, begun.bundle)
        return True

    def _begin(self, buffer: ImuBuffer, frames: Frames, known: MarginalPrior | None) -> Begun | str:
        """Start a window from a stretch: the first of all, of another recording, or after a pause."""
        if known is None:
            return self._first.begin(buffer, frames, None, self._noise)
        found = self._first.of_another(buffer, frames, known, self._stepped_s) if self._anew else known
        return found if isinstance(found, str) else self._go_on(buffer, frames, found)

    def _go_on(self, buffer: ImuBuffer, frames: Frames, known: MarginalPrior) -> Begun | str:
        """Start a window after a pause; where it contradicts what was known, find what has changed."""
        surely = self._seek_shift or self._confirmed
        begun = DOES_NOT_FIT if surely else self._first.begin(buffer, frames, known, self._noise)
        if isinstance(begun, Begun):
            return begun
        if begun is DOES_NOT_FIT:
            self.evaluator.contradicted(frames[-1][0] - frames[0][0])
        if self.evaluator.against_s > PATIENCE_S:
            return self._all_anew(buffer, frames)
        changed = self._after_change(buffer, frames, known)
        return changed or self._new_biases(buffer, frames, known) or begun

    def _all_anew(self, buffer: ImuBuffer, frames: Frames) -> Begun | str:
        """Start a window from nothing: neither another mounting nor another clock explains the images."""
        held, anew = self.initializer.held, self._first.begin(buffer, frames, None, self._noise)
        if isinstance(anew, Begun):
            self._closed, self._confirmed, self._seek_shift = 0, False, False
            self.evaluator.changed()
        else:
            self.initializer.held = held
        return anew

    def _after_change(self, buffer: ImuBuffer, frames: Frames, known: MarginalPrior) -> Begun | None:
        """Start a window that keeps what has not changed; None where that does not fit either.

        An adjustment with mounting and clock free shows which of them has changed; a second one finds it.
        """
        window = self.initializer.window_anew(buffer, frames, known)
        if isinstance(window, str):
            return None
        arm, shift = mounting(self.layout), clock(self.layout)
        free = self._first.adjusted(buffer, window, known, self._noise, arm + shift)
        if free is None:
            return None
        known, found = known.at(window.frames[0][0]), free.fit.carry.at(window.frames[0][0])
        change = calibration_difference(window, known)
        covariances = found.covariance(), known.covariance()
        reopened = set(changed_blocks(change, *covariances, self.layout, self.evaluator.excess))
        if self._seek_shift:
            reopened |= set(shift)
        moved = not reopened.isdisjoint(arm)
        if moved and not self.evaluator.proven:
            self._forget()
            return None
        ended = self._first.adjusted(buffer, window, known, self._noise, reopened)
        if ended is None:
            return None
        change = calibration_difference(window, known)
        change[[k for k in arm + shift if k not in reopened]] = 0.0
        if moved:
            self.evaluator.changed(change)
        elif reopened and not self._seek_shift:
            self.evaluator.stepped(float(change[shift[0]]))
        self._seek_shift = self._confirmed = False
        return ended

    def _new_biases(self, buffer: ImuBuffer, frames: Frames, known: MarginalPrior) -> Begun | None:
        """Start a window that keeps all but the biases, as in another recording; None: it does not fit."""
        if self.latest is None or self._seek_shift:
            return None
        found = self._first.of_another(buffer, frames, known, 0.0)
        begun = found if isinstance(found, str) else self._first.begin(buffer, frames, found, self._noise)
        if isinstance(begun, str):
            return None
        off = begun.bundle.window.bias[0] - known.bias
        sigmas = np.sqrt(np.diag(begun.fit.carry.covariance() + known.covariance())[BIASES])
        if not (np.abs(off) > LIKELY_SIGMAS * sigmas).any():
            return None
        self.evaluator.biases_stepped(float(np.linalg.norm(off[:3])))
        self._confirmed = False
        return begun

    # ------------------------------------------------------------------ windows
    def _grow(self, window: Window, frames: Frames) -> None:
        """Take images into the window and adjust it; close it when it is long enough."""
        assert self.carry is not None
        added = window.extend(self._buffer, frames)
        done = {id(f) for _, f in frames[:added]}
        self._pending = [x for x in self._pending if id(x[1]) not in done]
        if added < len(frames):
            self._lost(Cause.INERTIAL_GAP, keep=True)
            return
        against_s = frames[-1][0] - self._fitted_s
        if len(window.frames) < 8:
            return
        bundle = Bundle(window, self.carry, self._noise)
        fit = bundle.solve(self._buffer, MOST_STEPS if _full(window) else MOST_STEPS // 2)
        if fit is None:
            self._lost(Cause.TOO_FEW_FEATURES)
            return
        if not fit.settled:  # gross outliers among the new features; the next images may tell
            if _full(window):
                self._lost(Cause.FEATURES_CONTRADICT, against_s=against_s)
            return
        if not self.evaluator.fits(fit):
            self._lost(*self.evaluator.misfit, against_s=against_s)
            return
        if self.initializer.held is not None and has_turned(window.R, self.initializer.held):
            self._start_whole()
            return
        if self._closed and not self._agrees(fit, self.carry, complete=_full(window)):
            self._lost(Cause.WINDOW_CONTRADICTED, against_s=against_s)
            return
        self.latest, self._noise = fit.carry, fit.noise
        self._fitted_s = window.frames[-1][0]
        self.evaluator.saw_fit(fit, self._fitted_s + window.shift_s)
        if _full(window):
            self._close(fit, bundle)

    def _agrees(self, fit: Fit, carry: MarginalPrior, *, complete: bool) -> bool:
        """Whether a window agrees with what was known of the calibration, as far as it shows that."""
        if fit.parallax < LEAST_PARALLAX:
            return True
        return self.evaluator.agrees(fit, carry, complete=complete)

    def _close(self, fit: Fit, bundle: Bundle) -> None:
        """Carry what the window knows into the next."""
        window = bundle.window
        if fit.parallax < LEAST_PARALLAX:
            self.latest = bundle.carry if self._closed else None
            self._lost(Cause.NO_PARALLAX)
            return
        anew = self._first.by_columns(self._buffer, bundle, fit)
        if anew is not None:
            bundle, fit = anew
            window, self._closed = bundle.window, 0
            self.evaluator.lost(Cause.COLUMNS_READ, None, None)
            self.evaluator.started(window.frames[0][0])
            self.evaluator.saw_fit(fit, window.frames[-1][0] + window.shift_s)
            self.latest, self._noise = fit.carry, fit.noise
        self._closed += 1
        self.evaluator.closed()
        if self.evaluator.moved():
            self._forget()
            return
        self._learn_lens(window, bundle, fit)
        if self.window_closed is not None:
            self.window_closed(window, fit)
        if bundle.view is not None:
            self._reports += window_reports(bundle.problem, bundle.view)
        carry, noise = self.evaluator.window_done(fit.carry), self.options.imu_noise
        drifting = self.evaluator.models.drifting
        self.carry = opened(with_process_noise(carry, noise, window.span_s, drifting=drifting))
        self.window = next_window(window, self.carry)

    def _learn_lens(self, window: Window, bundle: Bundle, fit: Fit) -> None:
        """Learn from a complete window by how much the lens model misses."""
        if not len(fit.own_lens):
            return
        root, information = bundle.problem.lens_root, np.linalg.inv(fit.own_lens)
        own, weighted = information - root.T @ root, information @ window.own_lens
        self._misfit.learn(root * fit.noise.lens_px, own, weighted)
        self._noise = self._noise._replace(lens_px=self._misfit.px)

    def _forget(self) -> None:
        """What was kept over a change contradicts the images, too: start over."""
        self._first.anew()
        self._drop()
        self._confirmed = False
        self.evaluator.changed()

    def _start_whole(self) -> None:
        """After a partial start, the rig turns about a second axis: all of the calibration will show."""
        self._drop()
        self.initializer.attempts.anew()
        self.evaluator.lost(Cause.SECOND_AXIS, None, None)

    def _drop(self) -> None:
        """Keep nothing of what was found."""
        self.window = self.carry = self.latest = None
        self._closed = 0

    def _lost(
        self, why: Cause, value: float | None = None, *, keep: bool = False, against_s: float = 0.0
    ) -> None:
        """Go back to waiting; the calibration stays as before this window, or as adjusted last (`keep`).

        Args:
            why: Cause.
            value: Its figure.
            keep: The window as adjusted last was good.
            against_s: For how long images have contradicted the calibration, s; 0: they do not.
        """
        window, unproven = self.window, against_s > 0.0 and not self.evaluator.proven
        self.window = None
        if window is not None and against_s and self.evaluator.against_s:
            self._confirmed = True
            self._pending = [*window.frames, *self._pending]  # all of them after the change
        if window is not None and self.carry is not None:
            if keep:
                self._closed += 1
                self.evaluator.closed()
            else:
                self.latest = self.carry if self._closed else None
        if unproven:  # one window stands against one: neither is known to be right
            self.latest, self._closed, self._confirmed = None, 0, False
        self.carry = None
        if self.latest is not None:
            self.latest = self.evaluator.settled(self.latest)
        self.initializer.attempts.anew()
        self.evaluator.lost(why, value, self.latest, against_s)

    @property
    def can_go_on(self) -> bool:
        """Whether another recording can continue this calibration: no direction of it is unknown."""
        return self.latest is not None and self.initializer.held is None

    def next_recording(self, *, common_clock: bool = True) -> None:
        """What comes from now on is another recording of the same rig; see `Calibrator.next_recording`."""
        if self.can_go_on:
            self._lost(Cause.NONE, keep=True)
        if not self.can_go_on:
            self._drop()
        if self.latest is not None:
            camera, offset_s = self.latest.camera, self._intake.offset_s(self.camera)
            self.latest.camera = replace(camera, timeshift_s=camera.timeshift_s + offset_s)
        self._anew = self.latest is not None
        self.initializer.attempts.anew()
        self.evaluator.next_recording()
        self._stepped_s = abs(self._intake.imu_stepped_s)
        self._intake.next_recording()
        self._pending = []
        self._newest_s = self._fitted_s = -np.inf
        self._confirmed, self._seek_shift = False, self._anew and not common_clock

    # ------------------------------------------------------------------ output
    def estimate(self) -> CalibrationEstimate:
        """Return what is known now; takes the events since the last call along."""
        gravity = [] if self.latest is None else [0.0, 0.0, -self.options.gravity_mps2]
        known, newest_s = self.latest, -np.inf if self._intake.buffer is None else self._buffer.newest_s
        estimate = self.evaluator.estimate(known, newest_s, running=self.window is not None, gravity=gravity)
        return self._intake.by_present_stamps(estimate, self.options.targets.timeshift_s)

    def held_out(self) -> list[HeldOutCheck]:
        """Return nothing: there is no such check without a target."""
        return []


def _full(window: Window) -> bool:
    """Whether the next step would make the window too long."""
    step = STEP_S / max(window.span_s, 1e-3) * len(window.frames)
    return window.span_s + 0.5 * STEP_S > WINDOW_S or len(window.frames) + 0.5 * step > WINDOW_FRAMES
