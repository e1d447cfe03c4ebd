"""Between a device and the bus: a slow link never stalls a read for long, and a quick one costs no thread."""

from __future__ import annotations

import logging
import threading
import time
from contextlib import suppress
from queue import Empty, SimpleQueue

from vical_daemon.bus import Bus

_log = logging.getLogger(__name__)
PATIENCE_S = 0.005
"""A bus that needs longer for one message is slow: from then on the queue and its thread take over."""
RECOVERY_S = 10.0
"""After so long, with nothing waiting, a slow bus is tried again."""


class Outbox:
    """Publishes in the order of `put`; what does not fit is dropped and counted. One thread may put.

    Waking another thread 1000 times a second costs more than decoding the samples. So with `inline` a message
    is published by whoever puts it, as long as the bus takes each at once. The first that takes long (a
    stuck subscriber holds a blocking bus up for a second, which a serial port's 64 kB outlast) hands over to
    the queue and its thread, and there it stays until the bus is well again.

    Args:
        bus: Where to.
        depth: Messages that may wait. When full the *oldest* goes: newer data are worth more.
        name: Of the thread.
        inline: Publish in the caller's thread while the bus is quick: for small messages at a high rate.
    """

    def __init__(self, bus: Bus, depth: int, name: str, *, inline: bool = False) -> None:
        self._bus = bus
        self._queue: SimpleQueue[tuple[str, bytes] | None] = SimpleQueue()
        self._depth = depth
        self._may_inline = self._inline = inline
        self._retry_s = 0.0
        self._queued = 0
        self._handled = 0  # by the thread
        self._overflowed = 0
        self._refused = 0
        self._published = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Messages not published yet."""
        return self._queue.qsize()

    @property
    def dropped(self) -> int:
        """Messages that did not fit, or that the bus did not take."""
        return self._overflowed + self._refused

    @property
    def published(self) -> int:
        """Messages handed to the bus."""
        return self._published

    def put(self, key: str, payload: bytes) -> None:
        """Publish or queue one message; returns at once, but see `Outbox`."""
        if self._inline or self._well_again():
            begin_s = time.monotonic()
            self._publish(key, payload)
            now_s = time.monotonic()
            if now_s - begin_s > PATIENCE_S:
                self._inline, self._retry_s = False, now_s + RECOVERY_S
            return
        if self._queue.qsize() >= self._depth:
            self._make_room()
        self._queued += 1
        self._queue.put((key, payload))

    def _well_again(self) -> bool:
        if not self._may_inline or time.monotonic() < self._retry_s:
            return False
        # Only once the thread is through with everything: messages keep their order.
        self._inline = self._handled + self._overflowed == self._queued
        return self._inline

    def _make_room(self) -> None:
        with suppress(Empty):  # the thread was faster
            if self._queue.get_nowait() is None:
                self._queue.put(None)  # closed in the meantime: that must not get lost
            else:
                self._overflowed += 1

    def close(self, timeout_s: float = 2.0) -> None:
        """Publish what waits, then stop; gives up after `timeout_s`. May be called twice."""
        self._queue.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (message := self._queue.get()) is not None:
            self._publish(*message)
            self._handled += 1

    def _publish(self, key: str, payload: bytes) -> None:
        try:
            self._bus.publish(key, payload)
            self._published += 1
        except Exception:  # a broken link must not end acquisition; the bus comes back by itself
            self._refused += 1
            _log.exception("cannot publish on %s", key)
