"""What goes wrong between a device and its host: lost, flipped, doubled, foreign bytes, stalls, lost frames.

Unplugging is `Gx3Emulator.unplug`; everything here is seeded and repeatable.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from vical_mocks.clock import Link

T = TypeVar("T")


@dataclass(slots=True)
class ByteFaults:
    """Damages a byte stream; each rate is a probability per byte.

    Attributes:
        lose: A byte vanishes.
        flip: One of its bits flips.
        double: It comes twice.
        insert: Random bytes, 1 .. `burst`, come before it.
        burst: Longest insertion.
        at_start: Number of random bytes before the first real one.
        seed: Makes it repeatable.
    """

    lose: float = 0.0
    flip: float = 0.0
    double: float = 0.0
    insert: float = 0.0
    burst: int = 40
    at_start: int = 0
    seed: int = 0
    _rng: np.random.Generator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng([self.seed, 11])

    def apply(self, data: bytes) -> bytes:
        """Return what arrives of `data`."""
        out = bytearray()
        if self.at_start:
            out += self._rng.bytes(self.at_start)
            self.at_start = 0
        kinds = self._rng.random(len(data))
        lose, flip = self.lose, self.lose + self.flip
        double, insert = flip + self.double, flip + self.double + self.insert
        clean = 0
        for at in np.flatnonzero(kinds < insert):
            out += data[clean:at]
            clean = int(at) + 1
            value, kind = data[at], kinds[at]
            if kind < lose:
                continue
            if kind < flip:
                out.append(value ^ 1 << int(self._rng.integers(8)))
            elif kind < double:
                out += bytes((value, value))
            else:
                out += self._rng.bytes(int(self._rng.integers(1, self.burst + 1)))
                out.append(value)
        out += data[clean:]
        return bytes(out)


class FaultyLink:
    """A link whose bytes are damaged and which now and then delivers nothing for a while.

    Args:
        link: The link underneath.
        faults: What happens to the bytes; None for nothing.
        stall_every_s: Mean time between stalls; 0 for none.
        stall_s: Length of a stall; what piled up then comes at once.
        seed: Makes it repeatable.
    """

    def __init__(
        self,
        link: Link,
        faults: ByteFaults | None = None,
        *,
        stall_every_s: float = 0.0,
        stall_s: float = 0.2,
        seed: int = 0,
    ) -> None:
        self._link = link
        self._faults = faults
        self._every_s = stall_every_s
        self._stall_s = stall_s
        self._rng = np.random.default_rng([seed, 12])
        self._stall_until_s = -np.inf
        self._next_stall_s: float | None = None

    def push(self, data: bytes, t_ready_s: float) -> None:
        """See `Link.push`."""
        damaged = self._faults.apply(data) if self._faults else data
        if damaged:
            self._link.push(damaged, t_ready_s)

    def poll(self, t_now_s: float) -> list[tuple[float, bytes]]:
        """See `Link.poll`."""
        if self._every_s > 0:
            if self._next_stall_s is None:
                self._next_stall_s = t_now_s + float(self._rng.exponential(self._every_s))
            if t_now_s >= self._next_stall_s:
                self._stall_until_s = self._next_stall_s + self._stall_s
                self._next_stall_s = self._stall_until_s + float(self._rng.exponential(self._every_s))
        if t_now_s < self._stall_until_s:
            return []
        return [(max(t_s, self._stall_until_s), data) for t_s, data in self._link.poll(t_now_s)]

    def next_s(self) -> float | None:
        """See `Link.next_s`."""
        next_s = self._link.next_s()
        return None if next_s is None else max(next_s, self._stall_until_s)

    def set_baud(self, baud: int) -> None:
        """See `Link.set_baud`."""
        self._link.set_baud(baud)


def drop_some(frames: Iterable[T], probability: float, seed: int = 0) -> Iterator[T]:
    """Yield the frames of a camera that were not lost on the way."""
    rng = np.random.default_rng([seed, 13])
    for frame in frames:
        if rng.random() >= probability:
            yield frame
