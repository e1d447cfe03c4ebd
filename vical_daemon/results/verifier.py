"""Does a stored calibration still hold? Looks at estimates as a recording goes on, until the odds decide."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np

from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.results.change_odds import FALSE_ALARM, Counts, Odds, odds
from vical_daemon.results.difference import NotComparableError, difference
from vical_daemon.results.export import rig_from_estimate
from vical_daemon.results.known import BLOCKS, KnownCamera, known_cameras
from vical_daemon.results.pixel_map import lens_displacement_px

UNITS = {"position": "m", "rotation": "rad", "time shift": "s", "lens": "px"}


class Answer(StrEnum):
    """Answers of a verification."""

    HOLDS = "holds"
    CHANGED = "changed"
    CANNOT_TELL = "cannot tell"


@dataclass(slots=True)
class CameraCheck:
    """How one camera stands.

    Attributes:
        stored: The calibration in question.
        lens_asked: Whether its lens is part of the question.
        answer: Answer.
        odds: Odds at the last look; None: no look yet.
        seconds: Data used, s.
        model: Lens model of the recording's estimate.
        why: Why there were no odds.
    """

    stored: KnownCamera
    lens_asked: bool
    answer: Answer = Answer.CANNOT_TELL
    odds: Odds | None = None
    seconds: float = 0.0
    why: str = ""


@dataclass(slots=True)
class Verifier:
    """Compares each estimate of a recording with what is stored, until every camera is decided.

    Attributes:
        cameras: By name.
        counts: What counts as a change.
        latest: Last estimate.
    """

    cameras: dict[str, CameraCheck]
    counts: Counts = field(default_factory=Counts)
    latest: CalibrationEstimate | None = None

    def look(self, estimate: CalibrationEstimate) -> bool:
        """Take an estimate of the recording so far; True: everything is decided."""
        self.latest = estimate
        found = known_cameras(rig_from_estimate(estimate), "the recording") if estimate.cameras else {}
        for name, check in self.cameras.items():
            if check.answer is not Answer.CANNOT_TELL:
                continue
            check.seconds = estimate.duration_s
            if estimate.status is Status.INCONSISTENT or name not in found:
                check.why = estimate.reason or "no calibration from this recording"
                continue
            self._weigh(check, found[name])
        return all(check.answer is not Answer.CANNOT_TELL for check in self.cameras.values())

    def _weigh(self, check: CameraCheck, found: KnownCamera) -> None:
        # lens, board and imu are the same: where this recording is too short to tell, what the other one said
        fits = check.stored.model_fits if found.model_fits is None else found.model_fits
        seconds = math.inf if fits else check.seconds
        try:
            weighed = self._odds(check, found if check.lens_asked else found.without_lens(), seconds)
            if not check.lens_asked:
                # `changed` must stand even if the lens is off; `holds` is said for the lens as given
                taken = self._odds(check, found.given_lens(), seconds)
                weighed = replace(weighed, log_holds=taken.log_holds, visible=taken.visible)
        except NotComparableError as error:
            check.why = str(error)
            return
        check.odds, check.why = weighed, ""
        sure = weighed.log_changed > math.log(len(self.cameras) / FALSE_ALARM)
        # a change that is certain, but of blocks that are known to have changed by less than counts, is none
        may_count = set(weighed.blocks) & set(weighed.undecided)
        if sure and (may_count or _another_lens(check.stored, weighed, self.counts)):
            check.answer = Answer.CHANGED
        elif not weighed.undecided:
            check.answer = Answer.HOLDS

    def _odds(self, check: CameraCheck, found: KnownCamera, seconds: float) -> Odds:
        apart = difference(check.stored, found)
        focal_px = 1.0 if check.stored.lens is None else float(check.stored.lens[0])
        counts = self.counts.of_errors(focal_px, len(apart.d))
        return odds(apart.d, apart.covariance, apart.covariance_a, counts, seconds)

    @property
    def answer(self) -> Answer:
        """Of the whole rig: changed if any camera is, holds if all do."""
        answers = {check.answer for check in self.cameras.values()}
        if Answer.CHANGED in answers:
            return Answer.CHANGED
        return Answer.HOLDS if answers == {Answer.HOLDS} else Answer.CANNOT_TELL

    def document(self) -> dict[str, Any]:
        """The answer as `vical verify --json` prints it."""
        cameras = {name: _camera_document(name, check, self.counts) for name, check in self.cameras.items()}
        estimate = self.latest
        missing = []
        if self.answer is Answer.CANNOT_TELL and estimate is not None:
            missing = [text for text in (estimate.guidance,) if text]
            missing += [text for e in estimate.cameras.values() for text in e.unobservable]
        return {
            "verdict": str(self.answer),
            "probability_changed": max(
                (check.odds.probability for check in self.cameras.values() if check.odds), default=None
            ),
            "changes": [change for camera in cameras.values() for change in camera["changes"]],
            "missing_motion": missing,
            "seconds_used": max((check.seconds for check in self.cameras.values()), default=0.0),
            "cameras": cameras,
        }


def _camera_document(name: str, check: CameraCheck, counts: Counts) -> dict[str, Any]:
    weighed = check.odds
    out: dict[str, Any] = {
        "verdict": str(check.answer),
        "seconds_used": check.seconds,
        "reason": check.why,
        "assumed": list(check.stored.notes),
        "probability_changed": None,
        "changes": [],
        "blocks": {},
    }
    if weighed is None:
        return out
    out["probability_changed"] = weighed.probability
    if check.answer is Answer.CHANGED:
        out["changes"] = [
            {"camera": name} | _change(block, check.stored, weighed) for block in weighed.blocks
        ]
    smallest = _smallest(counts)
    moved = weighed.blocks if check.answer is Answer.CHANGED else ()
    for block in weighed.log_holds:
        unit = smallest[block]
        out["blocks"][block] = {
            "holds": block not in weighed.undecided and block not in moved,
            "counts_from": unit * max(1.0, weighed.floor[block]),
            "visible_from": unit * weighed.visible[block],
            "left_open_by_stored": unit * weighed.floor[block],
            "unit": "of the focal length" if block == "lens" else UNITS[block],
        }
    return out


def _another_lens(stored: KnownCamera, weighed: Odds, counts: Counts) -> bool:
    """Whether a lens projects points as far from where it did as if it were focused by what counts.

    Changes of its distortion alone are none of those that `log_holds` rules out.
    """
    if "lens" not in weighed.blocks or stored.lens is None:
        return False
    moved = weighed.moved[BLOCKS["lens"]]
    P, focused = np.zeros((len(moved), len(moved))), np.zeros(len(moved))
    focused[:2] = counts.lens_share * stored.lens[:2]
    return lens_displacement_px(stored, moved, P)[0] > lens_displacement_px(stored, focused, P)[0]


def _smallest(counts: Counts) -> dict[str, float]:
    """What counts as a change, by block."""
    values = (counts.position_m, counts.rotation_rad, counts.timeshift_s, counts.lens_share)
    return dict(zip(BLOCKS, values, strict=True))


def _change(block: str, stored: KnownCamera, weighed: Odds) -> dict[str, Any]:
    """How far a block has moved, and along which way: length and its sigma."""
    at = BLOCKS[block]
    moved, P = weighed.moved[at], weighed.moved_covariance[at, at]
    if block == "lens":
        size, sigma = lens_displacement_px(stored, moved, P)
        return {"what": block, "value": size, "sigma": sigma, "unit": UNITS[block], "change": moved.tolist()}
    size = float(np.linalg.norm(moved))
    way = moved / max(size, 1e-300)
    value = float(moved[0]) if block == "time shift" else size
    change = {"what": block, "value": value, "sigma": float(np.sqrt(way @ P @ way)), "unit": UNITS[block]}
    return change if block == "time shift" else change | {"axis": way.tolist()}
