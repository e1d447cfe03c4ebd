"""From a device to the bus without a second thread, for small messages at a high rate.

Waking another thread for each of 1000 samples a second costs more than decoding them. So the thread that
reads a device also publishes. A stuck subscriber can block `publish` for a second, and the 4 kB buffer of a
terminal overflows before that. Meanwhile a `BackupReader` reads the device and queues the samples.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from vical_daemon.acquire.publish_queue import CountingPublisher
from vical_daemon.bus.interface import Bus

CHECK_S = 0.025
"""Period of the backup reader's check. A publication that lasts from one check to the next is blocked."""


class DirectQueue(CountingPublisher):
    """Queues by `put`; `flush` publishes in that order. Drops and counts what does not fit.

    One thread flushes. One thread at a time may put, also while another flushes.

    Args:
        bus: Where the messages go.
        depth: Messages that may wait, at least 2. When full, the *oldest* is dropped.
    """

    def __init__(self, bus: Bus, depth: int) -> None:
        super().__init__(bus)
        self._queue: deque[tuple[str, bytes]] = deque()
        self._depth = max(2, depth)
        self._publishing = False

    @property
    def waiting(self) -> int:
        """Messages not published yet."""
        return len(self._queue)

    @property
    def progress(self) -> int | None:
        """Messages published or refused so far; None while nothing is being published."""
        return self._published + self._refused if self._publishing else None

    def put(self, key: str, payload: bytes) -> None:
        """Queue one message. Returns at once."""
        if len(self._queue) >= self._depth:
            with suppress(IndexError):  # the publishing thread was faster
                self._queue.popleft()
                self._overflowed += 1
                self._dropped_s = time.monotonic()
        self._queue.append((key, payload))

    def flush(self) -> None:
        """Publish what waits, and what is queued meanwhile."""
        queue, self._publishing = self._queue, True
        while queue:
            self._publish(*queue.popleft())
        self._publishing = False

    def close(self) -> None:
        """Publish what waits, after the reading has ended. Does nothing while the bus still blocks."""
        if not self._publishing:
            self.flush()


class BackupReader:
    """Reads a device while the thread that normally reads it is blocked in `publish`.

    Args:
        queue: Its `progress` shows whether the bus blocks.
        read_on: Reads once and queues the samples.
        stop: Ends the thread.
        name: Name of the thread.
    """

    def __init__(
        self, queue: DirectQueue, read_on: Callable[[], None], stop: threading.Event, name: str
    ) -> None:
        self._queue, self._read_on, self._stop = queue, read_on, stop
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread; `stop` ends it."""
        self._thread.start()

    def _run(self) -> None:
        seen: int | None = None
        while not self._stop.is_set():
            time.sleep(CHECK_S)  # costs a tenth of `stop.wait`; nobody waits for this thread to end
            while self._blocked_at(seen) and not self._stop.is_set():
                self._read_on()
            seen = self._queue.progress

    def _blocked_at(self, seen: int | None) -> bool:
        return seen is not None and self._queue.progress == seen
