"""A bounded queue and a thread between a device and the bus: a slow link never stalls a read."""

from __future__ import annotations

import logging
import math
import threading
import time
from contextlib import suppress
from queue import Empty, SimpleQueue

from vical_daemon.bus.interface import Bus

_log = logging.getLogger(__name__)


class CountingPublisher:
    """Publishes on the bus and counts what was published and what was dropped."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._overflowed = self._refused = self._published = 0
        self._dropped_s = -math.inf

    @property
    def dropped(self) -> int:
        """Messages that did not fit into the queue, or that the bus refused."""
        return self._overflowed + self._refused

    @property
    def drop_age_s(self) -> float:
        """Time since the last message that was dropped, s; infinite: none was."""
        return time.monotonic() - self._dropped_s

    @property
    def published(self) -> int:
        """Messages handed to the bus."""
        return self._published

    def _publish(self, key: str, payload: bytes) -> None:
        try:
            self._bus.publish(key, payload)
            self._published += 1
        except Exception:  # a broken link must not end acquisition; the bus reconnects by itself
            self._refused += 1
            self._dropped_s = time.monotonic()
            _log.exception("cannot publish on %s", key)


class PublishQueue(CountingPublisher):
    """Publishes in the order of `put`, in a thread of its own. Drops and counts what does not fit.

    Only one thread may call `put`. `SimpleQueue` is implemented in C: at 1000 samples a second a `Condition`
    costs more than decoding them.

    Args:
        bus: Where the messages go.
        depth: Messages that may wait. When full, the *oldest* is dropped: newer data are worth more.
        name: Name of the thread.
    """

    def __init__(self, bus: Bus, depth: int, name: str) -> None:
        super().__init__(bus)
        self._queue: SimpleQueue[tuple[str, bytes] | None] = SimpleQueue()
        self._depth = depth
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Messages not published yet."""
        return self._queue.qsize()

    def put(self, key: str, payload: bytes) -> None:
        """Queue one message. Returns at once."""
        if self._queue.qsize() >= self._depth:
            self._make_room()
        self._queue.put((key, payload))

    def _make_room(self) -> None:
        with suppress(Empty):  # the publishing thread was faster
            if self._queue.get_nowait() is None:
                self._queue.put(None)  # `close` was called meanwhile: keep its mark
            else:
                self._overflowed += 1
                self._dropped_s = time.monotonic()

    def close(self, timeout_s: float = 2.0) -> None:
        """Publish what waits, then stop. Gives up after `timeout_s`. May be called twice."""
        self._queue.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (message := self._queue.get()) is not None:
            self._publish(*message)
