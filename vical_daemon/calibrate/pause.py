"""How long to pause so that a process uses no more than its share of a core."""

from __future__ import annotations

import time
from collections.abc import Callable

LONGEST_S = 3600.0
"""A pause ends after this time, s, whatever else the process may be doing, so that there are checks at all.
At a share of 3 % it pays for 108 s of CPU time; a check takes 5 to 10 s on a current core."""


class Pause:
    """Keeps the CPU time of this process within a share of the time that passes.

    All CPU time counts, from the start of the process on (imports and the first check as well): it is a debt,
    which time pays off at the given share. Time without debt is not saved up, so a long rest is not followed
    by a burst of checks.

    Args:
        share: Of one core.
        now_s: Any steady clock, s.
        cpu_s: CPU time of this process, s.
    """

    def __init__(
        self,
        share: float,
        now_s: Callable[[], float] = time.monotonic,
        cpu_s: Callable[[], float] = time.process_time,
    ) -> None:
        self._share, self._now_s, self._cpu_s = share, now_s, cpu_s
        self._debt_s = self._counted_s = cpu_s()
        self._begin_s = self._paid_s = now_s()

    def begin(self) -> None:
        """A check begins."""
        self._settle()
        self._begin_s = self._paid_s

    def excuse(self) -> None:
        """The work since the last call of any method was asked for, and does not count."""
        self._counted_s = self._cpu_s()

    @property
    def over(self) -> bool:
        """Whether the share allows more work."""
        self._settle()
        return self._debt_s <= 0.0 or self._paid_s - self._begin_s > LONGEST_S

    def _settle(self) -> None:
        now_s, cpu_s = self._now_s(), self._cpu_s()
        owed_s = self._debt_s + (cpu_s - self._counted_s) - self._share * (now_s - self._paid_s)
        self._debt_s, self._counted_s, self._paid_s = max(0.0, owed_s), cpu_s, now_s
