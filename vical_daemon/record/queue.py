"""The queue between the bus and the disk: stamped on arrival, bounded in memory, drops images first."""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

from vical_daemon.bus.interface import Sample
from vical_daemon.bus.topics import Topic, parse_key
from vical_daemon.service.wall_clock import WallClock

QUEUE_BYTES = 128 * 2**20


class Arrival(NamedTuple):
    """A message with the time at which it arrived (UNIX, ns)."""

    topic: Topic
    key: str
    payload: bytes
    log_time_ns: int


class RecordQueue:
    """Messages that wait for the disk. When it fills up, images are dropped first."""

    def __init__(self, limit_bytes: int = QUEUE_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self._queue: deque[Arrival] = deque()
        self._ready = threading.Condition()
        self._bytes = 0
        self.dropped: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._queue)

    def put(self, item: Arrival) -> None:
        """Append a message, or drop and count it: images above half of the limit, others above the limit."""
        image = item.topic.kind in ("image", "compressed")
        with self._ready:
            if self._bytes + len(item.payload) > self._limit_bytes / (2 if image else 1):
                self.dropped[item.topic.kind] = self.dropped.get(item.topic.kind, 0) + 1
                return
            self._queue.append(item)
            self._bytes += len(item.payload)
            self._ready.notify()

    def take(self, timeout_s: float) -> list[Arrival]:
        """Return all queued messages; [] after the timeout."""
        with self._ready:
            self._ready.wait_for(lambda: bool(self._queue), timeout_s)
            items = list(self._queue)
            self._queue.clear()
            self._bytes = 0
            return items


def arrival(sample: Sample, clock: WallClock) -> Arrival | None:
    """Return a sample with its arrival time; None for keys that are not in the topics table."""
    parsed = parse_key(sample.key)
    return Arrival(parsed.topic, sample.key, sample.payload, clock.now_ns()) if parsed else None
