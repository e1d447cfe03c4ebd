"""The summary of a recording for `vical info`: rate, gaps, jitter and latency of every topic."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vical_daemon.bus.messages import STRING_TYPE, TF_TYPE
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.mcap import LogReader
from vical_daemon.logs.model import Recording
from vical_daemon.logs.recorded_logs import LogRecording

_PERIODIC_HZ = 0.5
_HEADLESS = (TF_TYPE, STRING_TYPE)
"""Types that do not start with a stamp; near 1970 what they start with looks like one."""
_SAME_CLOCK_MS = 3_600_000.0


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic.

    Attributes:
        topic: Topic; of an ASL folder the file.
        type_name: ROS 2 type, or kind of stream.
        count: Messages.
        rate_hz: One over the median interval of the stamps.
        gaps: Intervals longer than 1.5 times the median.
        missing: Messages that are missing in these gaps.
        largest_gap_s: The longest interval.
        jitter_us: Spread (1.4826 times the median deviation) of the intervals.
        latency_ms: Median and 99th percentile of arrival minus stamp; None where a message has no stamp,
            or its arrival is not known or by another clock.
        bytes: Of the payloads.
        disordered: Messages whose stamp lies before that of an earlier one.
    """

    topic: str
    type_name: str
    count: int
    rate_hz: float
    gaps: int
    missing: int
    largest_gap_s: float
    jitter_us: float
    latency_ms: tuple[float, float] | None
    bytes: int
    disordered: int


@dataclass(frozen=True, slots=True)
class Summary:
    """A whole recording."""

    path: Path
    bytes: int
    begin_ns: int
    duration_s: float
    messages: int
    complete: bool
    topics: list[TopicSummary]
    warnings: list[str] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class _Tally:
    type_name: str
    stamps: array[int] = field(default_factory=lambda: array("q"))
    arrivals: array[int] = field(default_factory=lambda: array("q"))
    bytes: int = 0
    stamped: bool = True  # every message


def _take(tally: _Tally, payload: bytes, log_time_ns: int, *, has_header: bool = True) -> None:
    """Take a message; without a stamp of its own it counts as stamped when it was recorded."""
    stamp_ns = stamp_of(payload) if has_header else None
    plausible = stamp_ns is not None and abs(stamp_ns - log_time_ns) < 10**18
    tally.stamped &= plausible
    tally.stamps.append(stamp_ns if plausible and stamp_ns is not None else _fit(log_time_ns))
    tally.arrivals.append(_fit(log_time_ns))
    tally.bytes += len(payload)


def summarise_logs(path: Path, files: list[Path]) -> Summary:
    """Summarise MCAP files of one recording, every topic of them.

    Args:
        path: As the user named the recording.
        files: Its files, in their order.

    Raises:
        LogError: One is no MCAP file.
    """
    tallies: dict[str, _Tally] = {}
    readers = [LogReader(file) for file in files]
    for reader in readers:
        for message in reader.messages():
            channel = message.channel
            tally = tallies.get(channel.topic)
            if tally is None:
                tally = tallies[channel.topic] = _Tally(channel.type_name)
            has_header = channel.encoding == "cdr" and channel.type_name not in _HEADLESS
            _take(tally, message.payload, message.log_time_ns, has_header=has_header)
    metadata = {name: values for reader in readers for name, values in reader.metadata}
    attachments = {item.name: len(item.data) for reader in readers for item in reader.attachments}
    warnings = [warning for reader in readers for warning in reader.warnings]
    complete = all(reader.complete for reader in readers)
    return _summary(path, tallies, warnings, complete, metadata, attachments)


def summarise_recording(recording: Recording) -> Summary:
    """Summarise any other recording: its sensors; of a bag with their latency."""
    topics = {stream.key: _source(recording.path, stream.source) for stream in recording.streams}
    tallies = {topics[stream.key]: _Tally(stream.kind) for stream in recording.streams}
    if isinstance(recording, LogRecording):
        for message in recording.as_written():
            if message.topic in tallies:
                _take(tallies[message.topic], message.payload, message.log_time_ns)
    else:
        for key, payload in recording.messages(recording.streams):
            tally = tallies[topics[key]]
            tally.stamps.append(stamp_of(payload) or 0)
            tally.bytes += len(payload)
    return _summary(recording.path, tallies, list(recording.warnings), True, {}, {})


def _source(recording: Path, source: str) -> str:
    """Name a topic as the recording does, and a file by its place in the folder."""
    place = recording if recording.is_dir() else recording.parent
    return str(Path(source).relative_to(place)) if Path(source).is_relative_to(place) else source


def _fit(value: int) -> int:
    """Keep a hostile 64-bit unsigned number inside a signed one."""
    return min(value, 2**63 - 1)


def _summary(
    path: Path,
    tallies: dict[str, _Tally],
    warnings: list[str],
    complete: bool,
    metadata: dict[str, dict[str, str]],
    attachments: dict[str, int],
) -> Summary:
    topics = [_topic(name, tally) for name, tally in sorted(tallies.items())]
    # a replayed log mixes stamps of two days: take the duration from the arrivals
    times = [tally.arrivals or tally.stamps for tally in tallies.values() if tally.stamps]
    begins, ends = [min(values) for values in times], [max(values) for values in times]
    duration_s = (max(ends) - min(begins)) * 1e-9 if begins else 0.0
    size = sum(file.stat().st_size for file in _files(path))
    count = sum(topic.count for topic in topics)
    begin_ns = min(begins, default=0)
    return Summary(path, size, begin_ns, duration_s, count, complete, topics, warnings, metadata, attachments)


def _files(path: Path) -> Iterator[Path]:
    if path.is_dir():
        yield from (file for file in path.rglob("*") if file.is_file())
    else:
        yield path


def _topic(name: str, tally: _Tally) -> TopicSummary:
    raw = np.array(tally.stamps, dtype=np.int64)
    stamps = np.sort(raw)
    steps_s = np.diff(stamps) * 1e-9
    median_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    rate_hz = 1 / median_s if median_s > 0 else 0.0
    gaps, missing = 0, 0
    if rate_hz > _PERIODIC_HZ:
        holes = steps_s[steps_s > 1.5 * median_s]
        gaps, missing = len(holes), int(np.round(holes * rate_hz - 1).sum())
    jitter_us = 1.4826e6 * float(np.median(np.abs(steps_s - median_s))) if len(steps_s) else 0.0
    latency = None
    if tally.stamped and len(tally.arrivals):
        delays_ms = (np.array(tally.arrivals, dtype=np.int64) - raw) * 1e-6
        if abs(float(np.median(delays_ms))) < _SAME_CLOCK_MS:
            latency = (float(np.median(delays_ms)), float(np.percentile(delays_ms, 99)))
    largest_s = float(steps_s.max()) if len(steps_s) else 0.0
    disordered = int((raw < np.maximum.accumulate(raw)).sum()) if len(raw) else 0
    return TopicSummary(
        name,
        tally.type_name,
        len(raw),
        rate_hz,
        gaps,
        missing,
        largest_s,
        jitter_us,
        latency,
        tally.bytes,
        disordered,
    )
