"""Reads message logs: our MCAP, other ROS 2 MCAP and bags, ROS 1 bags. One scan, then as often as wanted."""

from __future__ import annotations

import math
import re
from abc import abstractmethod
from collections.abc import Collection, Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vical_daemon.bus.messages import (
    COMPRESSED_IMAGE_TYPE,
    IMAGE_TYPE,
    IMU_TYPE,
    POINTS_TYPE,
    TRACKS_TYPE,
    MessageError,
    decode_compressed_image,
    decode_image,
)
from vical_daemon.bus.topics import BY_KIND, PREDICTED, STATUS, parse_key
from vical_daemon.estimation.inertial.units import ImuArrays
from vical_daemon.logs.channel import Channel, UsedMessages, frame_of, stamp_of, with_force, with_stamp
from vical_daemon.logs.even_images import CameraStamps, PointReader
from vical_daemon.logs.even_stamps import even_stamps
from vical_daemon.logs.mcap import LogError, LogMessage, LogReader, segments_in, size_now
from vical_daemon.logs.model import (
    Kind,
    OutOfReach,
    Recording,
    RecordingError,
    Stamped,
    Stream,
    in_stamp_order,
    merged,
    preferred,
    stream_statistics,
)
from vical_daemon.logs.ros1_bag import ros2_type, to_cdr
from vical_daemon.logs.stamp_column import coarseness
from vical_daemon.logs.stamps import set_back
from vical_daemon.logs.united_imu import forces_at, lacks

_KIND_OF_TYPE: dict[str, Kind] = {
    IMU_TYPE: "imu",
    IMAGE_TYPE: "image",
    COMPRESSED_IMAGE_TYPE: "compressed",
    POINTS_TYPE: "points",
    TRACKS_TYPE: "tracks",
}
SENSOR_TYPES = frozenset(_KIND_OF_TYPE)
_PLAIN_WORDS = {
    "image_raw",
    "image_mono",
    "image",
    "data",
    "data_raw",
    "raw",
    "compressed",
    "camera",
    "camera_info",
    "imu",
}
_HOLES = 0.01  # share of an image: the edges of what a stereo camera sees are more than that
_RIG = "rig0"
_UNDATED = (
    "its messages have no stamps (header.stamp is 0); the times at which they were recorded are used, so the "
    "delay until then is part of the time shift: fill header.stamp in the driver"
)


def name_of_topic(topic: str, kind: str) -> str:
    """Make a name of a foreign topic (`kind` imu or cam): /cam0/image_raw is cam0, /imu/data becomes imu0."""
    words = [word for word in topic.strip("/").split("/") if word not in _PLAIN_WORDS]
    name = re.sub(r"[^A-Za-z0-9_]", "_", "_".join(words))[:60]
    return name if re.match(r"[A-Za-z]", name) else kind + (name or "0")


class RawMessage(NamedTuple):
    """One message as a log holds it (a tuple because millions of them are made)."""

    topic: str
    type_name: str
    log_time_ns: int
    payload: bytes


def as_cdr(message: LogMessage, types: Collection[str]) -> RawMessage | None:
    """Return a message of an MCAP; of ROS 1 (`mcap convert` of a bag) some types, and others empty.

    Args:
        message: As it is in the log.
        types: Of which the content is wanted.

    Returns:
        None if it is in another encoding.
    """
    channel, payload, kind = message.channel, message.payload, message.channel.type_name
    if channel.encoding == "ros1":
        kind = ros2_type(kind)
        payload = to_cdr(payload, kind, types)
    elif channel.encoding != "cdr":
        return None
    return RawMessage(channel.topic, kind, message.log_time_ns, payload)


class LogRecording(Recording):
    """Base of all logs of ROS messages; a subclass iterates over the messages."""

    def __init__(
        self, path: Path, topics: Collection[str] | None = None, *, as_recorded: bool = False
    ) -> None:
        """Scan the whole log once: which sensors, how many messages, which stamps.

        Args:
            path: File or folder.
            topics: Topics (or names of imus and cameras) to take; None: all that can be used.
            as_recorded: Leave the stamps alone.

        Raises:
            RecordingError: It cannot be read, or holds no usable topic.
        """
        self.path = path
        self.rig = _RIG
        self.warnings = []
        self.stamp_sigma_s = {}
        self.set_back = {}
        self._scanned = False
        self._wanted = None if topics is None else set(topics)
        self._channels: dict[str, Channel] = {}
        self._others: dict[str, str] = {}
        self._statuses: dict[str, str] = {}  # key of each topic with our status messages
        self._undated: set[str] = set()  # topics whose messages are dated by their log times
        self._split: set[str] = set()  # topics on which several devices publish in turns
        self._holes: set[str] = set()  # topics that may show depth by their first image, see `_has_holes`
        self._order = OutOfReach()
        self._scan()
        self._scanned = True
        for channel in self._channels.values():
            self._note_steps(channel)
        if not as_recorded:
            for channel in self._channels.values():
                if channel.kind == "imu":
                    self._even(channel)
            self._even_cameras()
        self._unite()
        self.streams = tuple(
            self._stream(topic, channel) for topic, channel in self._channels.items() if len(channel.stamps)
        )
        if not self.streams:
            raise RecordingError(self._nothing())

    @abstractmethod
    def _raw(self) -> Iterator[RawMessage]:
        """Yield all messages in the order of the log, as CDR."""

    def as_written(self) -> Iterator[RawMessage]:
        """Yield all messages in the order of the log, with the stamps that they were recorded with."""
        return self._raw()

    def _scan(self) -> None:
        for raw in self._dated():
            channel = self._channels.get(raw.topic) or self._meet(raw)
            if channel is None:
                continue
            stamp_ns = channel.take(raw.payload, raw.log_time_ns)
            if stamp_ns is not None:
                self._order.saw(stamp_ns or raw.log_time_ns, raw.log_time_ns)
        for topic, channel in self._channels.items():
            if len(channel.log_times) > 1 and len(channel.log_times) == len(channel.stamps):
                self._undated.add(topic)
                channel.stamps = channel.log_times
                self.warnings.append(f"{channel.name}: {_UNDATED}")
            if channel.unreadable:
                why = f" ({channel.problem})" if channel.problem else ""
                text = f"{channel.name}: {channel.unreadable} unreadable messages left out{why}"
                self.warnings.append(text)
        self._tell_devices_apart()
        self._leave_depth_out()
        for channel in self._channels.values():
            channel.leave_out_strays()
            if back := set_back(channel.t_ns()):
                self.set_back[channel.name] = back
            if channel.strays:
                count = f"{channel.strays} of {channel.strays + len(channel.stamps)} messages"
                self.warnings.append(f"{channel.name}: {count} left out: stamps far from all others, or 0")
            if len(channel.sizes) > 1:
                (size, most), *others = channel.sizes.most_common()
                self.warnings.append(
                    f"{channel.name}: {sum(n for _, n in others)} images are not {size[0]} x {size[1]} as "
                    f"{most} are, and are not used"
                )

    def _leave_depth_out(self) -> None:
        """Leave out images that may show depth, if there are others."""
        cameras = [topic for topic, channel in self._channels.items() if channel.kind != "imu"]
        if self._holes.issuperset(cameras):
            return
        for topic in self._holes.intersection(cameras):
            del self._channels[topic]
            self._others[topic] = IMAGE_TYPE
            self.warnings.append(f"{topic}: images of depth, left out")

    def _tell_devices_apart(self) -> None:
        """Make one imu of each frame_id on a topic on which several publish in turns."""
        for topic, channel in list(self._channels.items()):
            devices = channel.devices()
            if len(devices) == 1:
                continue
            self._split.add(topic)
            del self._channels[topic]
            for frame, part in devices.items():
                part.name = self._name(frame.rstrip(b"\0").decode("utf-8", "replace"), "imu")
                part.key = BY_KIND["imu"].key(self.rig, part.name)
                self._channels[_with_frame(topic, frame)] = part
            names = ", ".join(part.name for part in devices.values())
            self.warnings.append(
                f"{topic}: {len(devices)} devices publish on it in turns; by their frame_id they are {names}"
            )

    def _dated(self) -> Iterator[RawMessage]:
        """Yield all messages; those of topics without stamps have their log times as stamps.

        A second type of message on one topic is a topic of its own, and likewise a second imu, once known.
        """
        types: dict[str, str] = {}
        for raw in self._raw():
            topic = raw.topic
            if raw.type_name in _KIND_OF_TYPE and types.setdefault(topic, raw.type_name) != raw.type_name:
                raw = raw._replace(topic=f"{topic} ({raw.type_name})")
            if raw.topic in self._undated and stamp_of(raw.payload) is not None:
                raw = raw._replace(payload=with_stamp(raw.payload, raw.log_time_ns))
            if topic in self._split:
                raw = raw._replace(topic=_with_frame(topic, frame_of(raw.payload)))
            yield raw

    def _meet(self, raw: RawMessage) -> Channel | None:
        """Classify a topic by its first message."""
        kind = _KIND_OF_TYPE.get(raw.type_name)
        parsed = parse_key(raw.topic.removeprefix("/"))
        ours_but_not_measured = parsed is not None and parsed.topic is PREDICTED
        if kind in ("image", "compressed") and raw.topic not in self._others and _shows_depth(raw):
            self.warnings.append(f"{raw.topic}: images of depth, left out")
            kind = None
        if kind is None or ours_but_not_measured or raw.topic in self._others:
            self._others[raw.topic] = raw.type_name
            if parsed is not None and parsed.topic is STATUS:
                self._statuses[raw.topic] = raw.topic.removeprefix("/")
            return None
        if parsed is not None:
            name, key = parsed.name, raw.topic.removeprefix("/")
        else:
            name = self._name(raw.topic.split(" ")[0], kind)
            key = BY_KIND[kind].key(self.rig, name)
        if self._wanted is not None and not {raw.topic, raw.topic.removeprefix("/"), name} & self._wanted:
            self._others[raw.topic] = raw.type_name
            return None
        if parsed is not None:
            self._belongs_to(parsed.rig, kind, name)
        channel = self._channels[raw.topic] = Channel(key, kind, name)
        if kind == "image" and _has_holes(raw):
            self._holes.add(raw.topic)
        return channel

    def _belongs_to(self, rig: str, kind: Kind, name: str) -> None:
        """Note the rig of a sensor; refuse a second one of its name, with which it would be mixed."""
        if any(c.kind == kind and c.name == name for c in self._channels.values()):
            raise RecordingError(
                f"{self.path} holds {name} of two rigs, {self.rig} and {rig}: give the files of one, "
                "or its topics"
            )
        self.rig = rig

    def _name(self, topic: str, kind: Kind) -> str:
        """Make a name of a foreign topic that no other of its kind has."""
        name = name_of_topic(topic, "imu" if kind == "imu" else "cam")
        taken = {c.name for c in self._channels.values() if c.kind == kind}
        number, free = 2, name
        while free in taken:
            free, number = f"{name}_{number}", number + 1
        return free

    def _note_steps(self, channel: Channel) -> None:
        """Note by how much all stamps may be off together as they are rounded."""
        report, sigma_s = coarseness(channel.t_ns())
        if report:
            self.warnings.append(f"{channel.name}: {report}")
        if sigma_s:
            self.stamp_sigma_s[channel.name] = sigma_s

    def _even(self, channel: Channel) -> None:
        """Put readings that were stamped on arrival on an even grid."""
        stamps, values = np.array(channel.stamps, dtype=np.int64), channel.imu_values()
        if not np.isfinite(values).all():
            return
        even = even_stamps(stamps, values[:, :3])
        if even is not None:
            self.warnings.append(even.describe(channel.name))
            self.stamp_sigma_s[channel.name] = math.hypot(
                self.stamp_sigma_s.get(channel.name, 0.0), even.sigma_s
            )
            channel.even_ns = even.t_ns

    def _unite(self) -> None:
        """Give a gyro without an accelerometer the readings of an accelerometer that has no gyro."""
        imus = {t: c for t, c in self._channels.items() if c.kind == "imu" and c.stamps}
        lacking = {topic: lacks(channel.imu_values()) for topic, channel in imus.items()}
        gyros, accels = ([t for t, x in lacking.items() if x == y] for y in ("accelerometer", "gyro"))
        if len(gyros) != 1 or len(accels) != 1:
            return
        gyro, accel = self._channels[gyros[0]], self._channels.pop(accels[0])
        self._others[accels[0]] = IMU_TYPE
        values = gyro.imu_values().copy()
        values[:, 3:] = forces_at(gyro.t_ns(), accel.t_ns(), accel.imu_values()[:, 3:])
        gyro.forces = values[:, 3:]
        gyro.values = bytearray(values.tobytes())
        self.warnings.append(
            f"{gyro.name}: has no accelerometer; that of {accel.name} is used, interpolated to its stamps"
        )

    def _even_cameras(self) -> None:
        """Put images that were stamped on arrival on the even grid of their camera."""
        images = [(t, c) for t, c in self._channels.items() if c.kind != "imu" and c.stamps]
        for name in dict.fromkeys(channel.name for _, channel in images):
            of_it = [(t, c) for t, c in images if c.name == name]
            topic, channel = of_it[preferred([(c.kind, len(c.stamps)) for _, c in of_it])]
            stamps = CameraStamps(channel.t_ns(), np.array(channel.marks, dtype=np.int64))
            wanted, reader = stamps.wanted, PointReader(channel.kind)
            for raw in self._dated() if wanted else ():
                stamp_ns = stamp_of(raw.payload) if raw.topic == topic else None
                if stamp_ns is not None and stamp_ns in wanted:
                    stamps.take(stamp_ns, reader.read(raw.payload))
            even = stamps.even()
            if even is not None:
                self.warnings.append(even.describe(name, "images"))
                self.stamp_sigma_s[name] = math.hypot(self.stamp_sigma_s.get(name, 0.0), even.sigma_s)
                better = dict(zip(stamps.t_ns.tolist(), even.t_ns.tolist(), strict=True))
                for _, c in of_it:
                    c.even_ns = np.array([better.get(t, t) for t in c.stamps], dtype=np.int64)

    def _stream(self, topic: str, channel: Channel) -> Stream:
        stamps = np.sort(channel.t_ns())
        statistics = stream_statistics(stamps)
        of_images = topic.split(" ")[0] if channel.kind in ("image", "compressed") else ""
        return Stream(
            channel.key, channel.kind, channel.name, topic, *statistics, channel.resolution, topic=of_images
        )

    def _nothing(self) -> str:
        wanted = "sensor_msgs/Imu with Image, CompressedImage or vical_msgs points"
        if self._wanted is not None:
            return f"{self.path}: none of the topics {', '.join(sorted(self._wanted))} holds {wanted}"
        found = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self._others.items())[:8])
        what = found or "; ".join(["no messages at all", *self.warnings])
        return f"{self.path}: no sensor data: expected {wanted}; found {what}"

    def _messages(self, keys: set[str]) -> Iterator[tuple[str, bytes]]:
        # one pass over the log, or one for each stream where they do not lie side by side in it
        passes = [{key} for key in sorted(keys)] if self._order.found else [keys]
        for item in merged(in_stamp_order(self._stamped(part)) for part in passes):
            yield item.key, item.payload

    def _stamped(self, keys: set[str]) -> Iterator[Stamped]:
        used = {t: UsedMessages(c) for t, c in self._channels.items() if not c.as_it_is}
        wanted = {topic: (c.key, c.kind == "imu") for topic, c in self._channels.items() if c.key in keys}
        wanted |= {topic: (key, False) for topic, key in self._statuses.items() if key in keys}
        for raw in self._dated():
            if raw.topic not in wanted:
                continue
            payload, channel = raw.payload, self._channels.get(raw.topic)
            if channel is None or raw.topic not in used:
                stamp_ns = stamp_of(payload)
                if stamp_ns is None:
                    continue
            else:
                taken = used[raw.topic].take(payload)
                if taken is None:
                    continue
                stamp_ns, row = taken
                if channel.even_ns is not None:
                    stamp_ns = int(channel.even_ns[row])
                    payload = with_stamp(payload, stamp_ns)
                if channel.forces is not None:
                    if np.isnan(channel.forces[row, 0]):
                        continue
                    payload = with_force(payload, channel.forces[row].tobytes())
            yield Stamped(stamp_ns, raw.log_time_ns, *wanted[raw.topic], payload)

    def imu_arrays(self, name: str) -> ImuArrays:
        """See `Recording.imu_arrays`; malformed messages are skipped."""
        channel = next(c for c in self._channels.values() if c.kind == "imu" and c.name == name)
        t_ns, values = channel.t_ns(), channel.imu_values()
        good = np.isfinite(values).all(axis=1)
        order = np.argsort(t_ns[good], kind="stable")
        values = values[good][order]
        return ImuArrays(t_ns[good][order], values[:, :3].copy(), values[:, 3:].copy())


def _with_frame(topic: str, frame: bytes) -> str:
    """Name a part of a topic: the messages with one frame_id."""
    return f"{topic} ({frame.rstrip(bytes(1)).decode('utf-8', 'replace')})"


def _shows_depth(raw: RawMessage) -> bool:
    """Whether an image holds distances: `compressedDepth`, 32FC1 (REP 118), or 16 bit on such a topic.

    Thermal cameras send 16UC1, too. (mono16: bags of the RealSense viewer.)
    """
    try:
        if raw.type_name == COMPRESSED_IMAGE_TYPE:
            return "compresseddepth" in decode_compressed_image(raw.payload).format.lower()
        encoding = decode_image(raw.payload).encoding
    except MessageError:
        return False
    return encoding == "32FC1" or (encoding in ("16UC1", "mono16") and "depth" in raw.topic.lower())


def _has_holes(raw: RawMessage) -> bool:
    """Whether an image may hold distances in millimetres (16UC1): where there is none it is 0 (REP 118).

    No pixel of a thermal camera is.
    """
    try:
        image = decode_image(raw.payload)
        return image.encoding == "16UC1" and float(np.mean(image.pixels() == 0)) > _HOLES
    except MessageError:
        return False


class McapRecording(LogRecording):
    """One MCAP file, or a folder of the segments of one recording."""

    def _raw(self) -> Iterator[RawMessage]:
        for path, size in self._files:
            try:
                reader = LogReader(path, size)
                for message in reader.messages():
                    channel, raw = message.channel, as_cdr(message, SENSOR_TYPES)
                    if raw is not None:
                        yield raw
                    else:
                        self._others[channel.topic] = f"{channel.type_name} in {channel.encoding}, not CDR"
            except LogError as error:
                raise RecordingError(str(error)) from None
            if not self._scanned:
                self.warnings.extend(reader.warnings)

    @cached_property
    def _files(self) -> list[tuple[Path, int]]:
        """Files and their sizes when they were first read: a recorder may still write the last one."""
        paths = segments_in(self.path) if self.path.is_dir() else [self.path]
        return [(path, size_now(path)) for path in paths]
