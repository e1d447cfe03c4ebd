"""Counters that every camera source keeps."""

from __future__ import annotations

from collections import deque

import numpy as np

from vical_drivers.samples import SourceStats

WINDOW = 256
"""Frames over which rate and jitter are taken."""


class FrameStatistics:
    """Counts frames and losses; measures rate and jitter of the stamps."""

    def __init__(self) -> None:
        self.frames = 0
        self.lost = 0
        self.corrupt = 0
        self.reconnects = 0
        self.extra: dict[str, float] = {}
        self._recent: deque[tuple[int, int]] = deque(maxlen=WINDOW)  # (frame number, stamp)
        self._number = 0

    def add(self, t_ns: int, lost_before: int) -> None:
        """Count one delivered frame with its stamp and the losses before it."""
        self.frames += 1
        self.lost += lost_before
        self._number += 1 + lost_before
        self._recent.append((self._number, t_ns))

    def lost_before_last(self, frames: int) -> None:
        """Frames turn out to be missing before the latest one; whoever counts them as lost calls `add`."""
        if self._recent:
            number, t_ns = self._recent.pop()
            self._recent.append((number + frames, t_ns))

    def count(self, name: str, times: int = 1) -> None:
        """Count an event of one kind of source."""
        self.extra[name] = self.extra.get(name, 0.0) + times

    def restart(self) -> None:
        """The source was opened anew: rate and jitter start afresh."""
        self.reconnects += 1
        self._recent.clear()

    def snapshot(self, *, clock_skew_ppm: float = 0.0, **extra: float) -> SourceStats:
        """Return the counters; rate from frame numbers (losses do not slow it), jitter about that line."""
        rate_hz = jitter_us = 0.0
        if len(self._recent) >= 3:
            numbers, stamps = np.array(self._recent, dtype=np.int64).T
            x, y = (numbers - numbers[0]).astype(float), (stamps - stamps[0]).astype(float)
            slope, intercept = np.polyfit(x, y, 1)
            rate_hz = float(1e9 / slope) if slope > 0 else 0.0
            jitter_us = float(np.std(y - slope * x - intercept)) * 1e-3
        return SourceStats(
            samples=self.frames,
            lost=self.lost,
            checksum_errors=self.corrupt,
            reconnects=self.reconnects,
            rate_hz=rate_hz,
            clock_skew_ppm=clock_skew_ppm,
            jitter_us=jitter_us,
            extra={**self.extra, **extra},
        )
