"""A bounded queue and a thread between a device and the bus: a slow link never stalls a read."""

from __future__ import annotations

import logging
import threading
from collections import deque

from vical_daemon.bus import Bus

_log = logging.getLogger(__name__)


class Outbox:
    """Publishes in the order of `put`, in a thread of its own; what does not fit is dropped and counted.

    Args:
        bus: Where to.
        depth: Messages that may wait. When full the *oldest* goes: newer data are worth more.
        name: Of the thread.
    """

    def __init__(self, bus: Bus, depth: int, name: str) -> None:
        self._bus = bus
        self._queue: deque[tuple[str, bytes]] = deque()
        self._depth = depth
        self._ready = threading.Condition()
        self._closed = False
        self._dropped = 0
        self._published = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Messages not published yet."""
        return len(self._queue)

    @property
    def dropped(self) -> int:
        """Messages that did not fit."""
        return self._dropped

    @property
    def published(self) -> int:
        """Messages handed to the bus."""
        return self._published

    def put(self, key: str, payload: bytes) -> None:
        """Queue one message; returns at once."""
        with self._ready:
            if len(self._queue) >= self._depth:
                self._queue.popleft()
                self._dropped += 1
            self._queue.append((key, payload))
            self._ready.notify()

    def close(self, timeout_s: float = 2.0) -> None:
        """Publish what waits, then stop; gives up after `timeout_s`."""
        with self._ready:
            self._closed = True
            self._ready.notify()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._queue or self._closed)
                if not self._queue:
                    return
                key, payload = self._queue.popleft()
            try:
                self._bus.publish(key, payload)
                self._published += 1
            except Exception:  # a broken link must not end acquisition; the bus comes back by itself
                self._dropped += 1
                _log.exception("cannot publish on %s", key)
