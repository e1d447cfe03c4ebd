"""One topic of a message log: what a scan learns about it, and which of its messages are used."""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from vical_daemon.bus.messages import (
    MessageError,
    decode_compressed_image,
    decode_image,
    decode_imu,
    decode_points,
)
from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.logs.encoded_size import HEAD, encoded_size
from vical_daemon.logs.even_images import mark_of
from vical_daemon.logs.model import Kind
from vical_daemon.logs.stamps import main_stretch

_STAMP = struct.Struct("<iI")
_SIZE = struct.Struct("<II")  # height and width of a sensor_msgs/Image, behind its header
_ZSTD = b"\x28\xb5\x2f\xfd"  # RFC 8878
# Offsets of rates and forces from the end of a sensor_msgs/Imu.
_GYRO, _FORCE = slice(-192, -168), slice(-96, -72)
_IMU_NUMBERS = 37 * 8
_ZEROS = bytes(24)
_IN_TURNS = 10
"""Changes of the frame_id from which on devices take turns; a driver that is started anew makes one."""


@dataclass(slots=True)
class Channel:
    """One topic that is used, during the scan.

    Attributes:
        key: Bus key of its messages.
        kind: Of its sensor.
        name: Of its sensor.
        stamps: Of the messages that are used, ns, in the order of the log.
        marks: Of images, see `mark_of`.
        log_times: Of messages whose stamp is 0.
        values: Rates and forces of an imu.
        sizes: How many images have which width and height.
        unreadable: Messages that hold nothing.
        unread_first: How many of them came before the first that was readable, and have stamps.
        problem: Why the first one was unreadable.
        strays: Messages with stamps far from all others.
        within_ns: Where stamps lie that are no strays.
        frames: The frame_ids of an imu, each with its number.
        which: Number of the frame_id of each message.
        turns: How often the frame_id changed.
        head: The last frame_id as it is written, behind its length.
        even_ns: Of each of `stamps` the one to use instead.
        forces: Of each of `stamps`, from another topic; NaN where there is none.
    """

    key: str
    kind: Kind
    name: str
    stamps: array[int] = field(default_factory=lambda: array("q"))
    marks: array[int] = field(default_factory=lambda: array("q"))
    log_times: array[int] = field(default_factory=lambda: array("q"))
    values: bytearray = field(default_factory=bytearray)
    sizes: Counter[tuple[int, int]] = field(default_factory=Counter)
    unreadable: int = 0
    unread_first: int = 0
    problem: str = ""
    strays: int = 0
    within_ns: tuple[int, int] | None = None
    frames: dict[bytes, int] = field(default_factory=dict)
    which: array[int] = field(default_factory=lambda: array("H"))
    turns: int = 0
    head: bytes = b""
    even_ns: IntArray | None = None
    forces: FloatArray | None = None

    @property
    def resolution(self) -> tuple[int, int] | None:
        """Width and height of most images, px; None: not known."""
        return self.sizes.most_common(1)[0][0] if self.sizes else None

    @property
    def as_it_is(self) -> bool:
        """Whether all messages with a stamp are used, with that stamp and these readings."""
        changed = self.even_ns is not None or self.forces is not None
        return not (changed or self.unreadable or self.strays)

    def stamp_of(self, payload: bytes) -> int | None:
        """Return the stamp of a message of this topic; None if it is damaged."""
        return None if self.kind == "imu" and not _holds_readings(payload) else stamp_of(payload)

    def take(self, payload: bytes, log_time_ns: int) -> int | None:
        """Take the next message of the log; its stamp, None if it is not readable."""
        stamp_ns = self.stamp_of(payload)
        if stamp_ns is None or (not self.stamps and not self._readable(payload)):
            self.unreadable += 1
            self.unread_first += stamp_ns is not None
            if self.kind == "imu" and _is_zero(payload):
                self.problem = "all readings are 0"
            if payload.startswith(_ZSTD):
                self.problem = "each is packed by zstd: give the bag with its metadata.yaml"
            return None
        if self.kind == "imu":
            self.values += payload[_GYRO]
            self.values += payload[_FORCE]
            if self.which and payload.startswith(self.head, 12):
                self.which.append(self.which[-1])
            else:
                self._take_frame(payload)
        else:
            self.marks.append(mark_of(payload))
            if self.kind in ("image", "compressed") or not self.sizes:
                size = _size_of(self.kind, payload)
                self.sizes.update([size] if size else [])
        if stamp_ns == 0:
            self.log_times.append(log_time_ns)
        self.stamps.append(stamp_ns)
        return stamp_ns

    def _take_frame(self, payload: bytes) -> None:
        frame = frame_of(payload)
        number = min(self.frames.setdefault(frame, len(self.frames)), 65_535)
        self.turns += bool(self.which) and self.which[-1] != number
        self.which.append(number)
        self.head = payload[12 : 16 + len(frame)]

    def devices(self) -> dict[bytes, Channel]:
        """Return a channel for each frame_id if several devices take turns; else this one."""
        if self.turns < _IN_TURNS:
            return {b"": self}
        of_each, which = {}, np.array(self.which)
        rows, stamps = self.imu_values(), np.array(self.stamps, dtype=np.int64)
        for frame, number in self.frames.items():
            mine = which == number
            of_each[frame] = replace(
                self,
                stamps=array("q", stamps[mine].tolist()),
                values=bytearray(rows[mine].tobytes()),
                unread_first=0,
            )
        return of_each

    def leave_out_strays(self) -> None:
        """Leave out the few messages whose stamps are far from all others."""
        stamps = np.array(self.stamps, dtype=np.int64)
        self.within_ns = main_stretch(stamps)
        if self.within_ns is None:
            return
        low, high = self.within_ns
        kept = (stamps >= low) & (stamps <= high)
        self.strays = int((~kept).sum())
        self.stamps = array("q", stamps[kept].tolist())
        if self.kind == "imu":
            self.values = bytearray(self.imu_values()[kept].tobytes())
        else:
            self.marks = array("q", np.array(self.marks, dtype=np.int64)[kept].tolist())

    def t_ns(self) -> IntArray:
        """Return the stamps to use, in the order of the log, ns, shape (n,)."""
        return np.array(self.stamps, dtype=np.int64) if self.even_ns is None else self.even_ns

    def imu_values(self) -> FloatArray:
        """Return rates and forces of an imu, in the order of the log; shape (n, 6)."""
        values: FloatArray = np.frombuffer(bytes(self.values), dtype="<f8").reshape(-1, 6)
        return values

    def _readable(self, payload: bytes) -> bool:
        """Try the first message of a topic."""
        try:
            if self.kind == "imu":
                decode_imu(payload)
            elif self.kind == "image":
                decode_image(payload).pixels()
            elif self.kind == "compressed":
                decode_compressed_image(payload)
            else:
                decode_points(payload)
        except MessageError as error:
            self.problem = self.problem or str(error)
            return False
        return True


class UsedMessages:
    """Which messages of a topic are used, on a further pass over the log.

    Args:
        channel: As the scan left it.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._unread, self._row = channel.unread_first, -1

    def take(self, payload: bytes) -> tuple[int, int] | None:
        """Return the stamp of the next message, ns, and its row in `Channel.stamps`; None: it is not used."""
        stamp_ns = self._channel.stamp_of(payload)
        if stamp_ns is None:
            return None
        if self._unread:
            self._unread -= 1
            return None
        within_ns = self._channel.within_ns
        if within_ns is not None and not within_ns[0] <= stamp_ns <= within_ns[1]:
            return None
        self._row += 1
        return stamp_ns, self._row


def _size_of(kind: Kind, payload: bytes) -> tuple[int, int] | None:
    """Return width and height of the image of one message, px; None: not known."""
    try:
        if kind == "image":
            behind_name = 16 + int.from_bytes(payload[12:16], "little")
            height, width = _SIZE.unpack_from(payload, behind_name + -behind_name % 4)
            return width, height
        if kind == "compressed":
            return encoded_size(decode_compressed_image(payload).data[:HEAD])
        size = decode_points(payload).image_size
    except (MessageError, struct.error):
        return None
    return size if all(size) else None


def frame_of(payload: bytes) -> bytes:
    """Return the frame_id of a message that begins with a Header, as it is written, with its end."""
    return payload[16 : 16 + int.from_bytes(payload[12:16], "little")]


def stamp_of(payload: bytes) -> int | None:
    """Return the stamp of a message that begins with a Header; None if these bytes hold none."""
    if len(payload) < 12 or payload[:2] != b"\x00\x01":
        return None
    seconds, nanoseconds = _STAMP.unpack_from(payload, 4)
    if nanoseconds >= 1_000_000_000:
        return None
    stamp_ns: int = seconds * 1_000_000_000 + nanoseconds
    return stamp_ns


def with_stamp(payload: bytes, stamp_ns: int) -> bytes:
    """Return a message for which `stamp_of` gives a stamp, with another one."""
    return payload[:4] + _STAMP.pack(*divmod(stamp_ns, 1_000_000_000)) + payload[12:]


def force_of(payload: bytes) -> bytes:
    """Return the specific force of a sensor_msgs/Imu as it is written."""
    return payload[_FORCE]


def with_force(payload: bytes, force: bytes) -> bytes:
    """Return a sensor_msgs/Imu with another specific force, see `force_of`."""
    return payload[: _FORCE.start] + force + payload[_FORCE.stop :]


def negative(force: bytes) -> bytes:
    """Return a specific force, see `force_of`, of the opposite sign."""
    return (-np.frombuffer(force, "<f8")).tobytes()


def _is_zero(payload: bytes) -> bool:
    """Whether all six readings are 0: a device that did not answer, or a sender of orientations alone."""
    return payload[_GYRO] == _ZEROS == payload[_FORCE]


def _holds_readings(payload: bytes) -> bool:
    """Whether these bytes are as long as a sensor_msgs/Imu with this frame id is, with readings."""
    if _is_zero(payload):
        return False
    if len(payload) < 16 + _IMU_NUMBERS:
        return False
    behind_name = 12 + int.from_bytes(payload[12:16], "little")  # counted from behind the encapsulation
    return len(payload) == 4 + behind_name + (-behind_name) % 8 + _IMU_NUMBERS
