"""Images that wait for the detector: all of a burst, fewer and fewer while an overload lasts.

Two things make images wait. For some seconds something else needs the computer, most of all the start of the
estimator: then they are worth waiting for. Or the computer is too slow for all of them: then a queue that
drops its oldest image when it is full is always full, and each image is used as late as the queue is long.

So a full queue drops every second image, which leaves no long gap, and from then on is full earlier. Where
that is not enough, it soon holds the newest image only.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

from vical_daemon.bus.interface import Sample

QUEUE_BYTES = 32 << 20
"""Images of one camera that wait, bytes. At 640x480 and 20 Hz these are 5.4 s: the start of the estimator
takes 0.7 s of CPU time, with a quarter of a core 2.8 s, and longer where other programs run."""
SHORTER = 0.75
"""A queue that was full is full with so much less the next time; above 0.5, as it is half empty then."""
OVER_S = 5.0
"""An overload is over when nothing had to be dropped for so long, s. Then queues are as long as before."""


class ImageQueue:
    """The queues of all cameras, taken from in turn, so that each camera gets its share.

    Args:
        cameras: Names.
        now_s: A steady clock, s.

    Attributes:
        dropped: Images dropped so far, by camera.
    """

    def __init__(self, cameras: Sequence[str], now_s: Callable[[], float] = time.monotonic) -> None:
        self._queues: dict[str, deque[Sample]] = {name: deque() for name in cameras}
        self._bytes = dict.fromkeys(cameras, 0)
        self.dropped = dict.fromkeys(cameras, 0)
        self._turns = deque(cameras)
        self._ready = threading.Condition()
        self._now_s = now_s
        self._limit_bytes = float(QUEUE_BYTES)
        self._over_s = now_s()  # when an overload will be over

    def put(self, camera: str, sample: Sample) -> None:
        """Append an image. Never waits."""
        with self._ready:
            if self._now_s() > self._over_s:
                self._limit_bytes = float(QUEUE_BYTES)
            self._queues[camera].append(sample)
            self._bytes[camera] += len(sample.payload)
            while self._bytes[camera] > self._limit_bytes and len(self._queues[camera]) > 1:
                self._thin(camera)
            self._ready.notify()

    def take(self, timeout_s: float) -> tuple[str, Sample] | None:
        """Return the next image and its camera; None after the timeout."""
        with self._ready:
            if not self._ready.wait_for(lambda: any(self._queues.values()), timeout_s):
                return None
            camera = next(name for name in self._turns if self._queues[name])
            self._turns.remove(camera)
            self._turns.append(camera)
            sample = self._queues[camera].popleft()
            self._bytes[camera] -= len(sample.payload)
            return camera, sample

    def _thin(self, camera: str) -> None:
        """Drop every second image of a camera, and let all queues be full earlier."""
        queue = list(self._queues[camera])
        kept = queue[(len(queue) - 1) % 2 :: 2]  # the newest among them
        self._queues[camera] = deque(kept)
        self._bytes[camera] = sum(len(sample.payload) for sample in kept)
        self.dropped[camera] += len(queue) - len(kept)
        self._limit_bytes *= SHORTER
        self._over_s = self._now_s() + OVER_S

    def clear(self, camera: str) -> None:
        """Forget the images of a camera."""
        with self._ready:
            self._queues[camera].clear()
            self._bytes[camera] = 0
