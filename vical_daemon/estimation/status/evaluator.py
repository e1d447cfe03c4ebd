"""What both evaluators share: counts, events, verdicts, status without flicker, the estimate put together."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.events import Cause, Event, EventKind, EventLog
from vical_daemon.estimation.guidance import Guidance, WeakDirection
from vical_daemon.estimation.inertial.units import ImuArrays, unit_mistake
from vical_daemon.estimation.measurements import LEAST_POINTS, CalibrationOptions, FloatArray
from vical_daemon.estimation.model.unscented import RIDGE
from vical_daemon.estimation.noise.shared_errors import ANNOUNCED_S
from vical_daemon.estimation.result import NEARLY, CalibrationEstimate, CameraEstimate, ImuEstimate, Status
from vical_daemon.estimation.status.excitation import (
    ALL_WAYS,
    RunningMotion,
    excitation_advice,
    weak_directions,
)
from vical_daemon.estimation.status.reading_sample import ReadingSample
from vical_daemon.estimation.wording import cause_text, direction_line, direction_sigma, guidance_text

STANDS_S = 2.0
"""For so long the data must speak against a converged calibration before it is called converging again, s of
data: twice the second over which noise moves what the evaluators look at."""
_HYSTERESIS = 2.0
"""Sigma over its limit up to which a direction that was known well enough still is."""
CONFIRMING = "sigmas are small; waiting for more data to confirm them"
PATIENCE_S = 15.0
"""So long after it could first have shown, a direction that the motion does not show is called that; and so
long a changed mounting or clock is looked for before anything may have changed."""
LOST = 3.0
"""A direction whose sigma is this many times its limit after the patience is called unobservable."""
_KEPT_NS = 20_000_000  # a reading in so many ns is kept, by which units are checked: hands move up to 5 Hz
_KEPT = 1000  # of these, 20 s
_LEAST_NS = _KEPT * _KEPT_NS // 2  # of readings, by which their unit is judged


class Verdict(NamedTuple):
    """Where a calibration stands by the data up to now.

    Attributes:
        status: Where.
        reason: Why, as text.
        guidance: What to do next.
        against_s: For how long the data speak against a converged calibration already, s of data.
    """

    status: Status
    reason: str = ""
    guidance: Guidance = Guidance()
    against_s: float = 0.0


@dataclass(slots=True)
class SteadyStatus:
    """Follows the verdicts; a converged calibration stays so over a short doubt and a slightly larger sigma.

    Only the step from converged back to converging waits. A contradiction, a lost direction or a changed rig
    shows at once.

    Attributes:
        status: As published last.
    """

    status: Status = Status.WAITING
    _doubted_s: float | None = None

    def reset(self, status: Status) -> None:
        """The rig is not what it was."""
        self.status, self._doubted_s = status, None

    def counted(self, weak: list[WeakDirection]) -> list[WeakDirection]:
        """Return those of the directions above their limits that speak against convergence."""
        if self.status is not Status.CONVERGED:
            return weak
        return [direction for direction in weak if direction.excess > _HYSTERESIS]

    def follow(self, verdict: Verdict, now_s: float) -> Verdict:
        """Return what is to be published.

        Args:
            verdict: By the data up to now.
            now_s: Time of the data, s.
        """
        if self.status is Status.CONVERGED and verdict.status is Status.CONVERGING:
            if self._doubted_s is None:
                self._doubted_s = now_s - verdict.against_s
            if now_s - self._doubted_s < STANDS_S:
                return Verdict(Status.CONVERGED)
        self.reset(verdict.status)
        return verdict


class Evaluator:
    """What evaluators with a target and without share: counts of what came in, events, the steady status.

    Args:
        options: Switches and targets.
        nothing_seen: Reason while no image shows anything.
        squares: How many sums of squares the consistency is the mean of.

    Attributes:
        imu_samples: Readings so far.
        frames_seen: Images with points so far.
        newest_ns: Stamp of the newest reading.
        first_frame_s: When the first image with points came, s; None: none did.
        reason: Why there is no start yet.
        motion_missing: More motion, not more time, would help.
        motion: What the gyro shows of the motion.
        bumped: Why the calibration before was given up, until there is another one.
        believed: It was `converged`, and no data have spoken against its model since. Gaps and steps of a
            clock leave that as it is.
    """

    def __init__(self, options: CalibrationOptions, nothing_seen: str, squares: int) -> None:
        self.options, self._nothing_seen = options, nothing_seen
        self.imu_samples = self.frames_seen = 0
        self.newest_ns = self._first_ns = 0
        self.first_frame_s: float | None = None
        self.reason, self.motion_missing = "", False
        self.motion = RunningMotion()
        self._readings = ReadingSample()
        self._events, self._steady = EventLog(), SteadyStatus()
        self._started_s: float | None = None
        self.bumped = Cause.NONE
        self._kept: deque[tuple[int, Sequence[float], Sequence[float]]] = deque(maxlen=_KEPT)
        self._squares: deque[tuple[float, int]] = deque(maxlen=squares)
        self._ever_converged = self.believed = False
        self._clock_changed_s: deque[float] = deque(maxlen=2)  # when the relation of the clocks last changed

    def saw_reading(self, t_ns: int, gyro: Sequence[float], accel: Sequence[float]) -> None:
        """Count one inertial reading, and keep some."""
        if not self.imu_samples:
            self._first_ns = t_ns
        self.imu_samples += 1
        self.newest_ns = t_ns
        self._events.now_s = elapsed_s = self.elapsed_s
        self.motion.add(elapsed_s, gyro)
        self._readings.add(gyro, accel)
        since_ns = t_ns - self._kept[-1][0] if self._kept else _KEPT_NS
        if since_ns < 0:  # the clock was set back
            self._kept.clear()
        if not self._ever_converged and not 0 <= since_ns < _KEPT_NS:
            self._kept.append((t_ns, gyro, accel))

    def saw_points(self, t_s: float, count: int) -> None:
        """Count one image with `count` points or tracks in it."""
        if count >= LEAST_POINTS:
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
        if event.kind in (EventKind.TIMESHIFT_STEPPED, EventKind.CLOCK_WANDER):
            self._clock_changed_s.append(self.elapsed_s)

    def announce_all(self, events: Iterable[Event]) -> None:
        """Put events into the next estimate."""
        for event in events:
            self.announce(event)

    @property
    def _clock_wanders(self) -> bool:
        """Whether the clocks changed twice, and may well change again: no time as long has passed since."""
        if len(self._clock_changed_s) < 2:
            return False
        before_s, last_s = self._clock_changed_s
        return self.elapsed_s - last_s < last_s - before_s

    def nis_per_dof(self) -> float:
        """Consistency: mean of normalised squares per degree of freedom; 1 when consistent."""
        square, dof = map(sum, zip(*self._squares, strict=True)) if self._squares else (0.0, 0)
        return square / dof if dof else 0.0

    def _announce_jitter(self, camera: str, jitter_s: float) -> None:
        if jitter_s >= ANNOUNCED_S:
            event = Event(EventKind.STAMP_JITTER, camera, float(jitter_s))
            self.announce(event, once=f"jitter {camera}")

    def _change(self, why: Cause, status: Status, camera: str = "") -> None:
        """The rig has changed: the calibration is found again."""
        self.bumped, self._started_s = why, None
        self.announce_change(why, camera)
        self._steady.reset(status)

    def announce_change(self, why: Cause, camera: str = "") -> None:
        """Announce that the rig has changed."""
        self.believed = False
        kind = EventKind.BUMPED if self._ever_converged else EventKind.STARTED_OVER
        self.announce(Event(kind, camera, cause=why))

    def _after_change(self, camera: str = "") -> None:
        """There is a calibration: if another one was given up, that is over."""
        if self.bumped:
            self.announce(Event(EventKind.STARTED_ANEW, camera))
            self.bumped = Cause.NONE

    def _weak(self, e: CameraEstimate, R_imu_cam: FloatArray, gyro_bias: FloatArray) -> list[WeakDirection]:
        """Directions of a camera's pose, and its time shift, that are not known well enough."""
        covariance, targets = np.array(e.T_imu_cam.covariance), self.options.targets
        return weak_directions(covariance, R_imu_cam, e.timeshift_sigma_s, self.motion, targets, gyro_bias)

    def _followed(
        self, verdict: Verdict, R_imu_cam: FloatArray, gyro_bias: FloatArray, camera: str = ""
    ) -> Verdict:
        """Return what is published of a verdict; where motion is missing, with the motion to make now.

        Args:
            verdict: On the data up to now.
            R_imu_cam: Mounting of a camera, shape (3, 3).
            gyro_bias: Shape (3,).
            camera: Its name, if there are several.
        """
        if verdict.guidance:
            advice = excitation_advice(self.motion, R_imu_cam, gyro_bias)
            verdict = verdict._replace(
                guidance=replace(advice, camera=camera) if advice else verdict.guidance
            )
        return self._published(verdict)

    def _published(self, verdict: Verdict) -> Verdict:
        if mistake := self._unit_mistake():
            verdict = Verdict(Status.INCONSISTENT, mistake)
            self.announce(Event(EventKind.IMU_UNITS, said=mistake), once=EventKind.IMU_UNITS)
        reported = self._steady.follow(verdict, self.elapsed_s)
        if self.status == Status.CONVERGED:
            self._ever_converged = self.believed = True
            self._kept.clear()
        return reported

    def _before_start(self) -> Verdict:
        """The estimate before there is a calibration."""
        if self.bumped:
            why = f"{cause_text(self.bumped)}; calibrating again: {self.reason}"
            return Verdict(Status.INCONSISTENT, why)
        if not self.imu_samples:
            return Verdict(Status.WAITING, "no inertial data yet")
        if self.first_frame_s is None:
            return Verdict(Status.WAITING, self._nothing_seen)
        if self.motion_missing and self.elapsed_s - self.first_frame_s > PATIENCE_S:
            advice = excitation_advice(self.motion, None) or ALL_WAYS
            return Verdict(Status.DEGENERATE, self.reason, advice)
        return Verdict(Status.INITIALISING, self.reason or "collecting the first seconds")

    def _unit_mistake(self) -> str:
        """Say what is wrong with units or columns of the latest readings; never once it has converged."""
        if not self._kept or self._kept[-1][0] - self._kept[0][0] < _LEAST_NS:
            return ""
        t_ns, gyro, accel = zip(*self._kept, strict=True)
        return unit_mistake(ImuArrays(np.array(t_ns), np.array(gyro), np.array(accel)))

    @staticmethod
    def _once_known(*, enough: bool, doubt: str, pause: str = "", doubted_s: float = 0.0) -> Verdict:
        """The verdict where all directions are known well enough.

        Args:
            enough: There are data enough to confirm them.
            doubt: What may not be as it is taken to be; empty: nothing.
            pause: As for `lacking_verdict`.
            doubted_s: For how long the data speak for the doubt, s.
        """
        if not enough or doubt:
            return Verdict(Status.CONVERGING, (doubt if enough else CONFIRMING) + pause, against_s=doubted_s)
        return Verdict(Status.CONVERGED, pause.strip(" ()"))

    def _put_together(
        self,
        reported: Verdict,
        cameras: dict[str, CameraEstimate],
        missing: dict[str, list[WeakDirection]],
        *,
        partial: bool,
        frames: int,
        imu: ImuEstimate | None,
        gravity: list[float],
        refused: float,
    ) -> CalibrationEstimate:
        """The estimate as it is published; takes the events along.

        Args:
            reported: Verdict as published.
            cameras: What is known.
            missing: Directions not known well enough, of cameras that are calibrated now.
            partial: The lost ones among them are withheld whatever the status.
            frames: Images used.
            imu: Biases.
            gravity: In the world, m/s^2; empty: not known.
            refused: Share of measurements that were not used.
        """
        if missing and (partial or self.status == Status.DEGENERATE):
            cameras = {name: _withheld(e, missing[name]) for name, e in cameras.items()}
        return CalibrationEstimate(
            self.newest_ns,
            self.status,
            reported.reason,
            self._progress(self.status, bool(missing), [g for gs in missing.values() for g in gs]),
            guidance_text(reported.guidance),
            self.elapsed_s,
            frames,
            self.imu_samples,
            cameras,
            imu,
            gravity,
            self.nis_per_dof(),
            refused,
            self._events.take(),
            reported.guidance,
            self._readings.hashes,
        )

    def _progress(self, status: Status, known: bool, weak: list[WeakDirection]) -> float:
        """How far the calibration is, 0 to 1: logarithmic in the largest sigma over its limit."""
        if status == Status.CONVERGED:
            return 1.0
        if not known:
            return min(0.1, 0.001 * self.frames_seen)
        worst = max((direction.excess for direction in weak), default=1.0)
        return float(np.clip(1.0 - 0.9 * np.log(max(worst, 1.0)) / np.log(100.0), 0.1, NEARLY))


def _withheld(e: CameraEstimate, missing: list[WeakDirection]) -> CameraEstimate:
    lost = [m for m in missing if m.excess > LOST]
    return replace(e, unobservable=[direction_line(m) for m in lost], withheld=lost)


def lens_known(e: CameraEstimate) -> CameraEstimate:
    """The same camera if the errors of its lens were known: pose and time shift given the lens."""
    joint = np.array(e.calibration_covariance)
    lens = 7 + np.flatnonzero(np.diag(joint)[7:])
    scale = np.sqrt(np.diag(joint)[lens])  # pixels and coefficients
    rows = joint[lens] / scale[:, None]
    own = rows[:, lens] / scale + RIDGE * np.eye(len(lens))
    known = joint[:7, :7] - rows[:, :7].T @ np.linalg.solve(own, rows[:, :7])
    pose = replace(e.T_imu_cam, covariance=known[:6, :6].tolist())
    return replace(e, T_imu_cam=pose, timeshift_sigma_s=float(np.sqrt(max(known[6, 6], 0.0))))


def lens_verdict(worst: WeakDirection, camera: str, *, off: bool) -> Verdict:
    """The verdict where nothing is missing but for a fixed lens; `off`: images contradict it."""
    how = "not this camera's" if off else "not known better"
    text = f"{direction_sigma(worst)}, because the fixed lens of {camera} is {how}: estimate it"
    return Verdict(Status.CONVERGING, text)


def lacking_verdict(lacking: list[WeakDirection], *, shown_s: float, pause: str = "") -> Verdict:
    """The verdict on directions that are not known well enough, the worst first.

    Args:
        lacking: These, at least one.
        shown_s: For how long they could have shown, s.
        pause: Why images are not used at present, in words; empty: they are.
    """
    worst = lacking[0]
    if shown_s > PATIENCE_S and worst.excess > LOST:
        names = "; ".join(direction_sigma(g) for g in lacking[:3])
        return Verdict(Status.DEGENERATE, f"the motion does not show: {names}" + pause, worst.guidance)
    return Verdict(Status.CONVERGING, direction_sigma(worst) + pause, worst.guidance)
