"""Limits the log lines that outside senders can cause."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class LogLimit:
    """Lets a number of lines through in each period and counts the others. Thread-safe.

    Args:
        lines: Let through in each period.
        period_s: Its length, s.
        clock: Monotonic seconds.
    """

    def __init__(self, lines: int, period_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._lines, self._period_s, self._clock = lines, period_s, clock
        self._lock = threading.Lock()
        self._begin_s = float("-inf")
        self._used = self._left_out = 0

    def admit(self) -> str | None:
        """Return a suffix for the line: "", or how many lines were left out before it; None: log no line."""
        now_s = self._clock()
        with self._lock:
            if now_s - self._begin_s >= self._period_s:
                self._begin_s, self._used = now_s, 0
            if self._used >= self._lines:
                self._left_out += 1
                return None
            self._used += 1
            left_out, self._left_out = self._left_out, 0
        return f" ({left_out} more before it)" if left_out else ""
