"""From a device to the bus without a thread in between, for small messages at a high rate.

Waking another thread for each of 1000 samples a second costs more than decoding them. So the thread that
reads a device also publishes. While the bus holds it up (a stuck subscriber can do so for a second, which a
terminal's 4 kB do not outlast), a `StandIn` reads on, and what it reads waits its turn.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from vical_daemon.acquire.publish_queue import Counted
from vical_daemon.bus.interface import Bus

LOOK_S = 0.025
"""The stand-in looks so often: a publication that lasts from one look to the next is held up."""


class DirectOutbox(Counted):
    """Queues by `put`; `flush` publishes in that order. What does not fit is dropped and counted.

    One thread flushes. Putting is up to one thread at a time, while another may flush.

    Args:
        bus: Where to.
        depth: Messages that may wait, at least 2. When full the *oldest* goes: newer data are worth more.
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
        """Messages done with so far; None while nothing is being published."""
        return self._published + self._refused if self._publishing else None

    def put(self, key: str, payload: bytes) -> None:
        """Queue one message; returns at once."""
        if len(self._queue) >= self._depth:
            with suppress(IndexError):  # whoever publishes was faster
                self._queue.popleft()
                self._overflowed += 1
        self._queue.append((key, payload))

    def flush(self) -> None:
        """Publish what waits, and what comes meanwhile."""
        queue, self._publishing = self._queue, True
        while queue:
            self._hand_over(*queue.popleft())
        self._publishing = False

    def close(self) -> None:
        """Publish what waits, once the reading has ended; not while the bus still holds that thread up."""
        if not self._publishing:
            self.flush()


class StandIn:
    """Reads on while the thread that reads and publishes is held up by the bus.

    Args:
        outbox: Tells whether it is.
        read_on: Reads once and puts what came.
        stop: Ends it.
        name: Of its thread.
    """

    def __init__(
        self, outbox: DirectOutbox, read_on: Callable[[], None], stop: threading.Event, name: str
    ) -> None:
        self._outbox, self._read_on, self._stop = outbox, read_on, stop
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread; `stop` ends it."""
        self._thread.start()

    def _run(self) -> None:
        seen: int | None = None
        while not self._stop.is_set():
            time.sleep(LOOK_S)  # costs a tenth of `wait`, and the end of the thread is not waited for
            while self._held_up_at(seen) and not self._stop.is_set():
                self._read_on()
            seen = self._outbox.progress

    def _held_up_at(self, seen: int | None) -> bool:
        return seen is not None and self._outbox.progress == seen
