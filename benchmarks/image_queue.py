"""The queue of images before the detector, with and without each of its rules, in simulated time.

Images come at a steady rate; a detector takes them from the queue and needs a fixed time for each, or nothing
is detected for a while. For each case: images lost, age of those detected when they are taken (median and
95 %), and the longest time between two of them.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from vical_daemon.bus.interface import Sample
from vical_daemon.detect import image_queue
from vical_daemon.detect.image_queue import ImageQueue


class Case(NamedTuple):
    """What happens.

    Attributes:
        rate_hz: Images of each camera.
        size: Bytes of an image.
        cameras: How many.
        slow_s: Time for one image, s.
        busy_s: From when to when nothing is detected, s.
        seconds: Length.
        quick_after_s: From then on an image takes 15 ms.
    """

    rate_hz: float
    size: int
    cameras: int
    slow_s: float
    busy_s: tuple[float, float]
    seconds: float
    quick_after_s: float = np.inf


VGA, LARGE, QUICK_S = 640 * 480, 1280 * 1024, 0.015
NEVER = (np.inf, np.inf)
CASES = {
    "start of the estimator: busy for 2.8 s": Case(20.0, VGA, 1, QUICK_S, (5.0, 7.8), 30.0),
    "1.5 times too slow": Case(20.0, VGA, 1, 0.075, NEVER, 60.0),
    "four large cameras, twice too slow": Case(30.0, LARGE, 4, 0.0167, NEVER, 60.0),
    "1.5 times too slow for 30 s; busy for 2.8 s from 45 s on": Case(
        20.0, VGA, 1, 0.075, (45.0, 47.8), 60.0, quick_after_s=30.0
    ),
}


class OldestFirst(ImageQueue):
    """Drops its oldest image when it is full."""

    def _thin(self, camera: str) -> None:
        self._bytes[camera] -= len(self._queues[camera].popleft().payload)
        self.dropped[camera] += 1


VARIANTS: dict[str, tuple[type[ImageQueue], dict[str, Any]]] = {
    "as it is": (ImageQueue, {}),
    "the newest image only": (ImageQueue, {"QUEUE_BYTES": 1}),
    "a full queue drops its oldest image": (OldestFirst, {}),
    "a full queue is as long the next time": (ImageQueue, {"SHORTER": 1.0}),
    "half as long": (ImageQueue, {"SHORTER": 0.5}),
    "0.9 times as long": (ImageQueue, {"SHORTER": 0.9}),
    "an overload is never over": (ImageQueue, {"OVER_S": np.inf}),
    "over after 1 s": (ImageQueue, {"OVER_S": 1.0}),
    "over after 20 s": (ImageQueue, {"OVER_S": 20.0}),
    "16 MiB": (ImageQueue, {"QUEUE_BYTES": 16 << 20}),
    "64 MiB": (ImageQueue, {"QUEUE_BYTES": 64 << 20}),
}


def played(kind: type[ImageQueue], case: Case) -> tuple[int, int, np.ndarray, float]:
    """Images, images lost, ages of the others, s, and the longest time between two of one camera, s."""
    now_s = [0.0]
    names = [f"cam{k}" for k in range(case.cameras)]
    queue = kind(names, lambda: now_s[0])
    born_s = np.arange(0.0, case.seconds, 1.0 / case.rate_hz)
    payload, came = bytes(case.size), 0
    seen: dict[str, list[float]] = {name: [] for name in names}
    ages = []
    while now_s[0] < case.seconds:
        while came < len(born_s) and born_s[came] <= now_s[0]:
            for name in names:
                queue.put(name, Sample(name, payload, came))
            came += 1
        taken = None if case.busy_s[0] <= now_s[0] < case.busy_s[1] else queue.take(0.0)
        if taken is not None:
            name, sample = taken
            ages.append(now_s[0] - born_s[sample.sequence])
            seen[name].append(float(born_s[sample.sequence]))
            now_s[0] += case.slow_s if now_s[0] < case.quick_after_s else QUICK_S
        else:  # until the next image
            now_s[0] = float(born_s[came]) if came < len(born_s) else case.seconds
    gap_s = max(float(np.diff(stamps).max()) for stamps in seen.values())
    return came * case.cameras, sum(queue.dropped.values()), np.array(ages), gap_s


def main(argv: list[str]) -> int:
    """Print a table for each case."""
    argparse.ArgumentParser(prog="python -m benchmarks image_queue", description=__doc__).parse_args(argv)
    for title, case in CASES.items():
        print(f"{title}:\n")
        print("| queue | images | lost | age s, median | 95 % | longest gap s |\n|---|---|---|---|---|---|")
        for name, (kind, values) in VARIANTS.items():
            with patch.dict(vars(image_queue), values):
                images, lost, ages, gap_s = played(kind, case)
            median, late = np.quantile(ages, (0.5, 0.95))
            print(f"| {name} | {images} | {lost} | {median:.2f} | {late:.2f} | {gap_s:.2f} |")
        print()
    return 0
