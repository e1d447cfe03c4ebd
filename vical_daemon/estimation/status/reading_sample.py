"""A sample of the inertial readings, by which data that two calibrations have both used are recognised.

Stamps do not show that: a clock that counts from power-up, or is not set after it, shows the same times on
another day. Readings with the smallest hashes are kept, so that two samples hold the same ones of common data
[Broder, "On the resemblance and containment of documents", 1997].
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Sequence
from hashlib import blake2b

_SIZE = 64
"""Readings kept: stretches that share at least a tenth of the longer one have about six of them in common."""
_HASH_BYTES = 6  # exact as a number in JSON
_SIX = struct.Struct("6d")


class ReadingSample:
    """Takes all readings and keeps some.

    A hash is that of a reading and the one before: a coarse sensor at rest repeats single readings.
    """

    def __init__(self) -> None:
        self._last = b""
        self._heap: list[int] = []  # negative, so that the largest hash comes first
        self._kept: set[int] = set()

    def add(self, gyro: Sequence[float], accel: Sequence[float]) -> None:
        """Take one reading: rad/s and m/s^2, 3 numbers each."""
        reading = _SIX.pack(*gyro, *accel)
        value = int.from_bytes(blake2b(self._last + reading, digest_size=_HASH_BYTES).digest(), "big")
        self._last = reading
        if (len(self._heap) == _SIZE and value >= -self._heap[0]) or value in self._kept:
            return
        self._kept.add(value)
        if len(self._heap) < _SIZE:
            heapq.heappush(self._heap, -value)
        else:
            self._kept.discard(-heapq.heappushpop(self._heap, -value))

    @property
    def hashes(self) -> list[int]:
        """Smallest hashes so far, in order."""
        return sorted(self._kept)


def common_share(a: Sequence[int], b: Sequence[int]) -> float:
    """Share of the readings of the shorter data that are in the other data, too, 0 to 1.

    Hashes up to the largest that both samples would have kept are all there: these are counted.

    Args:
        a: `ReadingSample.hashes` of one; empty: not known, then nothing is taken to be common.
        b: Of the other.
    """
    limit = min((kept[-1] for kept in (a, b) if len(kept) >= _SIZE), default=1 << 8 * _HASH_BYTES)
    below_a, below_b = ({value for value in kept if value <= limit} for kept in (a, b))
    return len(below_a & below_b) / max(min(len(below_a), len(below_b)), 1)
