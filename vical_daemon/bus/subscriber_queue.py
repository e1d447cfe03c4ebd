"""One queue for the samples of several keys, for a role with its own loop."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence

from vical_daemon.bus.interface import Bus, Sample

GATHER_S = 0.02
"""After the first sample others are awaited for this long. To wake for each of 200 samples per second takes a
third of the CPU time of `calibrate`; estimates are published every 0.2 s."""


class SubscriberQueue:
    """One bounded queue over several subscriptions, in the order of arrival.

    The bus thread only appends; the role decodes.

    Args:
        bus: Where the samples come from.
        key_expressions: Keys to subscribe to.
        limit: Samples kept. When full, the oldest is dropped and counted.
    """

    def __init__(self, bus: Bus, key_expressions: Sequence[str], limit: int) -> None:
        self._queue: deque[Sample] = deque()
        self._limit = limit
        self._lock = threading.Lock()
        self._arrived = threading.Event()
        self._dropped = 0
        self._subscriptions = [bus.subscribe(key, self._keep) for key in key_expressions]

    def __len__(self) -> int:
        return len(self._queue)

    @property
    def dropped(self) -> int:
        """Samples lost in this queue, or before it (gaps in their sequence)."""
        return self._dropped + sum(subscription.dropped for subscription in self._subscriptions)

    def _keep(self, sample: Sample) -> None:
        with self._lock:
            if len(self._queue) >= self._limit:
                self._queue.popleft()
                self._dropped += 1
            self._queue.append(sample)
        self._arrived.set()

    def wait(self, timeout_s: float) -> bool:
        """Wait for samples, which come in batches of `GATHER_S`; False after the timeout."""
        came = self._arrived.wait(timeout_s)
        if came:
            time.sleep(GATHER_S)
        self._arrived.clear()
        return came

    def take(self, count: int) -> Iterator[Sample]:
        """Yield at most `count` queued samples."""
        for _ in range(count):
            with self._lock:
                if not self._queue:
                    return
                sample = self._queue.popleft()
            yield sample

    def close(self) -> None:
        """End the subscriptions; queued samples can still be taken."""
        for subscription in self._subscriptions:
            subscription.close()
