"""Several recordings of one rig: do they agree, and what do those that agree give together?

Each recording is calibrated alone, and its result is compared with those of the others. Those that agree
make one calibration, as in `calibrate`. A recording that gives no result alone cannot be compared; it is left
out if the common calibration reports a change within it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.result import CameraEstimate, Status
from vical_daemon.estimation.tools.agreement import Agreement, Difference, agreements, calibrations
from vical_daemon.offline.calibrate import Outcome, Progress, continuous, document, run_job
from vical_daemon.offline.calibration_job import Job

AGREES, DISAGREES, CANNOT_TELL = "agrees", "disagrees", "cannot tell"
_NO_RESULT = (Status.WAITING, Status.INITIALISING, Status.INCONSISTENT)
_CHANGES = (EventKind.BUMPED, EventKind.TIMESHIFT_STEPPED, EventKind.LENS_STEPPED)


@dataclass(slots=True)
class MergeOutcome:
    """What came out.

    Attributes:
        agreements: One for each recording.
        used: Numbers of the recordings in the common calibration.
        outcome: The common calibration; of the first recording alone where none may be merged.
    """

    agreements: list[Agreement]
    used: list[int]
    outcome: Outcome

    @property
    def disagreeing(self) -> list[int]:
        """Numbers of the recordings that disagree."""
        return [k for k, one in enumerate(self.agreements) if one.agrees is False]


def merge(job: Job, progress: Progress, *, keep_frames: bool = False) -> MergeOutcome:
    """Compare recordings, and calibrate from those that agree.

    Args:
        job: Of at least two recordings.
        progress: See `run_job`.
        keep_frames: See `run_job`.
    """
    count = len(job.parts)

    def part_of(begin: float, share: float) -> Progress:
        return lambda done, estimate: progress(begin + share * done, estimate)

    alone = [run_job(job, part_of(0.5 * k / count, 0.5 / count), only=[k]) for k in range(count)]
    found = agreements(calibrations([_result(one) for one in alone], common_clock=job.common_clock))
    used = [k for k, one in enumerate(found) if one.agrees is not False]
    if not any(found[k].agrees for k in used) and any(one.agrees is False for one in found):
        return MergeOutcome(found, [], alone[0])
    files = [[used[k] for k in one] for one in continuous([job.parts[k] for k in used])]
    # those without a result of their own last
    files.sort(key=lambda one: all(found[k].agrees is None for k in one))
    used = [k for one in files for k in one]
    while True:
        outcome = run_job(job, part_of(0.5, 0.5), keep_frames=keep_frames, only=used)
        changed = _changed(outcome, used)
        changed = [k for k in changed if found[k].agrees is None]
        if not changed or len(used) < 3:
            return MergeOutcome(found, used, outcome)
        found[changed[0]] = Agreement(False, -math.inf)
        used.remove(changed[0])


def _result(outcome: Outcome) -> dict[str, CameraEstimate] | None:
    """Cameras of a calibration that is one."""
    estimate = outcome.estimate
    return None if estimate.status in _NO_RESULT else estimate.cameras or None


def _changed(outcome: Outcome, used: list[int]) -> list[int]:
    """Recordings within which a change was reported."""
    times_s = [event.t_s for event in outcome.estimate.events if event.kind in _CHANGES]
    ends_s = [use.begin_s + use.duration_s for use in outcome.inputs]
    return [
        number
        for number, use, end_s in zip(used, outcome.inputs, ends_s, strict=False)
        if any(t_s is not None and use.begin_s <= t_s <= end_s for t_s in times_s)
    ]


def merge_document(job: Job, merged: MergeOutcome) -> dict[str, Any]:
    """Return the result as `vical merge --json` prints it: that of `calibrate`, with a verdict per input."""
    result = document(job, merged.outcome)
    by_path = {entry["path"]: entry for entry in result.get("inputs", [])}
    inputs = []
    for number, (part, one) in enumerate(zip(job.parts, merged.agreements, strict=True)):
        path = str(part.recording.path)
        entry = {"path": path, "used": number in merged.used, "duration_s": part.duration_s}
        if number in merged.used:
            entry |= by_path.get(path, {})
        verdict = CANNOT_TELL if one.agrees is None else AGREES if one.agrees else DISAGREES
        entry |= {
            "verdict": verdict,
            "probability": one.probability,
            "differences": [_difference(difference) for difference in one.differences],
        }
        inputs.append(entry)
    result["inputs"] = inputs
    result["common_clock"] = job.common_clock
    result["disagreeing"] = [inputs[k]["path"] for k in merged.disagreeing]
    if not merged.used:
        reason = "the recordings do not agree, and there are too few to tell which one is wrong"
        result |= {"status": str(Status.INCONSISTENT), "reason": reason, "cameras": {}, "trace": []}
    return result


def _difference(difference: Difference) -> dict[str, Any]:
    entry = asdict(difference)
    del entry["log_probability"]
    return entry | {"probability": difference.probability}


def changed_since(job: Job, merged: MergeOutcome) -> bool:
    """Whether those that disagree are the latest by their stamps: the rig has changed since the others."""
    wrong = merged.disagreeing
    right = [k for k in merged.used if merged.agreements[k].agrees]
    if not wrong or not right:
        return False
    begin_ns = [part.begin_ns for part in job.parts]
    return min(begin_ns[k] for k in wrong) > max(begin_ns[k] for k in right)
