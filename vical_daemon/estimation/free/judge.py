"""Says how far to trust a target-free calibration: fits, agreement of windows, status, words."""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.special import chdtri

from vical_daemon.estimation.free.bundle import Fit
from vical_daemon.estimation.free.carry import CALIBRATION, DRIFT, FULL, Carry
from vical_daemon.estimation.free.doubts import FreeDoubts
from vical_daemon.estimation.free.snapshot import camera_estimate, imu_estimate
from vical_daemon.estimation.measurements import BoolArray, CalibrationOptions, FloatArray
from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    Status,
    TracePoint,
)
from vical_daemon.estimation.trace import Trace
from vical_daemon.estimation.trust.missing_motion import Missing, RunningMotion, guidance, shortcoming
from vical_daemon.estimation.trust.stamp_jitter import jitter_told

_PATIENCE_S = 15.0
_LOST = 3.0
_HYSTERESIS = 2.0
_ENOUGH_WINDOWS = 2
_MOST_SIGMA_PX = 3.0
_MOST_INERTIAL = 2.5
_MOST_REFUSED = 0.4
_DOUBT = 1e-5  # chance of a window that disagrees this much
_LEARNING = 4  # windows
_MOST_FACTOR = 100.0
_MODEL_FITS = 1.5  # up to this factor the noise model is taken at its word
_BIG_M, _BIG_RAD, _BIG_S = 5e-3, float(np.deg2rad(0.2)), 5e-4
_TURN_AND_MOVE = "turn the rig about all three axes while moving it to and fro"
_PRIOR_WINDOWS = 4.0  # worth of belief that sigmas are right, in windows


class FreeJudge:
    """Watches what goes in and out of the windows.

    Args:
        options: Switches and targets.
        camera: Name of the camera.
        active: Which of the calibration errors are estimated, shape (FULL,).
        rolling: The camera is said to have a rolling shutter, or its readout is asked for.
    """

    def __init__(
        self, options: CalibrationOptions, camera: str, active: BoolArray, *, rolling: bool = False
    ) -> None:
        self.options, self.camera, self.active = options, camera, active
        self._motion = RunningMotion()
        self.imu_samples = self.imu_refused = self.frames_ignored = self.frames_seen = 0
        self.status = Status.WAITING
        self.events: list[str] = []
        self.misfit = self.disagreement = ""
        self._reason, self._motion_missing = "", False
        self._first_ns = self._newest_ns = 0
        self._first_frame_s: float | None = None
        self._started_s: float | None = None
        self._now_s = 0.0
        self._agreement: deque[tuple[float, int]] = deque(maxlen=40)
        self._windows = 0
        self._squares: deque[tuple[float, int]] = deque(maxlen=10)
        self._refused: deque[tuple[int, int]] = deque(maxlen=10)
        self._sigma_px = self.jitter_s = 0.0
        self._trace = Trace()
        self._ever_converged = False
        self._bumped = ""
        self._quiet = self._given_up = ""
        self._jitter_told = False
        self.doubts = FreeDoubts(camera, asked=options.estimate, rolling=rolling)
        self.held: FloatArray | None = None  # axis of the imu along which the lever arm is not known

    # ------------------------------------------------------------------ what happens
    def saw_imu(self, t_ns: int, gyro: FloatArray) -> None:
        """Count one inertial reading."""
        self._motion.add((t_ns - (self._first_ns or t_ns)) * 1e-9, gyro)
        if not self.imu_samples:
            self._first_ns = t_ns
        self.imu_samples += 1
        self._newest_ns = t_ns

    def saw_points(self, t_s: float, count: int) -> None:
        """Count one image with `count` tracks."""
        if count >= 4:
            self.frames_seen += 1
            if self._first_frame_s is None:
                self._first_frame_s = t_s

    def waiting(self, why: str, motion_missing: bool) -> None:
        """No start yet; `motion_missing`: more motion, not more time, would help."""
        before = "" if motion_missing or not self._given_up else f"{self._given_up}; "
        self._reason, self._motion_missing = before + why, motion_missing

    def started(self, t_s: float) -> None:
        """A window runs from `t_s` on."""
        self._reason = ""
        if self._started_s is None:
            self._started_s = t_s
        if self._bumped:
            self.events.append("started anew after the change")
            self._bumped = ""
        if self._quiet:
            self.events.append(f"went on after: {self._quiet}")
            self._quiet = ""

    def lost(self, why: str, kept: Carry | None) -> None:
        """The window was given up; `kept`: the calibration that stays."""
        self._reason, self._motion_missing = why, False
        if kept is not None and not self._quiet:
            self._quiet = why
        if kept is None:
            self._started_s, self._windows, self._given_up = None, 0, why
            self._agreement.clear()

    def changed(self, why: str) -> None:
        """The rig is not what it was."""
        self.events.append(f"bumped: {why}" if self._ever_converged else f"started over: {why}")
        self._bumped, self._quiet, self.doubts.drifting = why, "", False
        self._started_s, self._windows = None, 0
        self._agreement.clear()

    # ------------------------------------------------------------------ windows
    def fits(self, fit: Fit, *, first: bool = False) -> bool:
        """Whether a window holds together at all; `misfit` says why not."""
        share = fit.refused / max(fit.used + fit.refused, 1)
        usual = _MOST_SIGMA_PX if first or not self._sigma_px else max(_MOST_SIGMA_PX, 3.0 * self._sigma_px)
        self.misfit = ""
        if fit.sigma_px > usual:
            self.misfit = f"features miss their places by {fit.sigma_px:.1f} px"
        elif fit.inertial > _MOST_INERTIAL:
            self.misfit = f"inertial data and images disagree ({fit.inertial:.1f} times their noise)"
        elif share > _MOST_REFUSED:
            self.misfit = f"{share:.0%} of the features do not move with the scene"
        return not self.misfit

    def saw_fit(self, fit: Fit, t_s: float) -> None:
        """Take the result of an adjustment."""
        self._now_s, self._sigma_px, self.jitter_s = t_s, fit.sigma_px, fit.jitter_s
        self._squares.append((fit.squares, fit.dof))
        self._refused.append((fit.refused, fit.used + fit.refused))
        self.events += self.doubts.watch(fit.carry, self.factor(), bool(self._agreement))
        if self._trace.due(t_s):
            self._trace.add(t_s, self._camera(fit.carry), self.nis_per_dof(), self.status)

    def closed(self) -> None:
        """A window is complete and agreed."""
        self._windows, self._given_up = self._windows + 1, ""
        told = jitter_told(self.camera, self.jitter_s)
        if told and not self._jitter_told:
            self._jitter_told = True
            self.events.append(told)

    def agrees(self, fit: Fit, carry: Carry) -> bool:
        """Compare how far a window moved the calibration with how far its own data may move it.

        For consistent sigmas, cov(new - old) = P_old - P_new.
        """
        P_old = carry.covariance()[CALIBRATION:, CALIBRATION:]
        # at the first image, where the change was taken
        P_new = fit.carry.at(carry.t_cam_s).covariance()[CALIBRATION:, CALIBRATION:]
        scale = np.sqrt(np.diag(P_old))
        values, vectors = np.linalg.eigh((P_old - P_new) / np.outer(scale, scale))
        told = values > 0.02  # directions in which the window had something to say
        if not told.any():
            return True
        d = vectors.T @ (fit.change / scale)
        statistic, dof = float((d[told] ** 2 / values[told]).sum()), int(told.sum())
        factor = self.factor()
        limit = float(chdtri(dof, _DOUBT)) * factor
        if self._windows < _LEARNING:  # not enough seen yet to tell a poor model from a changed rig
            limit *= 50.0
        doubtful = statistic > limit and (factor < _MODEL_FITS or self._matters(fit.change))
        self._agreement.append((min(statistic, limit), dof))
        if doubtful:
            self.disagreement = _said(fit.change, self.active)
        return not doubtful

    def _matters(self, change: FloatArray) -> bool:
        """Whether a change is large enough to be a changed rig where the model itself fits poorly."""
        full = np.zeros(FULL)
        full[np.flatnonzero(self.active)] = change
        arm, turn, shift = np.linalg.norm(full[:3]), np.linalg.norm(full[3:6]), abs(full[6])
        return bool(arm > _BIG_M or turn > _BIG_RAD or shift > _BIG_S)

    def factor(self) -> float:
        """Measured variance over the stated one, at least 1 (a prior of a few windows says 1)."""
        dof = float(np.count_nonzero(self.active)) - float(self.active[DRIFT])
        total = sum(s for s, _ in self._agreement) + _PRIOR_WINDOWS * dof
        return max(1.0, total / (sum(n for _, n in self._agreement) + _PRIOR_WINDOWS * dof))

    # ------------------------------------------------------------------ what is said
    def trace(self) -> list[TracePoint]:
        """The development of the calibration."""
        return list(self._trace.points)

    def nis_per_dof(self) -> float:
        """Agreement of the windows: squared change over what it should be; 1 when consistent."""
        dof = sum(n for _, n in self._agreement)
        return sum(s for s, _ in self._agreement) / dof if dof else 0.0

    def estimate(self, carry: Carry | None, *, running: bool, gravity: list[float]) -> CalibrationEstimate:
        """Put everything together."""
        camera = None if carry is None else self._camera(carry)
        missing = [] if camera is None or carry is None else self._missing(camera, carry)
        converged = self.status == Status.CONVERGED
        doubt = "" if carry is None else self.doubts.reason(carry, self.factor(), converged=converged)
        self.status, reason, advice = self._decide(camera is not None, running, missing, doubt)
        if advice and carry is not None:
            advice = shortcoming(self._motion, carry.camera.R_imu_cam, carry.bias[:3]) or advice
        self._ever_converged |= self.status == Status.CONVERGED
        if camera is not None and self.status == Status.DEGENERATE:
            camera.unobservable.extend(str(m) for m in missing if m.excess > _LOST)
        events, self.events = self.events, []
        refused, seen = (sum(x) for x in zip(*self._refused, strict=True)) if self._refused else (0, 0)
        return CalibrationEstimate(
            self._newest_ns,
            self.status,
            reason,
            self._progress(camera is not None, missing),
            advice,
            (self._newest_ns - self._first_ns) * 1e-9,
            self.frames_seen,
            self.imu_samples,
            {} if camera is None else {self.camera: camera},
            None if carry is None else imu_estimate(carry, matrices_told=self.doubts.imu_asked),
            gravity,
            self.nis_per_dof(),
            refused / max(seen, 1),
            events,
        )

    def _camera(self, carry: Carry) -> CameraEstimate:
        squares, dof = sum(s for s, _ in self._squares), sum(n for _, n in self._squares)
        rms_px = self._sigma_px * float(np.sqrt(squares / max(dof, 1)))
        doubts = self.doubts.weighed(carry, self.factor(), bool(self._agreement))
        return camera_estimate(carry, doubts, self._sigma_px, rms_px, self.held)

    def _missing(self, e: CameraEstimate, carry: Carry) -> list[Missing]:
        covariance, R = np.array(e.T_imu_cam.covariance), carry.camera.R_imu_cam
        return guidance(
            covariance, R, e.timeshift_sigma_s, self._motion, self.options.targets, carry.bias[:3]
        )

    def _decide(
        self, known: bool, running: bool, missing: list[Missing], doubt: str
    ) -> tuple[Status, str, str]:
        """Status, reason and guidance; `doubt`: what may not be as it is taken to be, or nothing."""
        if not known:
            return self._before_start()
        if not running and self._windows == 0:
            return Status.INITIALISING, self._reason, ""
        pause = "" if running else f" (paused: {self._reason or self._quiet})"
        if self.status == Status.CONVERGED:
            missing = [g for g in missing if g.excess > _HYSTERESIS]
        if not missing:
            if self._windows < _ENOUGH_WINDOWS:
                return (
                    Status.CONVERGING,
                    "sigmas are small; waiting for more data to confirm them" + pause,
                    "",
                )
            if self.factor() > _MOST_FACTOR:
                return Status.INCONSISTENT, "stretches of the data disagree more than their sigmas say", ""
            if doubt:
                return Status.CONVERGING, doubt + pause, ""
            return Status.CONVERGED, pause.strip(" ()"), ""
        worst = missing[0]
        if self._now_s - (self._started_s or 0.0) > _PATIENCE_S and worst.excess > _LOST:
            names = "; ".join(g.said for g in missing[:3])
            return Status.DEGENERATE, f"the motion does not show: {names}" + pause, worst.motion
        return Status.CONVERGING, worst.said + pause, worst.motion

    def _before_start(self) -> tuple[Status, str, str]:
        if self._bumped:
            return Status.INCONSISTENT, f"{self._bumped}; calibrating anew: {self._reason}", ""
        if not self.imu_samples:
            return Status.WAITING, "no inertial data yet", ""
        if self._first_frame_s is None:
            return Status.WAITING, "no features have been followed yet: is the picture dark or blurred?", ""
        seen_for = (self._newest_ns - self._first_ns) * 1e-9 - self._first_frame_s
        if self._motion_missing and seen_for > _PATIENCE_S:
            advice = shortcoming(self._motion, None) or _TURN_AND_MOVE
            return Status.DEGENERATE, self._reason, advice
        return Status.INITIALISING, self._reason or "collecting the first seconds", ""

    def _progress(self, known: bool, missing: list[Missing]) -> float:
        if self.status == Status.CONVERGED:
            return 1.0
        if not known:
            return min(0.1, 0.001 * self.frames_seen)
        worst = max((g.excess for g in missing), default=1.0)
        return float(np.clip(1.0 - 0.9 * np.log(max(worst, 1.0)) / np.log(100.0), 0.1, 0.95))


def _said(change: FloatArray, active: BoolArray) -> str:
    """A change in words with figures: what moved by how much."""
    full = np.zeros(FULL)
    full[np.flatnonzero(active)] = change
    parts = []
    if active[0]:
        parts.append(f"the camera by {1e3 * np.linalg.norm(full[:3]):.1f} mm")
        parts.append(f"{np.rad2deg(np.linalg.norm(full[3:6])):.2f} deg")
    if active[6]:
        parts.append(f"the time shift by {1e3 * full[6]:+.2f} ms")
    return f"the last seconds move {', '.join(parts)}, more than the sigmas allow"
