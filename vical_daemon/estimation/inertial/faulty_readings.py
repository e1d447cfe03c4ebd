"""Faults of single inertial readings: clipped at the sensor's range, and spikes.

Clipped ones are bridged (`clipped_readings`); spikes are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np

from vical_daemon.estimation.inertial.stamp_steps import FADES, LEARN

T = TypeVar("T")
Six = Sequence[float]
"""One reading in plain numbers, rad/s and m/s^2: of six, numpy takes ten times as long."""

_AT_RANGE = 8
"""So many readings of one channel at exactly its extreme value, and so many different values close to it, or
so many steps of its resolution at once to get there: a coarse channel at rest repeats its extreme, too."""
_STOPS = 4
"""A channel in motion that stops for so many readings is at its range: noise and motion would go on."""
_SLOWS = 1.5
"""Steps of its resolution: a channel that comes to its extreme by less at once has slowed down: a crest."""
_MOST = 0.75
"""Of the first readings, in which the other channels must change while one stops."""
_OFTEN = 4.0
"""Times as often as any value close to it must the extreme occur. Noise makes it the rarest of them; a swing
stays in the last step of a coarse sensor for 2.4 times as long as in the one before."""
_MORE = 2
"""So many readings more at that value may be chance: only the way up to the crest may have been seen yet."""
_NEAR = 0.9
"""Of the extreme: where values are close to it."""
_VALUES = 64
"""Different values close to the extreme that are counted."""
_SPIKE = 10.0
"""Times the largest error of prediction of late by which a reading must stand out."""
_HARMFUL = (0.1, 1.0)
"""Smaller spikes are left in, rad/s and m/s^2: at 100 Hz one such reading turns the attitude by 1 mrad and
changes the velocity by 10 mm/s, about what one image leaves open."""
_CHANNELS = ((0, 1, 2, 6, 7, 8), (3, 4, 5, 9, 10, 11))
"""Of each sensor, upwards and downwards."""


class RangeLimits(Generic[T]):
    """Finds the readings that are clipped at a sensor's range, without knowing the range.

    The six channels are followed upwards and downwards. A value that comes back again and again as the
    extreme of one of them is the end of the range, for all three channels of that sensor. So is one at which
    a channel stops in full motion: it comes there over many of its steps at once, and stays. Readings that
    repeat such a value are held until it is decided. Where a driver reads a sensor more often than it
    measures, its three channels repeat at once, which shows nothing about the range. A stream whose first
    readings repeat one channel, while the others of that sensor change, begins at the end. A larger value
    later shows that it was not the end. No channel is at the end where another has been further.

    Attributes:
        found: How often an end was found.
    """

    def __init__(self) -> None:
        self._extreme = [1e-9] * 12
        self._near = [_NEAR * 1e-9] * 12
        self._at = [0] * 12
        self._usual = [(-_NEAR * 1e-9, _NEAR * 1e-9)] * 6  # values of each channel that are not close to one
        self._stays = [0] * 12  # readings in a row at the extreme, reached in motion
        self._staying = False  # any of them
        self._values: list[dict[float, int]] = [{} for _ in range(12)]
        self._clips = [False] * 12
        self._step = [math.inf] * 2  # smallest change of a channel of each sensor: its resolution, or more
        self._previous: Six = (math.nan,) * 6
        self._held: list[tuple[Six, T]] = []
        self._first: list[Six] = []
        self.found = 0

    def sift(self, six: Six, item: T) -> list[tuple[Six, T, tuple[int, ...]]]:
        """Take a reading (rad/s, m/s^2).

        Returns:
            The readings that are decided on, in order, each with those of its six channels at their range.
        """
        usual = not self._staying
        for i, (value, before, (low, high)) in enumerate(zip(six, self._previous, self._usual, strict=True)):
            if 0.0 < abs(value - before) < self._step[i // 3]:
                self._step[i // 3] = abs(value - before)
            if not low <= value <= high:
                usual = False
        waiting = 0 if usual else self._close_to_extremes(six)
        if len(self._first) <= _AT_RANGE:
            self._first.append(six)
            self._begins_at_range()
        self._previous = six
        if not (waiting or self._held):
            return [(six, item, self.at_range(six))]
        self._held.append((six, item))
        decided = max(len(self._held) - waiting, 0)
        held, self._held = self._held[:decided], self._held[decided:]
        return [(x, kept, self.at_range(x)) for x, kept in held]

    def restart(self) -> None:
        """Another recording follows: readings that wait for a decision are dropped, the range stays."""
        self._held, self._stays, self._staying = [], [0] * 12, False

    def at_range(self, six: Six) -> tuple[int, ...]:
        """Which of the six channels of a reading are at the end of their range."""
        if True not in self._clips:
            return ()
        both, extreme = (*six, *(-x for x in six)), self._extreme
        return tuple(
            i % 6
            for channels in _CHANNELS
            for i in channels
            if both[i] == extreme[i] and extreme[i] in self._ends(channels)
        )

    def _ends(self, channels: Sequence[int]) -> set[float]:
        """Where the range of a sensor ends."""
        return {self._extreme[i] for i in channels if self._clips[i]}

    def _close_to_extremes(self, six: Six) -> int:
        """Take a reading of which a value is close to an extreme, or was; the newest readings that wait."""
        a, b, c, d, e, f = six
        both = (a, b, c, d, e, f, -a, -b, -c, -d, -e, -f)
        fresh = _measured_anew(six[:3], self._previous[:3]), _measured_anew(six[3:], self._previous[3:])
        waiting = 0
        for i, (value, near) in enumerate(zip(both, self._near, strict=True)):
            if not fresh[i % 6 // 3]:
                continue
            if value > near:
                self._follow(i, value, abs(six[i % 6] - self._previous[i % 6]))
                self._near[i] = _NEAR * self._extreme[i]
                if 1 < self._stays[i] < _STOPS and not self._clips[i]:
                    waiting = max(waiting, self._stays[i])
            elif self._stays[i]:
                self._stays[i] = 0
        self._usual = [(-low, high) for high, low in zip(self._near[:6], self._near[6:], strict=True)]
        self._staying = any(self._stays)
        return waiting

    def _follow(self, i: int, value: float, change: float) -> None:
        extreme, values = self._extreme[i], self._values[i]
        if value > extreme:
            values[extreme] = self._at[i]
            self._values[i] = {v: n for v, n in values.items() if v > _NEAR * value}
            self._extreme[i], self._at[i], self._clips[i] = value, 1, False
        elif value == extreme:
            self._at[i] += 1
        elif value in values or len(values) < _VALUES:
            values[value] = values.get(value, 0) + 1
        step = self._step[i % 6 // 3]
        if value < self._extreme[i] or (value > extreme and change < _SLOWS * step):
            self._stays[i] = 0
        elif self._stays[i] or change >= _AT_RANGE * step:
            self._stays[i] = self._stays[i] + 1 if value == extreme else 1
        if value == extreme and value >= _NEAR * max(self._extreme[k] for k in _CHANNELS[i % 6 // 3]):
            clips = self._stays[i] >= _STOPS or self._returns(i)
            self.found += clips and not self._clips[i]
            self._clips[i] |= clips

    def _begins_at_range(self) -> None:
        """Find out whether a channel has been at the end of its range since the stream began."""
        if len(self._first) <= _AT_RANGE:
            return
        changes = np.count_nonzero(np.diff(self._first, axis=0), axis=0)
        for channel in np.flatnonzero(changes == 0).tolist():
            others = np.delete(changes[channel // 3 * 3 :][:3], channel % 3)
            if others.min() >= _MOST * _AT_RANGE:
                self._clips[channel if self._first[0][channel] > 0.0 else channel + 6] = True
                self.found += 1

    def _returns(self, i: int) -> bool:
        """Whether the extreme of a channel has come back more often than an extreme does."""
        values = self._values[i]
        return len(values) >= _AT_RANGE and self._at[i] > _OFTEN * (max(values.values()) + _MORE)


def _measured_anew(three: Six, previous: Six) -> bool:
    """Whether a reading is new: a channel of the sensor changes, or all three are at its range."""
    if three != previous:
        return True
    sizes = [abs(x) for x in three]
    return min(sizes) > _NEAR * max(sizes)


class SpikeFilter(Generic[T]):
    """Leaves out single readings that neither their neighbours nor the other sensor support.

    A straight line through the two readings before predicts each one. A reading that is far from it is held
    until the next one. It was a spike if that is back where the motion was and the other sensor saw nothing:
    a shock shows in gyro and accelerometer, and a motion goes on. If the next one is not back, either, the
    one after them decides about both.

    The first readings say how large errors of the prediction usually are, so they are taken at once, and
    looked at when there are enough of them: backwards in time, then forwards.

    Args:
        usual: Error of the prediction, gyro rad/s, accelerometer m/s^2; None: the first readings say it.

    Attributes:
        held: The readings that are held, two at most, with whatever was given along.
        spikes: Readings left out.
        late: Items of those of them that had been taken.
    """

    def __init__(self, usual: tuple[float, float] | None = None) -> None:
        self.spikes = 0
        self._begin(usual)

    def _begin(self, usual: tuple[float, float] | None) -> None:
        self.held: list[tuple[Six, T]] = []
        self.late: list[T] = []
        self._first: list[tuple[Six, T]] | None = [] if usual is None else None
        self._last: Six = (math.nan,) * 6
        self._before: Six = (math.nan,) * 6
        self._largest = usual or (0.0, 0.0)  # error of prediction of late: gyro rad/s, accelerometer m/s^2

    def restart(self) -> None:
        """Another recording follows: its first readings do not go on from the last ones."""
        self._begin(None)

    def sift(self, six: Six, item: T) -> list[T]:
        """Take a reading (rad/s, m/s^2) and return the items of those that are good, in order."""
        if self._first is None:
            return self._sifted(six, item)
        self._first.append((six, item))
        if len(self._first) < LEARN:
            return [item]
        first, self._first = self._first, None
        missed = [_apart(first[k][0], _line(first[k - 1][0], first[k - 2][0])) for k in range(2, LEARN)]
        gyro, accel = (2.0 * np.median(missed, axis=0)).tolist()
        self._largest = gyro, accel
        backwards: SpikeFilter[tuple[Six, T]] = SpikeFilter(self._largest)
        good = [x for one in reversed(first) for x in backwards.sift(one[0], one)]
        taken = [x for one in reversed(good) for x in self._sifted(*one)]
        self.held = [x for x in self.held if x[1] == item]
        out = [x for _, x in first if x not in taken and not (self.held and x == item)]
        self.spikes += len(out)
        self.late = [x for x in out if x != item]
        return [item] if item in taken else []

    def _sifted(self, six: Six, item: T) -> list[T]:
        if self.held:
            first = self.held[0][0]
            back, off = _apart(six, self._last), _apart(first, self._last)
            gyro, accel = (x / max(usual, 1e-12) for x, usual in zip(off, self._largest, strict=True))
            which = int(accel > gyro)
            missed = self._missed(six, len(self.held) + 1)
            if back[which] < 0.5 * off[which] and not self._stands_out(missed):
                self.spikes += len(self.held)
                self.held = []
                self._note(six, missed)
                return [item]
            self.held.append((six, item))
            if len(self.held) == 2:
                return []
            released, self.held = self.held, []
            for good, _ in released:
                self._note(good, self._missed(good))
            return [x for _, x in released]
        missed = self._missed(six)
        if self._stands_out(missed):
            self.held = [(six, item)]
            return []
        self._note(six, missed)
        return [item]

    def _stands_out(self, missed: tuple[float, float]) -> bool:
        """Whether an error of the prediction is one of a spike: of one sensor only."""
        (gyro, accel), (usual_gyro, usual_accel) = missed, self._largest
        gyro_off = gyro > _HARMFUL[0] and gyro > _SPIKE * usual_gyro
        return gyro_off != (accel > _HARMFUL[1] and accel > _SPIKE * usual_accel)

    def _missed(self, six: Six, steps: int = 1) -> tuple[float, float]:
        """Errors of the prediction over one reading: gyro rad/s, accelerometer m/s^2.

        A straight line over several steps misses a bend of the motion by the sum of their numbers.
        """
        gyro, accel = _apart(six, _line(self._last, self._before, steps))
        more = 0.5 * steps * (steps + 1)
        return gyro / more, accel / more

    def _note(self, six: Six, missed: tuple[float, float]) -> None:
        (gyro, accel), (usual_gyro, usual_accel) = missed, self._largest
        if not math.isnan(gyro):  # one that was not noticed at most doubles it
            fades_gyro, fades_accel = FADES * usual_gyro, FADES * usual_accel
            self._largest = (
                fades_gyro if gyro <= fades_gyro else min(gyro, 2.0 * usual_gyro),
                fades_accel if accel <= fades_accel else min(accel, 2.0 * usual_accel),
            )
        self._before, self._last = self._last, six


def _line(last: Six, before: Six, steps: int = 1) -> Six:
    """Where a straight line through two readings is some steps later."""
    a, b, c, d, e, f = last
    u, v, w, x, y, z = before
    return (
        a + steps * (a - u),
        b + steps * (b - v),
        c + steps * (c - w),
        d + steps * (d - x),
        e + steps * (e - y),
        f + steps * (f - z),
    )


def _apart(a: Six, b: Six) -> tuple[float, float]:
    """How far two readings are from each other: gyro rad/s, accelerometer m/s^2."""
    return math.dist(a[:3], b[:3]), math.dist(a[3:], b[3:])
