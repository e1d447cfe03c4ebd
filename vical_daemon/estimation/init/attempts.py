"""Schedule of the attempts to start: at once when there are enough data, then less and less often."""

from __future__ import annotations

import numpy as np

LONG_S = 8.0  # of data: much for a start; more of them would not make it better
_GROWTH, _MOST_S = 1.25, 4.0  # each pause over the one before; the longest


class Attempts:
    """Schedule of the attempts to start, with a target or without.

    Args:
        first_s: Pause after the first attempt, s.
    """

    def __init__(self, first_s: float) -> None:
        self._first_s = first_s
        self.anew()

    def anew(self) -> None:
        """Try at once, and often again."""
        self._next_s, self._pause_s, self.count = -np.inf, self._first_s, 0

    def due(self, t_s: float) -> bool:
        """Whether it is time for the next one, by the newest data (s)."""
        return t_s >= self._next_s

    def tried(self, t_s: float) -> None:
        """Note an attempt; `count` is the number of them since `anew`."""
        self._next_s = t_s + self._pause_s
        self._pause_s = min(_GROWTH * self._pause_s, _MOST_S)
        self.count += 1
