"""vical_msgs/VerifyResult: whether a stored calibration of one camera still holds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from vical_daemon.bus.messages.cdr import CdrReader, CdrWriter, MessageError

VERIFY_TYPE = "vical_msgs/msg/VerifyResult"
VERDICTS = ("holds", "changed", "cannot_tell")
_SMALLEST_CHANGE = 28  # bytes


class CheckState(StrEnum):
    """What the role that verifies is doing."""

    RESTING = "resting"
    CHECKING = "checking"
    CALIBRATING = "calibrating"
    UNABLE = "unable"


@dataclass(frozen=True, slots=True)
class Change:
    """What has changed since a calibration was stored.

    Attributes:
        block: position, rotation, timeshift or lens.
        value: By how much, m, rad, s, or px (RMS over the image).
        sigma: Its standard deviation.
        axis: Unit vector, of a position in the imu frame, of a rotation in the camera frame; (): none.
    """

    block: str
    value: float
    sigma: float
    axis: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class VerifyResult:
    """Whether a stored calibration of one camera still holds; the fields are those of the message.

    Attributes:
        stamp_ns: Newest data looked at, UNIX ns.
        camera: Name of the camera.
        state: What is done now.
        verdict: Last answer, one of `VERDICTS`.
        answered_ns: When it was given, UNIX ns; 0: no answer yet.
        against: What is checked.
        text: All of this in one line.
        probability_changed: From the check that is going on; None: none yet.
        seconds_used: Data in it, s.
        checks: Answers so far.
        changes: Of the last answer, where it is `changed`.
        missing_motion: What would help the check that is going on.
        image_rate_hz: What the detector is asked for now; 0: nothing.
    """

    stamp_ns: int
    camera: str
    state: CheckState
    verdict: str = "cannot_tell"
    answered_ns: int = 0
    against: str = "store"
    text: str = ""
    probability_changed: float | None = None
    seconds_used: float = 0.0
    checks: int = 0
    changes: tuple[Change, ...] = ()
    missing_motion: tuple[str, ...] = ()
    image_rate_hz: float = 0.0


def encode_verification(result: VerifyResult) -> bytes:
    """Build a vical_msgs/VerifyResult.

    Raises:
        MessageError: A verdict that does not exist, or a stamp that ROS 2 cannot express.
    """
    if result.verdict not in VERDICTS:
        raise MessageError(f"verdict {result.verdict!r} does not exist")
    writer = CdrWriter()
    writer.header(result.stamp_ns, result.camera)
    writer.string(str(result.state))
    writer.string(result.verdict)
    writer.stamp(result.answered_ns)
    writer.string(result.against)
    writer.string(result.text)
    writer.scalar("d", math.nan if result.probability_changed is None else result.probability_changed)
    writer.scalar("d", result.seconds_used)
    writer.scalar("Q", result.checks)
    writer.scalar("I", len(result.changes))
    for change in result.changes:
        writer.string(change.block)
        writer.scalar("d", change.value)
        writer.scalar("d", change.sigma)
        writer.sequence(change.axis)
    writer.strings(list(result.missing_motion))
    writer.scalar("d", result.image_rate_hz)
    return writer.finish()


def decode_verification(data: bytes) -> VerifyResult:
    """Read a vical_msgs/VerifyResult.

    Raises:
        MessageError: These bytes are no such message.
    """
    reader = CdrReader(data)
    stamp_ns, camera = reader.header()
    state, verdict = reader.string(), reader.string()
    if state not in set(CheckState) or verdict not in VERDICTS:
        raise MessageError(f"state {state[:40]!r} or verdict {verdict[:40]!r} does not exist")
    answered_ns, against, text = reader.stamp(), reader.string(), reader.string()
    probability, seconds_used, checks = reader.scalar("d"), reader.scalar("d"), reader.scalar("Q")
    changes = tuple(_read_change(reader) for _ in range(reader.count(_SMALLEST_CHANGE)))
    missing, image_rate_hz = tuple(reader.strings()), reader.scalar("d")
    reader.end()
    return VerifyResult(
        stamp_ns,
        camera,
        CheckState(state),
        verdict,
        answered_ns,
        against,
        text,
        probability if math.isfinite(probability) else None,
        seconds_used,
        checks,
        changes,
        missing,
        image_rate_hz,
    )


def _read_change(reader: CdrReader) -> Change:
    block, value, sigma = reader.string(), reader.scalar("d"), reader.scalar("d")
    return Change(block, value, sigma, tuple(reader.sequence().tolist()))
