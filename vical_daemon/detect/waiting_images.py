"""Images that wait for a busy detector: not for long, and in bounded memory."""

from __future__ import annotations

import threading
import time
from collections import deque

from vical_daemon.bus.interface import Sample

LONGEST_S = 0.7
"""So long an image may wait, s. One that waits for more than 1.5 s looks to the estimator as if the camera's
clock had been set (`image_intake`)."""
MOST_BYTES = 32 * 2**20
LEAST = 2
"""Images that may wait however large they are and however seldom they come."""


class WaitingImages:
    """The queue between the bus and the detector of one camera. New images replace those that wait too long.

    Attributes:
        dropped: Images that were replaced.
    """

    def __init__(self) -> None:
        self._queue: deque[tuple[float, Sample]] = deque()
        self._bytes = 0
        self._ready = threading.Condition()
        self.dropped = 0

    def put(self, sample: Sample) -> None:
        """Append an image; cheap enough for the bus thread."""
        now_s = time.monotonic()
        with self._ready:
            self._queue.append((now_s, sample))
            self._bytes += len(sample.payload)
            while len(self._queue) > LEAST and self._too_much(now_s):
                self._pop()
                self.dropped += 1
            self._ready.notify()

    def _too_much(self, now_s: float) -> bool:
        return now_s - self._queue[0][0] > LONGEST_S or self._bytes > MOST_BYTES

    def _pop(self) -> Sample:
        _, sample = self._queue.popleft()
        self._bytes -= len(sample.payload)
        return sample

    def take(self, timeout_s: float) -> Sample | None:
        """Return the oldest image, or None after the timeout."""
        with self._ready:
            self._ready.wait_for(lambda: self._queue, timeout_s)
            return self._pop() if self._queue else None
