"""The clocks of the host at the same moment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

_UNINTERRUPTED_NS = 20_000
"""Readings that are no further apart were not interrupted: three clock readings of Python take 0.5 us on a
desktop computer and 5 us on a small one; a scheduler's time slice is 1 ms or more."""
_ATTEMPTS = 10


class HostClocks(NamedTuple):
    """One moment on each clock, ns.

    Attributes:
        monotonic_ns: CLOCK_MONOTONIC.
        realtime_ns: CLOCK_REALTIME, the wall clock.
        boottime_ns: CLOCK_BOOTTIME: goes on while the computer is suspended, which CLOCK_MONOTONIC does not.
    """

    monotonic_ns: int
    realtime_ns: int
    boottime_ns: int


def read_host_clocks() -> tuple[int, int]:
    """Return (CLOCK_MONOTONIC, CLOCK_REALTIME) at the moment of the call, ns."""
    called_ns = time.monotonic_ns()
    return called_ns, called_ns + _ahead_ns(time.time_ns)


def read_all_clocks() -> HostClocks:
    """Return all clocks at the moment of the call."""
    called_ns = time.monotonic_ns()
    realtime_ns = called_ns + _ahead_ns(time.time_ns)
    boottime_ns = called_ns + _ahead_ns(lambda: time.clock_gettime_ns(time.CLOCK_BOOTTIME))
    return HostClocks(called_ns, realtime_ns, boottime_ns)


def _ahead_ns(read_ns: Callable[[], int]) -> int:
    """Return by how much another clock is ahead of CLOCK_MONOTONIC, ns.

    A process may be interrupted between two readings, for tens of milliseconds on a loaded computer. So the
    other clock is read between two readings of this one, and again if these are far apart. The shortest
    attempt gives the difference of the clocks.
    """
    before_ns = time.monotonic_ns()
    shortest_ns, offset_ns = None, 0
    for _ in range(_ATTEMPTS):
        other_ns = read_ns()
        after_ns = time.monotonic_ns()
        took_ns = after_ns - before_ns
        if shortest_ns is None or took_ns < shortest_ns:
            shortest_ns, offset_ns = took_ns, other_ns - (before_ns + after_ns) // 2
        if took_ns <= _UNINTERRUPTED_NS:
            break
        before_ns = after_ns
    return offset_ns
