"""The table of keys: name, type, rate and delivery rules of every message on the bus.

`TOPICS` lists every message of the system. Publishers take priority and congestion rule from it, the
recorder takes what to record, and the bus takes which last values to keep.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

from vical_daemon.bus import messages

ROOT = "vical"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}")


class TopicError(ValueError):
    """A name that cannot be part of a key; the message states the rule."""


class Priority(StrEnum):
    """Order of delivery when a link is busy; names as in zenoh."""

    REAL_TIME = "REAL_TIME"
    DATA_HIGH = "DATA_HIGH"
    DATA = "DATA"
    DATA_LOW = "DATA_LOW"


class Congestion(StrEnum):
    """What a publisher does when a link is full: wait, or drop the message."""

    BLOCK = "BLOCK"
    DROP = "DROP"


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the table.

    Attributes:
        kind: Short name of the row, e.g. ``imu``.
        pattern: Key with ``{rig}`` and, where there are several, ``{name}``.
        type_name: ROS 2 message type.
        rate_hz: Nominal rate.
        priority: Order of delivery on a busy link.
        congestion: Wait or drop.
        recorded: Recorded, unless the config disables it.
        keep_last: Late subscribers can query the last value.
        depth: Queue length that a subscriber should have.
    """

    kind: str
    pattern: str
    type_name: str
    rate_hz: float
    priority: Priority
    congestion: Congestion
    recorded: bool
    keep_last: bool
    depth: int

    def key(self, rig: str, name: str = "") -> str:
        """Return the key for one rig and device.

        Raises:
            TopicError: A name that cannot be part of a key.
        """
        check_name(rig)
        if "{name}" in self.pattern:
            check_name(name)
        return self.pattern.format(rig=rig, name=name)


@dataclass(frozen=True, slots=True)
class ParsedKey:
    """The parts of a key: rig, topic, and name of device or role ("" if none)."""

    rig: str
    topic: Topic
    name: str


def _row(
    kind: str, tail: str, type_name: str, rate_hz: float, priority: Priority, congestion: Congestion, *,
    recorded: bool = True, keep_last: bool = False, depth: int = 64,
) -> Topic:  # fmt: skip
    pattern = f"{ROOT}/{{rig}}/{tail}"
    return Topic(kind, pattern, type_name, rate_hz, priority, congestion, recorded, keep_last, depth)


_RT, _HIGH, _DATA, _LOW = Priority.REAL_TIME, Priority.DATA_HIGH, Priority.DATA, Priority.DATA_LOW
_BLOCK, _DROP = Congestion.BLOCK, Congestion.DROP

IMU = _row("imu", "imu/{name}", messages.IMU_TYPE, 500, _RT, _BLOCK, depth=8192)
IMAGE = _row("image", "camera/{name}/image", messages.IMAGE_TYPE, 30, _DATA, _DROP, depth=32)
COMPRESSED = _row(
    "compressed", "camera/{name}/image/compressed", messages.COMPRESSED_IMAGE_TYPE, 30, _DATA, _DROP, depth=32
)
CAMERA_INFO = _row(
    "camera_info", "camera/{name}/camera_info", messages.CAMERA_INFO_TYPE, 1, _DATA, _DROP, keep_last=True
)
POINTS = _row("points", "camera/{name}/points", messages.POINTS_TYPE, 30, _HIGH, _BLOCK, depth=256)
TRACKS = _row("tracks", "camera/{name}/tracks", messages.TRACKS_TYPE, 30, _HIGH, _BLOCK, depth=256)
PREDICTED = _row("predicted", "camera/{name}/predicted", messages.POINTS_TYPE, 5, _DATA, _DROP)
CALIBRATION = _row(
    "calibration", "calibration/{name}", messages.CALIBRATION_TYPE, 5, _HIGH, _BLOCK, keep_last=True
)
STORED = _row(
    "stored", "calibration/{name}/stored", messages.CALIBRATION_TYPE, 0, _DATA, _BLOCK,
    recorded=False, keep_last=True,
)  # fmt: skip
VERIFY = _row("verify", "calibration/{name}/verify", messages.VERIFY_TYPE, 1, _DATA, _BLOCK, keep_last=True)
POSE = _row("pose", "calibration/{name}/pose", messages.POSE_TYPE, 5, _DATA, _DROP, keep_last=True)
TF_STATIC = _row("tf_static", "tf_static", messages.TF_TYPE, 0.2, _DATA, _BLOCK, keep_last=True)
STATUS = _row("status", "status/{name}", messages.DIAGNOSTICS_TYPE, 1, _DATA, _DROP, keep_last=True)
COMMAND = _row("command", "command/{name}", messages.STRING_TYPE, 0, _HIGH, _BLOCK)

TOPICS: tuple[Topic, ...] = (
    IMU, IMAGE, COMPRESSED, CAMERA_INFO, POINTS, TRACKS, PREDICTED, CALIBRATION, STORED, VERIFY,
    POSE, TF_STATIC, STATUS, COMMAND,
)  # fmt: skip
BY_KIND: dict[str, Topic] = {topic.kind: topic for topic in TOPICS}

_PATTERNS = tuple(
    (
        re.compile(topic.pattern.format(rig=f"(?P<rig>{_NAME.pattern})", name=f"(?P<name>{_NAME.pattern})")),
        topic,
    )
    for topic in TOPICS
)


def check_name(name: str) -> str:
    """Return the name of a rig, device or role if it may be part of a key.

    Letters, digits and ``_``, beginning with a letter, at most 63: valid in zenoh, in ROS and as a file
    name. So a name cannot leave its key or its folder.

    Raises:
        TopicError: It may not.
    """
    if not _NAME.fullmatch(name):
        raise TopicError(
            f"'{name[:80]}' is no valid name: use letters, digits and _, begin with a letter, at most 63"
        )
    return name


@lru_cache(maxsize=1024)
def parse_key(key: str) -> ParsedKey | None:
    """Return the parts of a key; None for a key that is not in the table, or with an invalid name.

    >>> parsed = parse_key("vical/rig0/imu/imu0")
    >>> parsed.rig, parsed.topic.kind, parsed.name
    ('rig0', 'imu', 'imu0')
    """
    for pattern, topic in _PATTERNS:
        match = pattern.fullmatch(key)
        if match:
            parts = match.groupdict()
            return ParsedKey(parts["rig"], topic, parts.get("name", ""))
    return None


def rig_expression(rig: str) -> str:
    """Return the key expression that matches all keys of one rig."""
    return f"{ROOT}/{check_name(rig)}/**"
