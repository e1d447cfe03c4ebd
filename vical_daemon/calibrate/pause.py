"""How long to pause so that a process uses no more than its share of a core."""

from __future__ import annotations

import time

LONGEST_S = 600.0
"""A pause ends after this time, s, whatever else the process may be doing."""


class Pause:
    """Time of this process since `begin`, against a share of the time that has passed.

    Args:
        share: Of one core.
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self.begin()

    def begin(self) -> None:
        """Count from now on."""
        self._begin_s, self._cpu_s = time.monotonic(), time.process_time()

    @property
    def over(self) -> bool:
        """Whether the share allows more work."""
        passed_s = time.monotonic() - self._begin_s
        return time.process_time() - self._cpu_s <= self._share * passed_s or passed_s > LONGEST_S
