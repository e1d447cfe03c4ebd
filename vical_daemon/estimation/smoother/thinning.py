"""Leaves out images of a fast camera: neighbouring images add little and cost as much as others."""

from __future__ import annotations

from collections import deque
from math import ceil

_LATEST = 31  # intervals that tell the rate


class Thinning:
    """Takes every n-th image, n by the camera's rate.

    Images are counted. To leave out an image because its stamp comes too soon after the last would be to
    choose by the stamp's error: with 1 ms of jitter, images stamped early went and images stamped late
    stayed, which bent the time shift by 0.1 ms.

    Args:
        most_hz: Images wanted per second, at most.
    """

    def __init__(self, most_hz: float) -> None:
        self._most_hz = most_hz
        self._intervals_s: deque[float] = deque(maxlen=_LATEST)
        self._before_s: float | None = None
        self._left_out = 0

    def takes(self, t_s: float) -> bool:
        """Whether to use the next image, stamped `t_s` (s, any origin, increasing)."""
        if self._before_s is not None:
            self._intervals_s.append(t_s - self._before_s)
        self._before_s = t_s
        self._left_out += 1
        if self._left_out < self._every():
            return False
        self._left_out = 0
        return True

    def _every(self) -> int:
        if not self._intervals_s:
            return 1
        intervals_s = sorted(self._intervals_s)
        last = len(intervals_s) - 1
        median_s = 0.5 * (intervals_s[last // 2] + intervals_s[(last + 1) // 2])
        return max(1, ceil(1.0 / (self._most_hz * median_s) - 1e-6))
