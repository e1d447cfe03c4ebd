"""Checks a calibration in use again and again, each time with data of its own. No I/O, no clock.

One check is `vical verify` on a live stream: an estimator without any prior on mounting and time shift, and
the odds of docs/math/verify.md once a second of data, until they decide. It may be spread over several
stretches of data; the estimator takes them as recordings of one rig. After an answer the next check begins
with a new estimator, so no data are counted twice, and memory stays bounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import Change
from vical_daemon.calibrate.arrival_stamps import LiveStamps
from vical_daemon.calibrate.estimators import make_estimator
from vical_daemon.calibrate.in_use import InUse
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import Config
from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.results.change_odds import Counts
from vical_daemon.results.verifier import Answer, CameraCheck, Verifier
from vical_daemon.results.verify_text import change_text

LOOK_S = 1.0
"""Data between two looks at the odds, s."""
LONGEST_S = 600.0
"""Data of one check, s. A check that is undecided by then begins anew, so that its data are of one day."""
_KINDS = {
    "position": EventKind.CAMERA_MOVED,
    "rotation": EventKind.CAMERA_TURNED,
    "time shift": EventKind.TIMESHIFT_CHANGED,
    "lens": EventKind.LENS_CHANGED,
}


@dataclass(frozen=True, slots=True)
class CameraAnswer:
    """The last answer about one camera.

    Attributes:
        verdict: Of it.
        seconds: Data that it rests on, s.
        changes: What has changed.
        texts: The same in words.
    """

    verdict: Answer = Answer.CANNOT_TELL
    seconds: float = 0.0
    changes: tuple[Change, ...] = ()
    texts: tuple[str, ...] = ()


class Verification:
    """The checks of one calibration.

    `changed` is the answer when two checks in a row say so of a camera: one alone is wrong in one of a
    thousand (`change_odds.FALSE_ALARM`), and there are hundreds of checks a day.

    Args:
        config: The rig.
        in_use: What is checked.
        stamps: Those of the cameras, as known from earlier data.
    """

    def __init__(self, config: Config, in_use: InUse, stamps: LiveStamps | None = None) -> None:
        self._in_use = in_use
        held = "intrinsics" in config.calibration.fix or any(k.lens is None for k in in_use.known.values())
        calibration = replace(config.calibration, fix=("intrinsics",) if held else ())
        self._config, self._held = replace(config, calibration=calibration), held
        counts = config.verify.counts
        self._counts = Counts(
            math.radians(counts.rotation_deg), counts.position_m, counts.timeshift_s, counts.focal_share
        )
        self.answers = {name: CameraAnswer() for name in in_use.known}
        self.checks = 0
        self.answered_ns = 0
        self._suspects: set[str] = set()
        self._events: list[Event] = []
        self._stamps = stamps or LiveStamps()
        self.begin_check()

    def begin_check(self) -> None:
        """Forget the data of the check that is going on."""
        known = self._in_use.known
        self._verifier = Verifier(
            {n: CameraCheck(k.given_lens() if self._held else k, not self._held) for n, k in known.items()},
            self._counts,
        )
        priors = {name: self._in_use.prior(self._config, name) for name in known}
        estimator = make_estimator(self._config, priors)
        self.role = EstimateRole(self._config, estimator, LOOK_S, inspect=self._look, stamps=self._stamps)
        self.used_s = 0.0
        self._decided = False

    def take(self, sample: Sample) -> None:
        """Take one message from the bus."""
        self.role.take(sample)

    def step(self) -> bool:
        """Process what was taken; True: the check has ended, and the next has begun."""
        self.role.step()
        found = self.role.news()
        if found:  # the check up to now rests on other stamps
            self._events += found
            self.begin_check()
        return self._conclude()

    def end_stretch(self) -> None:
        """The next data come after a pause: they go on with this check if it has an estimate already."""
        self.role.finish()
        if self._conclude():
            return
        if self.role.estimator.can_go_on:
            self.role.next_recording()
        else:
            self.begin_check()

    def events(self) -> list[Event]:
        """Return the announcements since the last call."""
        waiting, self._events = self._events, []
        return waiting

    @property
    def verdict(self) -> Answer:
        """The last answer about the whole rig."""
        verdicts = {answer.verdict for answer in self.answers.values()}
        if Answer.CHANGED in verdicts:
            return Answer.CHANGED
        return Answer.HOLDS if verdicts == {Answer.HOLDS} else Answer.CANNOT_TELL

    @property
    def suspected(self) -> bool:
        """Whether the last check found a change, which this one may confirm."""
        return bool(self._suspects) and self.verdict is not Answer.CHANGED

    def probability(self, camera: str) -> float | None:
        """Probability of a change, from the check that is going on; None: it has no odds yet."""
        odds = self._verifier.cameras[camera].odds
        return None if odds is None else odds.probability

    def missing(self, camera: str) -> tuple[str, ...]:
        """Return what would help the check that is going on."""
        estimate, check = self._verifier.latest, self._verifier.cameras[camera]
        if estimate is None or check.answer is not Answer.CANNOT_TELL:
            return ()
        known = estimate.cameras.get(camera)
        texts = [estimate.guidance or (check.why if check.odds is None else "")]
        return tuple(text for text in [*texts, *(known.unobservable if known else [])] if text)

    def _look(self, estimate: CalibrationEstimate) -> CalibrationEstimate:
        if not self._decided:
            self.used_s += LOOK_S
            done = self._verifier.look(estimate)
            self._decided = done or self._verifier.answer is Answer.CHANGED
        return estimate

    def _conclude(self) -> bool:
        """Take the answer of a check that has one, and begin the next."""
        if not self._decided and self.used_s < LONGEST_S:
            return False
        if self._decided and not self._stamps.in_doubt:
            self._answer()
        self.begin_check()
        return True

    def _answer(self) -> None:
        checks, latest = self._verifier.cameras, self._verifier.latest
        assert latest is not None
        changed = {name for name, check in checks.items() if check.answer is Answer.CHANGED}
        confirmed = changed & self._suspects
        self._suspects = changed
        if changed and not confirmed:
            return
        before = self.verdict
        document = self._verifier.document()["cameras"]
        for name, entry in document.items():
            verdict = Answer(entry["verdict"])
            if verdict is Answer.CHANGED and name not in confirmed:
                verdict = Answer.CANNOT_TELL
            changes = entry["changes"] if verdict is Answer.CHANGED else []
            self.answers[name] = CameraAnswer(
                verdict,
                self.used_s,
                tuple(
                    Change(c["what"].replace(" ", ""), c["value"], c["sigma"], tuple(c.get("axis", ())))
                    for c in changes
                ),
                tuple(change_text(c) for c in changes),
            )
            if before is not Answer.CHANGED:
                self._events += [
                    Event(_KINDS[c["what"]], name, c["value"], c["sigma"], cause=Cause.STORED_DIFFERS)
                    for c in changes
                ]
        self.checks += 1
        self.answered_ns = latest.t_ns
        if self.verdict is Answer.HOLDS and before is not Answer.HOLDS:
            self._events.append(Event(EventKind.STORED_HOLDS, value=self.used_s))
