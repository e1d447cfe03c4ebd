"""Merges several streams into one, ordered by stamp, with a fixed lag.

The lag is measured by stamps, not by a clock. So a replay at any speed gives the order of the live run.
"""

from __future__ import annotations

import heapq
from typing import Generic, TypeVar

T = TypeVar("T")


class ReorderBuffer(Generic[T]):
    """A bounded heap of stamped items.

    Args:
        lag_s: An item is released when a stamp this much later has arrived.
        max_items: When more items wait, the earliest are released early, to bound memory.

    Stamps are trusted here; `stamp_gate` has checked that they are continuous.
    """

    def __init__(self, lag_s: float, max_items: int = 20_000) -> None:
        self._lag_ns = round(lag_s * 1e9)
        self._max_items = max_items
        self._heap: list[tuple[int, int, T]] = []
        self._arrivals = 0
        self._newest_ns: int | None = None
        self._released_ns: int | None = None
        self.late = 0

    def __len__(self) -> int:
        return len(self._heap)

    @property
    def newest_ns(self) -> int | None:
        """Latest stamp taken so far; None before the first."""
        return self._newest_ns

    def push(self, stamp_ns: int, item: T) -> None:
        """Take an item. An item later than the lag is counted in `late` and released next.

        It is not dropped: a stream that a busy machine delays as a whole is still in order, and the
        estimator holds an image until inertial data bracket it.
        """
        if self._newest_ns is None or stamp_ns > self._newest_ns:
            self._newest_ns = stamp_ns
        if self._released_ns is not None and stamp_ns < self._released_ns:
            self.late += 1
        heapq.heappush(self._heap, (stamp_ns, self._arrivals, item))
        self._arrivals += 1

    def pop_due(self) -> list[T]:
        """Return the items older than the lag, by stamp; equal stamps in order of arrival."""
        due: list[T] = []
        if self._newest_ns is None:
            return due
        until_ns = self._newest_ns - self._lag_ns
        while self._heap and (self._heap[0][0] <= until_ns or len(self._heap) > self._max_items):
            due.append(self._pop())
        return due

    def pop_all(self) -> list[T]:
        """Return all items (end of the data)."""
        return [self._pop() for _ in range(len(self._heap))]

    def _pop(self) -> T:
        stamp_ns, _, item = heapq.heappop(self._heap)
        self._released_ns = stamp_ns
        return item
