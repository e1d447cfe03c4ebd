"""Steps in the stamps of an IMU: its driver has corrected the mapping of the device's clock.

A driver learns the clock of a device from arrivals. If the first ones were late, it notices some seconds
later, and from one reading to the next all stamps move by milliseconds. To a filter this is a jump of the
time shift, with motion missing. The device's clock itself is even. So readings are put on an even axis, and
the step is added to the reported time shift: t_imu = t_cam + shift by the stamps of *now*. Only stamps that
are even except for such steps are changed; others (taken on arrival) are left alone.

A device may begin to sample at another rate: then all intervals differ from the usual one, and alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.significance import SURE_SIGMAS

LEARN = 20  # readings by which the usual interval is known, and how well the motion is predicted
_LEAST_S = 1e-4
"""Smaller steps are like jitter. Stamps that deviate by half as much from an even grid were not made by a
device's clock."""
FADES = 1.0 - 1.0 / 500.0  # of a largest deviation, a reading: some hundred are remembered
_MOST = 0.55  # of an interval
_SETTLED = 4  # readings after which a step is one: a single late stamp is followed by a short interval
_SPREAD = 0.5
"""Intervals by which drivers make up for a step back, in usual ones: as many in a row as the step needs."""
_SPREAD_OFF = 0.01  # within this, intervals are such ones


@dataclass(slots=True)
class StampSteps:
    """Follows the stamps of one IMU.

    Attributes:
        total_s: All steps so far: stamps say so much more than an even clock would, s.
    """

    total_s: float = 0.0
    _last_s: float = np.nan
    _first: list[float] = field(default_factory=list)
    _period_s: float = 0.0
    _largest_s: float = 0.0
    _interval_s: float = np.nan
    _alike: int = 0  # latest intervals that are like the one before, and not like the usual one
    _before_s: float = 0.0  # the total before a step that is not certain yet
    _since: int = 0
    _untold_s: float = 0.0  # steps that have become certain since the last call of `news`

    def even(self, t_s: float) -> float:
        """Put the stamp of the next reading, s, on the even axis."""
        interval_s, self._last_s = t_s - self._last_s, t_s
        if self._period_s:
            self._see_rate(interval_s)
            self._follow(interval_s - self._period_s)
        elif interval_s > 0.0:
            self._learn(interval_s)
        return t_s - self.total_s

    def _learn(self, interval_s: float) -> None:
        self._first.append(interval_s)
        if len(self._first) == LEARN:
            self._period_s = float(np.median(self._first))
            self._largest_s = float(np.abs(np.array(self._first) - self._period_s).max())
            self._first.clear()

    def _see_rate(self, interval_s: float) -> None:
        """Notice another rate; what was taken for steps since it began is taken back."""
        alike, self._interval_s = abs(interval_s - self._interval_s) < 0.5 * _LEAST_S, interval_s
        other = interval_s > _LEAST_S <= abs(interval_s - self._period_s)
        self._alike = self._alike + 1 if alike and other else 0
        spread = abs(interval_s / self._period_s - _SPREAD) < _SPREAD_OFF
        if self._alike < (LEARN if spread else _SETTLED):
            return
        self._period_s, self._alike = interval_s, 0
        if self._since:
            self.total_s, self._since = self._before_s, 0

    def _follow(self, deviation_s: float) -> None:
        size_s = abs(deviation_s)
        if deviation_s > _MOST * self._period_s:  # readings are missing
            return
        if self._largest_s < 0.5 * _LEAST_S and _LEAST_S < size_s < _MOST * self._period_s:
            if not self._since:
                self._before_s, self._since = self.total_s, _SETTLED
            self.total_s += deviation_s
            return
        if size_s < _LEAST_S:
            self._period_s += 0.01 * deviation_s
        self._largest_s = max(size_s, self._largest_s * FADES)
        if self._since:
            self._since -= 1
            if not self._since:
                self._settle()

    def _settle(self) -> None:
        """A step has been followed by even stamps: it was one, or a single late stamp."""
        step_s = self.total_s - self._before_s
        if abs(step_s) < _LEAST_S:
            self.total_s = self._before_s
            return
        self._untold_s += step_s

    def news(self, stated_s: float = 0.0) -> list[Event]:
        """Steps that have become certain since the last call, together, if larger than the driver states.

        Within what it states a mapping moves all the time, as arrivals jitter. Such steps are not added up:
        between them the mapping slides back, as its slope is corrected, so that their sum grows while the
        stamps stay where they are.

        Args:
            stated_s: One sigma of the mapping as the driver states it, s; 0: it states nothing.
        """
        step_s, self._untold_s = self._untold_s, 0.0
        if not step_s or abs(step_s) < SURE_SIGMAS * stated_s:
            return []
        return [Event(EventKind.IMU_CLOCK_REMAPPED, value=step_s)]
