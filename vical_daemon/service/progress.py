"""Detects a role without progress, and times restarts after failures. No I/O, no clock."""

from __future__ import annotations

_PAUSE_S = 5.0  # without a new item: none arrive any more
_CALM_S = 300.0  # a failure this long after the last one counts as the first
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0


class Progress:
    """Compares the items received with the items settled: used, or rejected with a reason.

    A role whose loop turns is not necessarily alive; one that settles its input is. An item that waits while
    no others come is no sign of a failure: the last image before camera and IMU were unplugged waits for the
    IMU.
    """

    def __init__(self) -> None:
        self._received = self._settled = 0
        self._arrived_s: float | None = None  # when the last item arrived, since one was settled
        self._stuck_s = 0.0

    def look(self, received: int, settled: int, now_s: float) -> float:
        """Take the counters as they are now.

        Args:
            received: Items received so far.
            settled: Items used or rejected so far.
            now_s: A steady clock.

        Returns:
            How long items have arrived without one being settled, s; 0: there is progress, or none arrive.
        """
        if settled != self._settled:
            self._received, self._settled, self._arrived_s, self._stuck_s = received, settled, None, 0.0
            return 0.0
        before_s = self._arrived_s
        if before_s is not None and now_s - before_s > _PAUSE_S:
            self._arrived_s, self._stuck_s = None, 0.0
        if received > self._received:
            self._stuck_s += 0.0 if self._arrived_s is None else now_s - self._arrived_s
            self._received, self._arrived_s = received, now_s
        return self._stuck_s


class Restarts:
    """Pauses before the restarts of a part that failed: none at first, then doubling.

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
        """Note a failure; return the pause before the next start, s."""
        self.count += 1
        self._row = self._row + 1 if now_s - self._last_s < _CALM_S else 1
        self.why, self._last_s = why, now_s
        pause_s = 0.0
        if self._row > 1:
            pause_s = min(_FIRST_PAUSE_S * 2.0 ** min(self._row - 2, 10), _LONGEST_PAUSE_S)
        self._until_s = now_s + pause_s
        return pause_s

    def waiting_s(self, now_s: float) -> float:
        """Return the rest of the pause, s; 0: it may start."""
        return max(self._until_s - now_s, 0.0)
