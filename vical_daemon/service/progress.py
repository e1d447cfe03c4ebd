"""Is what comes in also worked on, and when may a part that failed be started again? Pure bookkeeping."""

from __future__ import annotations

_CALM_S = 300.0  # a failure so long after the one before is the first of its kind again
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0


class Progress:
    """Compares what was received with what was settled: used, or refused with a reason.

    A role that goes round and round is not alive; one that settles what it receives is.
    """

    def __init__(self) -> None:
        self._received = self._settled = 0
        self._since_s: float | None = None

    def look(self, received: int, settled: int, now_s: float) -> float:
        """Take the counters as they are now.

        Args:
            received: Items that came in so far.
            settled: Items used or refused so far.
            now_s: A steady clock.

        Returns:
            For how long items have come in and none has been settled, s; 0: all is well.
        """
        if settled != self._settled:
            self._since_s, self._received, self._settled = None, received, settled
        elif received > self._received and self._since_s is None:
            self._since_s = now_s
        return 0.0 if self._since_s is None else now_s - self._since_s


class Restarts:
    """When a part that failed may start again: at once the first time, then after pauses that double.

    Attributes:
        count: Failures so far.
        why: The last one, one line.
    """

    def __init__(self) -> None:
        self.count = 0
        self.why = ""
        self._row = 0
        self._last_s = self._until_s = -float("inf")

    def failed(self, why: str, now_s: float) -> float:
        """Note a failure; the pause to make before the next start, s."""
        self.count += 1
        self._row = self._row + 1 if now_s - self._last_s < _CALM_S else 1
        self.why, self._last_s = why, now_s
        pause_s = 0.0
        if self._row > 1:
            pause_s = min(_FIRST_PAUSE_S * 2.0 ** min(self._row - 2, 10), _LONGEST_PAUSE_S)
        self._until_s = now_s + pause_s
        return pause_s

    def waiting_s(self, now_s: float) -> float:
        """How long to wait still before it may work again, s; 0: it may."""
        return max(self._until_s - now_s, 0.0)
