"""CLOCK_MONOTONIC and CLOCK_REALTIME of the same moment."""

from __future__ import annotations

import time

_UNINTERRUPTED_NS = 20_000
"""Readings that are no further apart were not interrupted: three clock readings of Python take 0.5 us on a
desktop computer and 5 us on a small one; a scheduler's time slice is 1 ms or more."""
_ATTEMPTS = 10


def read_host_clocks() -> tuple[int, int]:
    """Return (CLOCK_MONOTONIC, CLOCK_REALTIME) at the moment of the call, ns.

    A process may be interrupted between two readings, for tens of milliseconds on a loaded computer. So the
    wall clock is read between two readings of the other, and again if these are far apart. The shortest
    attempt gives the difference of the clocks.
    """
    called_ns = before_ns = time.monotonic_ns()
    shortest_ns, offset_ns = None, 0
    for _ in range(_ATTEMPTS):
        realtime_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        took_ns = after_ns - before_ns
        if shortest_ns is None or took_ns < shortest_ns:
            shortest_ns, offset_ns = took_ns, realtime_ns - (before_ns + after_ns) // 2
        if took_ns <= _UNINTERRUPTED_NS:
            break
        before_ns = after_ns
    return called_ns, called_ns + offset_ns
