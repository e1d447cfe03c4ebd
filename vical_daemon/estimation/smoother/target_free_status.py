"""Says how far to trust a target-free calibration: fits, agreement of windows, status, words."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.guidance import WeakDirection
from vical_daemon.estimation.measurements import CalibrationOptions, FloatArray
from vical_daemon.estimation.model.state import Layout
from vical_daemon.estimation.noise.lens_limit import WINDOWS
from vical_daemon.estimation.noise.shared_errors import ANNOUNCED_S, PERSISTENT
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, Status
from vical_daemon.estimation.selection.clock_drift import CLOCKS_IN_DOUBT
from vical_daemon.estimation.selection.model_selection import IMU
from vical_daemon.estimation.significance import LIKELY_SIGMAS, chi_square_limit
from vical_daemon.estimation.smoother.alternative_models import AlternativeModels
from vical_daemon.estimation.smoother.bundle import Fit
from vical_daemon.estimation.smoother.changed_blocks import MountingWatch, newest_disagree, square_of_change
from vical_daemon.estimation.smoother.clock_changes import compared_by
from vical_daemon.estimation.smoother.marginal_prior import MarginalPrior
from vical_daemon.estimation.smoother.snapshot import camera_estimate, imu_estimate
from vical_daemon.estimation.status.evaluator import (
    STANDS_S,
    Evaluator,
    Verdict,
    lacking_verdict,
    lens_known,
    lens_verdict,
)
from vical_daemon.estimation.wording import cause_text

_ENOUGH_WINDOWS = 2  # the first one shows only what it was fitted to
_MOST_SIGMA_PX = 3.0  # noise of a track beyond which a window has failed; usual trackers have 0.1 to 1 px
_MOST_INERTIAL = 2.5  # likewise, rms of the inertial residuals in their sigmas
_MOST_REFUSED = 0.4  # likewise, share of the sightings left out: with half, either half may be right
_LEARNING = 4  # windows
_MOUNTING_IN_DOUBT = "the mounting still moves: waiting to see whether the camera was moved"
_NEWEST_IN_DOUBT = "the last seconds agree less than usual: waiting to see whether something has changed"
LOOKING_AGAIN = "the last images contradict the calibration: looking for what has changed"


class TargetFreeStatus(Evaluator):
    """Watches what goes in and out of the windows.

    Args:
        options: Switches and targets.
        layout: Where the errors live.
        rolling: The camera is configured with a rolling shutter, or its readout is asked for.
    """

    def __init__(self, options: CalibrationOptions, layout: Layout, *, rolling: bool = False) -> None:
        super().__init__(
            options, "no features have been followed yet: is the picture dark or blurred?", WINDOWS
        )
        (self.camera,), self.layout = layout.cameras, layout
        self.misfit: tuple[Cause, float] = Cause.NONE, 0.0
        self._against_since_s: float | None = None  # images contradict what is known since then
        self._now_s = 0.0
        self._growing = 0.0, 0  # the same of the window that is not complete yet
        self._windows = 0
        self._pixels: deque[tuple[float, int]] = deque(maxlen=10)
        self._refused: deque[tuple[int, int]] = deque(maxlen=10)
        self._sigma_px = self.jitter_s = 0.0
        self._quiet: tuple[Cause, float | None] = Cause.NONE, None  # why images were not used of late
        self._given_up: tuple[Cause, float | None] = Cause.NONE, None
        self.models = AlternativeModels(layout, asked=options.estimate, rolling=rolling)
        self._mounting = MountingWatch()
        self.held: FloatArray | None = None  # axis of the imu along which the lever arm is not known

    # ------------------------------------------------------------------ what happens
    def waiting(self, why: str, motion_missing: bool = False) -> None:
        """See `Evaluator`; also why the calibration before was given up."""
        before = "" if motion_missing or not self._given_up[0] else f"{cause_text(*self._given_up)}; "
        super().waiting(before + why, motion_missing)

    def started(self, t_s: float) -> None:
        """A window runs from `t_s` on."""
        self.reason = ""
        if self._started_s is None:
            self._started_s = t_s
        self._after_change(self.camera)
        if self._quiet[0]:
            cause, value = self._quiet
            self.announce(Event(EventKind.WENT_ON, self.camera, cause=cause, cause_value=value))
            self._quiet = Cause.NONE, None

    def lost(
        self, why: Cause, value: float | None, kept: MarginalPrior | None, against_s: float = 0.0
    ) -> None:
        """The window was given up.

        Args:
            why: Cause.
            value: Its figure.
            kept: The calibration that stays.
            against_s: For how long images have contradicted it, s; 0: they do not.
        """
        if kept is not None and against_s:
            self.contradicted(against_s)
        self.reason, self.motion_missing = cause_text(why, value), False
        if kept is not None and not self._quiet[0]:
            self._quiet = why, value
        if kept is None:
            self._started_s, self._windows, self._given_up = None, 0, (why, value)
            self._against_since_s = None
            self._squares.clear()
            self._growing = 0.0, 0

    def next_recording(self) -> None:
        """Another recording begins: it has not contradicted anything yet."""
        self._against_since_s = None

    def contradicted(self, against_s: float) -> None:
        """Images of the last `against_s` seconds contradict the calibration: not known yet why."""
        if self._against_since_s is None:
            self._against_since_s = self.elapsed_s - against_s

    @property
    def against_s(self) -> float:
        """For how long images have contradicted the calibration, s; 0: they do not."""
        return 0.0 if self._against_since_s is None else self.elapsed_s - self._against_since_s

    @property
    def proven(self) -> bool:
        """Whether windows have confirmed the calibration since it was last found."""
        return self._windows >= _ENOUGH_WINDOWS

    def changed(self, change: FloatArray | None = None) -> None:
        """The rig is not what it was; `change`: of the errors, shape (n,), where known."""
        why = Cause.CALIBRATION_CONTRADICTED
        self._change(why, Status.CONVERGING, self.camera)
        if change is not None:
            self.announce_all(_changes(self.camera, change, self.layout))
        self._quiet, self.models.drifting = (Cause.NONE, None), False
        self._windows, self._against_since_s = 0, None
        self._mounting = MountingWatch()
        self._squares.clear()
        self._growing = 0.0, 0

    def stepped(self, step_s: float) -> None:
        """The time shift stepped, s; the rest is kept."""
        self.announce(Event(EventKind.TIMESHIFT_STEPPED, self.camera, step_s))
        self._quiet, self._against_since_s = (Cause.NONE, None), None

    def biases_stepped(self, gyro_rps: float) -> None:
        """The biases of the imu stepped, the gyro's by so much, rad/s; the rest is kept."""
        self.announce(Event(EventKind.BIASES_STEPPED, value=gyro_rps))
        self._quiet, self._against_since_s = (Cause.NONE, None), None

    # ------------------------------------------------------------------ windows
    def fits(self, fit: Fit, *, first: bool = False) -> bool:
        """Whether a window holds together at all; `misfit` says why not, with the figure."""
        share = fit.refused / max(fit.used + fit.refused, 1)
        usual = _MOST_SIGMA_PX if first or not self._sigma_px else max(_MOST_SIGMA_PX, 3.0 * self._sigma_px)
        self.misfit = Cause.NONE, 0.0
        if fit.noise.sigma_px > usual:
            self.misfit = Cause.FEATURES_MISS, float(fit.noise.sigma_px)
        elif fit.inertial > _MOST_INERTIAL:
            self.misfit = Cause.INERTIAL_MISFIT, float(fit.inertial)
        elif share > _MOST_REFUSED:
            self.misfit = Cause.SCENE_MOVES, float(share)
        elif self._windows and fit.noise.jitter_s > ANNOUNCED_S and fit.noise.alike > PERSISTENT:
            self.misfit = Cause.WINDOW_CONTRADICTED, 0.0  # no jitter: the time shift has changed
        return not self.misfit[0]

    def saw_fit(self, fit: Fit, t_s: float) -> None:
        """Take the result of an adjustment."""
        self._now_s, self._sigma_px, self.jitter_s = t_s, fit.noise.sigma_px, fit.noise.jitter_s
        self._pixels.append((fit.squares, fit.dof))
        self._refused.append((fit.refused, fit.used + fit.refused))
        self.announce_all(self.models.watch(fit.carry, self.factor(), bool(self._squares)))
        models = self.models.weighed(fit.carry, self.factor(), bool(self._squares))
        camera, S = models.averaged
        likely = max(models.weights, key=lambda name: models.weights[name])
        self._mounting.compare(camera, S @ S.T, self.factor(), self.layout.camera, likely)

    def window_done(self, carry: MarginalPrior) -> MarginalPrior:
        """What goes on from a complete window: what happened to the clocks is decided where that is clear."""
        carry, events = self.models.window_done(carry, self.factor())
        self.announce_all(events)
        return carry

    def settled(self, carry: MarginalPrior) -> MarginalPrior:
        """What is known, for a start: the mixture over what may have happened to the clocks."""
        return self.models.settled(carry, self.factor())

    def closed(self) -> None:
        """A window is complete and agreed."""
        self._windows, self._given_up = self._windows + 1, (Cause.NONE, None)
        self._against_since_s = None
        self._announce_jitter(self.camera, self.jitter_s)

    def moved(self) -> bool:
        """Whether a window that is complete now shows, with those before it, that the mounting has moved."""
        if self._windows < _LEARNING:
            return False
        self._mounting.window_done()
        return self._mounting.surely

    def agrees(self, fit: Fit, carry: MarginalPrior, *, complete: bool) -> bool:
        """Compare how far a window moved the calibration with how far its own data may move it.

        For consistent sigmas, cov(new - old) = P_old - P_new, if P_new is by the noise that the weights
        of the pixels are from.

        Args:
            fit: Of the window.
            carry: What was known before.
            complete: It will not grow any more: it counts for the measured variance.
        """
        # at the first image, where the change was taken; of the clocks by what most likely happened to them
        after = fit.counted.at(carry.t_cam_s)
        clocks = self.models.clocks(fit.carry, self.factor())
        change, (P_old, P_new) = compared_by(carry, after, fit.change, clocks)
        statistic, dof = square_of_change(change, P_old, P_new)
        if not dof:
            return True
        agree = self.excess(statistic, dof) <= 1.0
        self._growing = (0.0, 0) if complete else (statistic, dof)
        if complete:
            self._squares.append((min(statistic, self._limit(dof)), dof))
        return agree

    def excess(self, square: float, dof: int) -> float:
        """A sum of squares over the largest that may be chance, given how well windows have agreed so far.

        Args:
            square: Of a change of the calibration, over its covariance.
            dof: Its degrees of freedom.
        """
        return square / self._limit(dof)

    def _limit(self, dof: int) -> float:
        limit = chi_square_limit(dof, LIKELY_SIGMAS) * self.factor()
        # at first not enough is seen to tell a poor model from a changed rig
        return limit if self._windows >= _LEARNING else 50.0 * limit

    def factor(self) -> float:
        """Measured variance over the stated one, at least 1: what windows disagree by counts in full."""
        return _measured_over_stated(self._squares)

    def _reported_factor(self) -> float:
        """What the variances are multiplied by when they are reported.

        Until a second window has confirmed the answer, the window that still grows counts, too.
        """
        if self.proven:
            return self.factor()
        return max(self.factor(), _measured_over_stated([*self._squares, self._growing]))

    # ------------------------------------------------------------------ output
    def estimate(
        self, carry: MarginalPrior | None, newest_s: float, *, running: bool, gravity: list[float]
    ) -> CalibrationEstimate:
        """Put everything together.

        Args:
            carry: What is known; its images are older than the newest reading.
            newest_s: Time of that, s.
            running: Images are being used.
            gravity: In the world, m/s^2, shape (3,); [] before it is known.
        """
        cameras, missing, imu = {}, {}, None
        if carry is None:
            reported = self._published(self._before_start())
        else:
            camera, at = self._camera(carry, newest_s), (carry.camera.R_imu_cam, carry.bias[:3])
            weak = self._weak(camera, *at)
            lens_alone = self.models.lens is not None and not self._weak(lens_known(camera), *at)
            doubt = self.models.reason(carry, self.factor(), believed=self.believed)
            doubt = doubt or (CLOCKS_IN_DOUBT if self._clock_wanders else "")
            changed = self._newest_in_doubt()
            self.believed &= not (doubt or changed)
            stood_s = STANDS_S if changed else 0.0  # windows are longer than that
            verdict = self._decide(running, weak, doubt or changed, stood_s, lens_alone=lens_alone)
            reported = self._followed(verdict, *at)
            cameras, missing = {self.camera: camera}, {self.camera: weak}
            imu = imu_estimate(carry, matrices=IMU in self.models.asked, positions=self.models.axes_apart)
        refused, seen = (sum(x) for x in zip((0, 0), *self._refused, strict=True))
        return self._put_together(
            reported,
            cameras,
            missing,
            partial=False,
            frames=self.frames_seen,
            imu=imu,
            gravity=gravity,
            refused=refused / max(seen, 1),
        )

    def _newest_in_doubt(self) -> str:
        """What the newest windows contradict, if all of them together do, in words; empty: nothing."""
        if self._mounting.doubtful:
            return _MOUNTING_IN_DOUBT
        return _NEWEST_IN_DOUBT if newest_disagree(self._squares, self.factor()) else ""

    def _camera(self, carry: MarginalPrior, newest_s: float = -np.inf) -> CameraEstimate:
        squares, dof = sum(s for s, _ in self._pixels), sum(n for _, n in self._pixels)
        rms_px = self._sigma_px * float(np.sqrt(squares / max(dof, 1)))
        models = self.models.weighed(carry, self._reported_factor(), bool(self._squares))
        later_s = max(newest_s - carry.camera.timeshift_s - carry.t_cam_s, 0.0)
        return camera_estimate(models, self._sigma_px, rms_px, self.held, later_s)

    def _decide(
        self,
        running: bool,
        missing: list[WeakDirection],
        doubt: str,
        doubted_s: float,
        *,
        lens_alone: bool,
    ) -> Verdict:
        """By the data up to now.

        Args:
            running: Images are being used.
            missing: Directions that are not known well enough.
            doubt: What may not be as it is taken to be, or nothing.
            doubted_s: For how long the data speak for that, s.
            lens_alone: Nothing would be missing if the fixed lens were known.
        """
        if not running and self._windows == 0:
            return Verdict(Status.INITIALISING, self.reason)
        if self._against_since_s is not None:
            return Verdict(Status.CONVERGING, LOOKING_AGAIN, against_s=self.against_s)
        pause = "" if running else f" (paused: {self.reason or cause_text(*self._quiet)})"
        missing = self._steady.counted(missing)
        if not missing:
            return self._once_known(enough=self.proven, doubt=doubt, pause=pause, doubted_s=doubted_s)
        if lens_alone:
            return lens_verdict(missing[0], self.camera, off=self.models.lens_off)
        return lacking_verdict(missing, shown_s=self._now_s - (self._started_s or 0.0), pause=pause)


def _measured_over_stated(windows: Iterable[tuple[float, int]]) -> float:
    """Sum of the squared changes over that of their degrees of freedom, at least 1."""
    squares, dof = (sum(x) for x in zip((0.0, 0), *windows, strict=True))
    return max(1.0, squares / dof) if dof else 1.0


def _changes(camera: str, change: FloatArray, layout: Layout) -> list[Event]:
    """A change of the calibration, shape (n,), as events: what moved by how much; zero: it did not."""
    found, where = [], layout.cameras[camera]
    if where.position is not None and where.rotation is not None:
        found.append((EventKind.CAMERA_MOVED, float(np.linalg.norm(change[where.position]))))
        found.append((EventKind.CAMERA_TURNED, float(np.linalg.norm(change[where.rotation]))))
    if where.timeshift is not None:
        found.append((EventKind.TIMESHIFT_CHANGED, float(change[where.timeshift])))
    return [Event(kind, camera, value) for kind, value in found if value]
