"""The interface of every recording: streams, warnings, messages in order of their stamps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from heapq import heappop, heappush, merge
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from vical_daemon.bus.messages import decode_imu, decode_points
from vical_daemon.estimation.inertial.units import ImuArrays
from vical_daemon.estimation.measurements import IntArray, PointsFrame

Kind = Literal["imu", "image", "compressed", "points", "tracks"]
# Preferred stream of a camera that has several: points before images.
PREFERENCE: tuple[Kind, ...] = ("points", "tracks", "image", "compressed")
_MANY_MORE = 1.1  # times: the noise of compression costs less than a tenth of the images does
_WINDOW_NS = 2_000_000_000
_WINDOW_BYTES = 512 * 2**20
_MARK_NS = 50_000_000


class RecordingError(Exception):
    """A recording that cannot be used; the message is one line: what, where, what to try."""


def preferred(streams: Sequence[tuple[Kind, int]]) -> int:
    """Return which of the streams of one camera, each with its number of messages, is to be used.

    Compressed pictures only where many of the raw ones are missing: a busy recorder drops those first.
    """
    best = min(range(len(streams)), key=lambda i: PREFERENCE.index(streams[i][0]))
    for i, (kind, count) in enumerate(streams):
        if streams[best][0] == "image" and kind == "compressed" and count > _MANY_MORE * streams[best][1]:
            best = i
    return best


@dataclass(frozen=True, slots=True)
class Stream:
    """One sensor of a recording.

    Attributes:
        key: Bus key under which `Recording.messages` gives its messages.
        kind: imu, image, compressed (image), points or tracks.
        name: Name of the imu or camera.
        source: Topic or file it comes from.
        count: Messages.
        begin_ns: Stamp of the first.
        end_ns: Stamp of the last.
        rate_hz: One over the median interval; 0 with fewer than two messages.
        largest_gap_s: Longest interval.
        resolution: width, height, px, of a camera; None where the recording does not say.
        extent_px: How far points lie to the right and below, px (99 % of them); zeros: not known.
        topic: Of images in a log; "": there is none.
    """

    key: str
    kind: Kind
    name: str
    source: str
    count: int
    begin_ns: int
    end_ns: int
    rate_hz: float
    largest_gap_s: float
    resolution: tuple[int, int] | None = None
    extent_px: tuple[float, float] = (0.0, 0.0)
    topic: str = ""

    @property
    def duration_s(self) -> float:
        """From the first stamp to the last."""
        return (self.end_ns - self.begin_ns) * 1e-9


class Recording(ABC):
    """A recording that can be put on a bus.

    Attributes:
        path: File or folder.
        rig: Name of the rig in the keys.
        streams: Its sensors.
        warnings: Problems, one line each.
        stamp_sigma_s: By how much the stamps of a sensor may be off together, s: of those that were put on an
            even grid, or are written in coarse steps.
        set_back: Of a sensor whose clock was set back during the recording: to which stamp, from which, ns.
        added_ns: Cameras whose stamps count from their own zero (videos), and what was added to them, ns.
        unplaced: Those of them that begin at an unknown time. Until it is found, they begin with the IMU.
    """

    path: Path
    rig: str
    streams: tuple[Stream, ...]
    warnings: list[str]
    stamp_sigma_s: dict[str, float]
    set_back: dict[str, tuple[int, int]]
    added_ns: Mapping[str, int] = MappingProxyType({})
    unplaced: AbstractSet[str] = frozenset()

    def place(self, camera: str, by_ns: int) -> None:  # noqa: ARG002
        """Add to the stamps of a camera in `unplaced`.

        Raises:
            KeyError: There is no such camera.
        """
        raise KeyError(camera)

    @property
    def imus(self) -> dict[str, Stream]:
        """Imus by name."""
        return {stream.name: stream for stream in self.streams if stream.kind == "imu"}

    @property
    def cameras(self) -> dict[str, Stream]:
        """Cameras by name, each with the stream it is best calibrated from."""
        found: dict[str, list[Stream]] = {}
        for stream in self.streams:
            if stream.kind != "imu":
                found.setdefault(stream.name, []).append(stream)
        return {name: s[preferred([(x.kind, x.count) for x in s])] for name, s in sorted(found.items())}

    @property
    def imu_samples(self) -> int:
        """Samples of all imus."""
        return sum(stream.count for stream in self.imus.values())

    @property
    def begin_ns(self) -> int:
        """Stamp of the first message."""
        return min(stream.begin_ns for stream in self.streams)

    @property
    def duration_s(self) -> float:
        """From the first stamp to the last, over all streams."""
        return (max(stream.end_ns for stream in self.streams) - self.begin_ns) * 1e-9

    def messages(
        self, streams: Iterable[Stream] | None = None, also: Iterable[str] = ()
    ) -> Iterator[tuple[str, bytes]]:
        """Yield (key, payload) in order of the stamps; at equal stamps imus first, then by key.

        Args:
            streams: Those to take; None: every imu and, of each camera, its stream in `cameras`.
            also: Keys of status messages to take, too, where the recording holds them.

        Raises:
            RecordingError: The disk refuses.
        """
        chosen = streams if streams is not None else [*self.imus.values(), *self.cameras.values()]
        return self._messages({stream.key for stream in chosen} | set(also))

    @abstractmethod
    def _messages(self, keys: set[str]) -> Iterator[tuple[str, bytes]]: ...

    def imu_arrays(self, name: str) -> ImuArrays:
        """Return all samples of one imu.

        Raises:
            KeyError: No imu of this name.
        """
        rows = [decode_imu(payload) for _, payload in self._messages({self.imus[name].key})]
        stamps = np.array([row.stamp_ns for row in rows], dtype=np.int64)
        gyro = np.array([row.gyro_rps for row in rows], dtype=np.float64).reshape(-1, 3)
        force = np.array([row.specific_force_mps2 for row in rows], dtype=np.float64).reshape(-1, 3)
        return ImuArrays(stamps, gyro, force)

    def points_frames(self, camera: str) -> Iterator[PointsFrame]:
        """Yield the points or tracks of one camera.

        Raises:
            KeyError: No camera of this name.
        """
        for _, payload in self._messages({self.cameras[camera].key}):
            yield decode_points(payload).to_frame()


def meant(streams: Mapping[str, Stream], name: str) -> str:
    """Return the name of the sensor that a name, or a topic, means; the same name if there is none."""
    topic = name.strip("/")
    return (
        name
        if name in streams
        else next((n for n, s in streams.items() if s.source.strip("/") == topic), name)
    )


def stream_statistics(t_ns: IntArray) -> tuple[int, int, int, float, float]:
    """Return (count, begin_ns, end_ns, rate_hz, largest_gap_s) of sorted stamps."""
    if not len(t_ns):
        return 0, 0, 0, 0.0, 0.0
    steps = np.diff(t_ns)
    if not len(steps):
        return 1, int(t_ns[0]), int(t_ns[0]), 0.0, 0.0
    median_ns = float(np.median(steps))
    rate_hz = 1e9 / median_ns if median_ns > 0 else 0.0
    return len(t_ns), int(t_ns[0]), int(t_ns[-1]), rate_hz, float(steps.max()) * 1e-9


class Stamped(NamedTuple):
    """One message on its way into stamp order; `is_imu` goes before others of the same stamp."""

    stamp_ns: int
    log_time_ns: int
    key: str
    is_imu: bool
    payload: bytes


class OutOfReach:
    """Checks whether `in_stamp_order` would give a message too late, without doing it.

    Attributes:
        found: It would.
    """

    def __init__(self) -> None:
        self.found = False
        self._newest_log_ns = self._newest_ns = self._released_ns = 0
        self._marks: deque[tuple[int, int]] = deque()  # log time, newest stamp until then

    def saw(self, stamp_ns: int, log_time_ns: int) -> None:
        """Take the next message of the log."""
        self.found = self.found or stamp_ns < self._released_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)
        if log_time_ns <= self._newest_log_ns:
            return
        self._newest_log_ns = log_time_ns
        if not self._marks or log_time_ns > self._marks[-1][0] + _MARK_NS:
            self._marks.append((log_time_ns, self._newest_ns))
        while self._marks and log_time_ns - self._marks[0][0] > _WINDOW_NS:
            self._released_ns = self._marks.popleft()[1]


def in_stamp_order(items: Iterable[Stamped]) -> Iterator[Stamped]:
    """Sort messages by stamp with a look-ahead of 2 s of log time (or 512 MB).

    The order is exact for streams whose latencies differ by less than 2 s; memory is bounded for any.
    """
    heap: list[tuple[int, bool, str, int, Stamped]] = []
    waiting_bytes, newest_ns = 0, 0
    for number, item in enumerate(items):
        heappush(heap, (item.stamp_ns, not item.is_imu, item.key, number, item))
        waiting_bytes += len(item.payload)
        newest_ns = max(newest_ns, item.log_time_ns)
        while heap and (newest_ns - heap[0][-1].log_time_ns > _WINDOW_NS or waiting_bytes > _WINDOW_BYTES):
            oldest = heappop(heap)[-1]
            waiting_bytes -= len(oldest.payload)
            yield oldest
    while heap:
        yield heappop(heap)[-1]


def merged(streams: Iterable[Iterable[Stamped]]) -> Iterator[Stamped]:
    """Merge streams that are each in order of their stamps; memory does not grow with their distance."""
    return merge(*streams, key=lambda item: (item.stamp_ns, not item.is_imu, item.key))
