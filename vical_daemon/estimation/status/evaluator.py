"""What both evaluators share, and what is said of a calibration that is not there yet."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.events import Cause, Event, EventLog
from vical_daemon.estimation.guidance import WeakDirection
from vical_daemon.estimation.measurements import CalibrationOptions, FloatArray
from vical_daemon.estimation.result import CameraEstimate, Status
from vical_daemon.estimation.status.excitation import (
    ALL_WAYS,
    RunningMotion,
    excitation_advice,
    weak_directions,
)
from vical_daemon.estimation.status.steady_status import SteadyStatus, Verdict
from vical_daemon.estimation.wording import cause_text, direction_sigma

PATIENCE_S = 15.0
"""So long after it could first have shown, a direction that the motion does not show is called that."""
_RIDGE = 1e-12  # of a variance, against rounding
LOST = 3.0
"""A direction whose sigma is this many times its limit after the patience is called unobservable."""


class Evaluator:
    """What evaluators with a target and without share: counts of what came in, events, the steady status.

    Args:
        options: Switches and targets.
        nothing_seen: What is said while no image shows anything.

    Attributes:
        imu_samples: Readings so far.
        frames_seen: Images with points so far.
        newest_ns: Stamp of the newest reading.
        first_frame_s: When the first image with points came, s; None: none did.
        reason: Why there is no start yet.
        motion_missing: More motion, not more time, would help.
        motion: What the gyro shows of the motion.
        believed: It was `converged`, and no data have spoken against its model since. Gaps and steps of a
            clock leave that as it is.
    """

    def __init__(self, options: CalibrationOptions, nothing_seen: str) -> None:
        self.options, self._nothing_seen = options, nothing_seen
        self.imu_samples = self.frames_seen = 0
        self.newest_ns = self._first_ns = 0
        self.first_frame_s: float | None = None
        self.reason, self.motion_missing = "", False
        self.motion = RunningMotion()
        self._events, self._steady = EventLog(), SteadyStatus()
        self._started_s: float | None = None
        self._ever_converged = self.believed = False

    def saw_imu(self, t_ns: int, gyro: FloatArray) -> None:
        """Count one inertial reading."""
        if not self.imu_samples:
            self._first_ns = t_ns
        self.imu_samples += 1
        self.newest_ns = t_ns
        self._events.now_s = self.elapsed_s
        self.motion.add(self.elapsed_s, gyro)

    def saw_points(self, t_s: float, count: int) -> None:
        """Count one image with `count` points or tracks in it."""
        if count >= 4:
            self.frames_seen += 1
            if self.first_frame_s is None:
                self.first_frame_s = t_s

    @property
    def elapsed_s(self) -> float:
        """Time of the data since the first reading, s."""
        return (self.newest_ns - self._first_ns) * 1e-9

    @property
    def status(self) -> Status:
        """Where the calibration stands, as of the last estimate."""
        return self._steady.status

    def waiting(self, why: str, motion_missing: bool = False) -> None:
        """There is no start yet; `motion_missing`: more motion, not more time, would help."""
        self.reason, self.motion_missing = why, motion_missing

    def announce(self, event: Event, once: str = "") -> None:
        """Put an event into the next estimate; of those with the same `once` only the first."""
        self._events.add(event, once)

    def announce_all(self, events: Iterable[Event]) -> None:
        """Put events into the next estimate."""
        for event in events:
            self._events.add(event)

    def _weak(self, e: CameraEstimate, R_imu_cam: FloatArray, gyro_bias: FloatArray) -> list[WeakDirection]:
        """Directions of a camera's pose, and its time shift, that are not known well enough."""
        covariance, targets = np.array(e.T_imu_cam.covariance), self.options.targets
        return weak_directions(covariance, R_imu_cam, e.timeshift_sigma_s, self.motion, targets, gyro_bias)

    def _followed(self, verdict: Verdict, R_imu_cam: FloatArray, gyro_bias: FloatArray) -> Verdict:
        """Return what is published of a verdict; where motion is missing, with the motion to make now."""
        if verdict.guidance:
            advice = excitation_advice(self.motion, R_imu_cam, gyro_bias)
            verdict = verdict._replace(guidance=advice or verdict.guidance)
        return self._published(verdict)

    def _published(self, verdict: Verdict) -> Verdict:
        reported = self._steady.follow(verdict, self.elapsed_s)
        if self.status == Status.CONVERGED:
            self._ever_converged = self.believed = True
        return reported

    def _before_start(self, changed: Cause, trouble: str = "") -> Verdict:
        """What is said before there is a calibration.

        Args:
            changed: Why the one before was given up; none: there was none.
            trouble: What is wrong with the readings; empty: nothing.
        """
        if changed:
            return Verdict(Status.INCONSISTENT, f"{cause_text(changed)}; calibrating anew: {self.reason}")
        if not self.imu_samples:
            return Verdict(Status.WAITING, "no inertial data yet")
        if trouble:
            return Verdict(Status.INCONSISTENT, trouble)
        if self.first_frame_s is None:
            return Verdict(Status.WAITING, self._nothing_seen)
        if self.motion_missing and self.elapsed_s - self.first_frame_s > PATIENCE_S:
            advice = excitation_advice(self.motion, None) or ALL_WAYS
            return Verdict(Status.DEGENERATE, self.reason, advice)
        return Verdict(Status.INITIALISING, self.reason or "collecting the first seconds")

    def _progress(self, status: Status, known: bool, weak: list[WeakDirection]) -> float:
        """How far the calibration is, 0 to 1: logarithmic in the largest sigma over its limit."""
        if status == Status.CONVERGED:
            return 1.0
        if not known:
            return min(0.1, 0.001 * self.frames_seen)
        worst = max((direction.excess for direction in weak), default=1.0)
        return float(np.clip(1.0 - 0.9 * np.log(max(worst, 1.0)) / np.log(100.0), 0.1, 0.95))


def lens_known(e: CameraEstimate) -> CameraEstimate:
    """The same camera if the errors of its lens were known: pose and time shift given the lens."""
    joint = np.array(e.calibration_covariance)
    lens = 7 + np.flatnonzero(np.diag(joint)[7:])
    scale = np.sqrt(np.diag(joint)[lens])  # pixels and coefficients
    rows = joint[lens] / scale[:, None]
    own = rows[:, lens] / scale + _RIDGE * np.eye(len(lens))
    known = joint[:7, :7] - rows[:, :7].T @ np.linalg.solve(own, rows[:, :7])
    pose = replace(e.T_imu_cam, covariance=known[:6, :6].tolist())
    return replace(e, T_imu_cam=pose, timeshift_sigma_s=float(np.sqrt(max(known[6, 6], 0.0))))


def lens_verdict(worst: WeakDirection, camera: str, *, off: bool) -> Verdict:
    """What is said where nothing is missing but for a fixed lens; `off`: images contradict it."""
    how = "not this camera's" if off else "not known better"
    text = f"{direction_sigma(worst)}: the fixed lens of {camera} is {how}: leave it free"
    return Verdict(Status.CONVERGING, text)


def lacking_verdict(lacking: list[WeakDirection], *, patient: bool, pause: str = "") -> Verdict:
    """What is said of directions that are not known well enough, the worst first.

    Args:
        lacking: These, at least one.
        patient: They have had `PATIENCE_S` to show.
        pause: Why images are not used at present, in words; empty: they are.
    """
    worst = lacking[0]
    if patient and worst.excess > LOST:
        names = "; ".join(direction_sigma(g) for g in lacking[:3])
        return Verdict(Status.DEGENERATE, f"the motion does not show: {names}" + pause, worst.guidance)
    return Verdict(Status.CONVERGING, direction_sigma(worst) + pause, worst.guidance)
