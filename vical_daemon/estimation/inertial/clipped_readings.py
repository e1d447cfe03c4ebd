"""Readings clipped at a sensor's range: what exceeds the range is bridged, with the uncertainty of that.

A channel at its range shows that the motion is beyond it, and no more. Its value there is that of a cubic
through the readings on either side. It may also be anything from the range to twice as far beyond as the
cubic is at most: an error common to the readings of a run. The other channels keep what they measured.
[docs/math/filter.md]
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.inertial.faulty_readings import Six

_SIDE_NS, _LEAST = 20_000_000, 2
"""A run ends with so many readings of the channel within its range, over so long a time; the cubic is fitted
to as many on either side."""
_EVEN = 3.0**-0.5  # one sigma of an even distribution over half its width
_LONGEST_NS = 1_000_000_000
"""Of a run that is bridged: until it ends, its readings and the images of that time wait."""


class Bridged(NamedTuple):
    """One reading.

    Attributes:
        t_ns: Its stamp, ns.
        six: Rates, rad/s, and specific forces, m/s^2.
        clipping_sigma: One sigma of each of them beyond the sensor's noise, shape (6,); None: there is none.
    """

    t_ns: int
    six: Six
    clipping_sigma: Six | None = None


@dataclass(slots=True)
class _Held:
    """A reading that waits for the end of `waits` runs."""

    t_ns: int
    six: list[float]
    clipping_sigma: list[float] = field(default_factory=lambda: [0.0] * 6)
    waits: int = 0


@dataclass(slots=True)
class _Run:
    """One channel from its first clipped reading on.

    Attributes:
        before: Stamps, ns, and values of the readings before.
        readings: From the first clipped one on.
        clipped: Which of them are.
        after: How many of the latest readings are not.
    """

    before: list[tuple[int, float]]
    readings: list[_Held] = field(default_factory=list)
    clipped: list[bool] = field(default_factory=list)
    after: int = 0

    def add(self, reading: _Held, *, clipped: bool) -> None:
        """Take the next reading."""
        self.readings.append(reading)
        self.clipped.append(clipped)
        self.after = 0 if clipped else self.after + 1
        reading.waits += 1

    @property
    def ended(self) -> bool:
        """Whether enough readings after the last clipped one have come."""
        return self.after >= _LEAST and self._apart_ns(-self.after) >= _SIDE_NS

    @property
    def too_long(self) -> bool:
        """Whether its end is no longer waited for."""
        return self._apart_ns(0) > _LONGEST_NS

    @property
    def has_just_begun(self) -> bool:
        """Whether the motion cannot be far beyond the range yet."""
        return self._apart_ns(0) < _SIDE_NS

    def _apart_ns(self, first: int) -> int:
        return self.readings[-1].t_ns - self.readings[first].t_ns


class ClippedReadings:
    """Bridges clipped readings of one stream; readings come out in order, those in and after a run later."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, Six]] = deque()
        self._held: deque[_Held] = deque()
        self._runs: dict[int, _Run] = {}

    def take(self, t_ns: int, six: Six, at_range: Sequence[int]) -> list[Bridged]:
        """Take a reading.

        Args:
            t_ns: Its stamp, ns.
            six: Rates, rad/s, and specific forces, m/s^2.
            at_range: Which of the six are at the end of their range.

        Returns:
            The readings whose values are settled.
        """
        if at_range or self._held:
            self._hold(_Held(t_ns, list(six)), at_range)
            out = self._settled()
        else:
            out = [Bridged(t_ns, six)]
        self._recent.append((t_ns, six))
        if self._recent[0][0] < t_ns - _LONGEST_NS:
            self._recent.popleft()
        return out

    def rest(self) -> list[Bridged]:
        """No more readings come: return those that are held."""
        for channel, run in self._runs.items():
            self._bridge(run, channel)
        self._runs = {}
        return self._settled()

    def _hold(self, reading: _Held, at_range: Sequence[int]) -> None:
        self._held.append(reading)
        for channel in at_range:
            if channel not in self._runs:
                self._runs[channel] = _Run(self._before(reading.t_ns, channel))
        for channel, run in list(self._runs.items()):
            run.add(reading, clipped=channel in at_range)
            if run.ended or run.too_long:
                self._bridge(run, channel)
                del self._runs[channel]

    def _before(self, t_ns: int, channel: int) -> list[tuple[int, float]]:
        near: list[tuple[int, float]] = []
        for s, six in reversed(self._recent):
            if s < t_ns - (_SIDE_NS if len(near) >= _LEAST else _LONGEST_NS):
                break
            near.append((s, six[channel]))
        return near[::-1]

    def _settled(self) -> list[Bridged]:
        out = []
        while self._held and self._held[0].waits == 0:
            x = self._held.popleft()
            out.append(Bridged(x.t_ns, x.six, x.clipping_sigma if any(x.clipping_sigma) else None))
        return out

    def _bridge(self, run: _Run, channel: int) -> None:
        """Give the clipped readings of a run their values; its readings no longer wait for it."""
        for reading in run.readings:
            reading.waits -= 1
        rail = run.readings[0].six[channel]
        t_ns = np.array([*(t for t, _ in run.before), *(x.t_ns for x in run.readings)])
        values = np.array([*(x for _, x in run.before), *(x.six[channel] for x in run.readings)])
        clipped = np.array([False] * len(run.before) + run.clipped)
        # without an end: anything up to twice the range, and just beyond it where the run has only begun
        half = 0.5 * abs(rail)
        beyond = np.full(len(t_ns), 0.0 if run.has_just_begun else half)
        if run.after >= _LEAST and len(run.before) >= _LEAST:
            u = (t_ns - t_ns[0]) / (t_ns[-1] - t_ns[0])
            powers = np.stack([np.ones_like(u), u, u * u, u**3], axis=1)
            cubic = powers @ np.linalg.pinv(powers[~clipped])
            beyond = np.copysign(1.0, rail) * (cubic @ values[~clipped] - rail)
            half = float(np.abs(beyond[clipped]).max())
        for reading, off, is_clipped in zip(
            run.readings, beyond[len(run.before) :], run.clipped, strict=True
        ):
            if is_clipped:
                reading.six[channel] = rail + float(np.copysign(max(off, 0.0), rail))
                reading.clipping_sigma[channel] = _EVEN * half
