"""Decides when the rig has changed, and what to do about it.

After a large jump images are refused. A smaller one raises the innovations (CUSUM in `Consistency`). A time
shift that begins to drift, or steps by a little, shows in its drift (`DriftWatch`). At the first signs the
calibrator looks for what has jumped (`what_jumped`). If nothing explains refused images, the pose is found
again. Calibration starts over only if images are refused even then, or if nothing explains why the CUSUM has
fired.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import Enum, auto

import numpy as np

from vical_daemon.estimation.events import Cause
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.priors import SURE
from vical_daemon.estimation.noise.consistency import Consistency
from vical_daemon.estimation.selection.clock_drift import apart, stamps_variance
from vical_daemon.estimation.significance import EVERY_S, PERHAPS_SIGMAS, SURE_SIGMAS
from vical_daemon.estimation.status.recent_past import BEFORE_S

_SPAN = 20  # estimates that are compared, one a second
IMAGES = 10
"""Images refused in a row after which the pose is found again, and images after an alarm that show what has
changed."""
_SOON_S = BEFORE_S + EVERY_S
"""For so long after a pose that was found again, s, images refused in a row do not mean a lost pose: the
filters that are remembered (`RecentPast`) may be from before."""
_DRIFT_FLOOR = 1e-6  # s/s; a crystal in still air changes by less in the 20 s that are looked back at


@dataclass(slots=True)
class DriftWatch:
    """Notices that a parameter taken as constant moves, by two estimates of one filter, some time apart.

    For a consistent filter their difference has the variance P_earlier - P_later, however small the filter
    believes its error to be. [Hausman, "Specification tests in econometrics", 1978, applied to a filter]

    Attributes:
        floor: Smallest standard deviation of a difference that is taken seriously, in the parameter's unit.
        doubtful: The last estimate lies further off than chance would have it, though not yet surely.
    """

    floor: float
    doubtful: bool = False
    _past: deque[tuple[float, float, float]] = field(default_factory=lambda: deque(maxlen=_SPAN))

    def due(self, t_s: float) -> bool:
        """Whether it is time for the next estimate; more would only be more of the same."""
        return not self._past or t_s >= self._past[-1][0] + EVERY_S

    def drifts(self, t_s: float, value: float, variance: float, factor: float, walk: float = 0.0) -> bool:
        """Take the estimate at `t_s`; True when it has left where an earlier one said it would be.

        Args:
            t_s: Time of the estimate, s.
            value: Estimate.
            variance: The filter's own.
            factor: Measured correlation factor (`Consistency.factor`), widens the test.
            walk: Variance that the parameter may gain in a second.
        """
        if not self.due(t_s):
            return False
        far = 0.0
        for at_s, old, old_variance in self._past:
            gained = factor * max(old_variance + walk * (t_s - at_s) - variance, 0.0)
            far = max(far, abs(value - old) / np.sqrt(gained + self.floor**2))
        self._past.append((t_s, value, variance))
        self.doubtful = bool(far > PERHAPS_SIGMAS)
        return bool(far > SURE_SIGMAS)


class Action(Enum):
    """What is to be done after an image.

    ASK, POSE and RESTART look for what has jumped first. If nothing explains the images, ASK does nothing,
    POSE finds the pose again, and RESTART starts over. SKEW: the clocks run apart. WANDER: their drift has
    changed.
    """

    NONE = auto()
    ASK = auto()
    POSE = auto()
    RESTART = auto()
    SKEW = auto()
    WANDER = auto()

    @property
    def asks(self) -> bool:
        """Whether to look for what has jumped."""
        return self in (Action.ASK, Action.POSE, Action.RESTART)


def suspect(f: CalibrationFilter, frame: PointsFrame) -> str:
    """Return the camera whose images fit least since the first sign of a change; at a tie that of `frame`."""
    return max([frame.camera, *f.consistency], key=lambda name: f.consistency[name].suspicion)


@dataclass(slots=True)
class ChangeWatch:
    """Follows the verdicts on the images of all cameras.

    Attributes:
        why: Cause of the last restart.
    """

    why: Cause = Cause.NONE
    _refused: dict[str, int] = field(default_factory=dict)  # in a row, by camera
    _closer: int = 0  # images until what has changed is decided; 0: nothing has
    _suspected: int = 0  # images since something may have changed; 0: nothing may
    _suspected_s: float = float("-inf")
    _ask_at: int = 0
    _pose_taken_s: float = float("-inf")  # or looked for
    _motion_taken_s: float = float("-inf")
    _drift: dict[str, DriftWatch] = field(default_factory=dict)

    def started(self) -> None:
        """A filter starts."""
        self.shift_reopened()
        self._pose_taken_s = self._motion_taken_s = float("-inf")

    def motion_restarted(self, t_s: float) -> None:
        """The motion was taken from images at `t_s`: if images do not fit now, it is not the pose."""
        self._refused.clear()
        self._closer = self._suspected = 0
        self._pose_taken_s = self._motion_taken_s = t_s

    def motion_is_new(self, t_s: float) -> bool:
        """Whether the motion was taken from images within the last seconds."""
        return t_s < self._motion_taken_s + _SOON_S

    def shift_reopened(self) -> None:
        """A time shift is to be found again: what is known of its drift no longer holds."""
        self._refused.clear()
        self._closer = self._suspected = 0
        self._drift.clear()

    @property
    def doubtful(self) -> bool:
        """A time shift may be drifting: too early to say so, too likely to ignore."""
        return any(w.doubtful for w in self._drift.values())

    @property
    def undecided(self) -> bool:
        """Something may have changed: what, is not known yet."""
        return bool(self._closer or any(self._refused.values()) or self._suspected)

    def look(self, report: FrameReport, f: CalibrationFilter, *, early: bool) -> Action:
        """Say what is to be done after this image.

        Args:
            report: Its verdict.
            f: The filter after it.
            early: Look for what has jumped at the first signs. In the first seconds of a calibration they
                are more likely to be errors of lens and target that last, which are not measured yet.
        """
        t = f.state.t_s
        refused = self._refused.get(report.camera, 0) + 1
        self._refused[report.camera] = 0 if report.used else refused
        consistency = f.consistency[report.camera]
        if not report.used:
            consistency.refused()
        soon = t < self._pose_taken_s + _SOON_S
        if not report.used and refused >= IMAGES:
            self._refused[report.camera] = 0
            self.why = Cause.IMAGES_REFUSED
            if soon:
                return Action.RESTART
            self._pose_taken_s = t
            return Action.POSE
        if consistency.alarmed:
            consistency.alarm = 0.0
            if not self._closer:
                self._closer = IMAGES
        if self._closer:
            self._closer -= 1
            if not self._closer:
                self.why = Cause.IMAGES_DISAGREE
                return Action.RESTART
        if early and self._asks(consistency, t):
            return Action.ASK
        if self.undecided:
            return Action.NONE
        return self._look_for_drift(report.camera, f)

    def _asks(self, consistency: Consistency, t_s: float) -> bool:
        """Whether to look now for what has jumped: 10 images after the first sign, 20, 40 ..., within 3 s."""
        if t_s > self._suspected_s + BEFORE_S:
            self._suspected = 0
        if not self._suspected and consistency.suspicious:
            self._suspected_s, consistency.suspicion = t_s, 0.0
            self._ask_at = IMAGES
        elif not self._suspected:
            return False
        self._suspected += 1
        if self._suspected < self._ask_at:
            return False
        self._ask_at, self.why = 2 * self._ask_at, Cause.IMAGES_DISAGREE
        return True

    def _look_for_drift(self, camera: str, f: CalibrationFilter) -> Action:
        """See once a second whether the clocks run apart, or a drift is not what it was."""
        index, t_s = f.layout.cameras[camera].skew, f.state.t_s
        if index is None:
            return Action.NONE
        watch = self._drift.setdefault(camera, DriftWatch(_DRIFT_FLOOR))
        if not watch.due(t_s):
            return Action.NONE
        by_stamps = np.sqrt(stamps_variance(f.stamp_sigma_s, t_s - f.began_s))
        watch.floor = float(np.hypot(_DRIFT_FLOOR, by_stamps))
        variance, walk = float(f.S[index] @ f.S[index]), float(f.walk[index])
        skew, factor = f.state.cameras[camera].skew, f.consistency[camera].factor
        changes = watch.drifts(t_s, skew, variance, factor, walk)
        begins = camera not in f.drifting and apart(f, camera) > SURE
        wanders = len(f.wandered.get(camera, ())) > 1
        if changes or ((begins or wanders) and watch.doubtful):
            self._drift.pop(camera)
            return Action.WANDER
        return Action.SKEW if begins else Action.NONE
