"""Faults of single inertial readings: clipped at the sensor's range, and spikes.

Both are left out before integration; what remains is a short gap that interpolation bridges, or a gap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np

from vical_daemon.estimation.inertial.stamp_steps import LEARN

T = TypeVar("T")
Six = Sequence[float]
"""One reading in plain numbers, rad/s and m/s^2: of six, numpy takes ten times as long."""

_AT_RANGE = 8
"""So many readings of one channel at exactly its extreme value, and so many different values close to it: a
coarse channel at rest repeats its extreme, too, but has few values."""
_OFTEN = 4.0
"""Times as often as a value close to it must the extreme occur: without clipping it is the rarest of them."""
_NEAR = 0.9
"""Of the extreme: where values are close to it."""
_VALUES = 64
"""Different values close to the extreme that are counted."""
_SPIKE = 10.0
"""Times the largest error of prediction of late by which a reading must stand out."""
_HARMFUL = (0.1, 1.0)
"""Smaller spikes are left in, rad/s and m/s^2: at 100 Hz one such reading turns the attitude by 1 mrad and
changes the velocity by 10 mm/s, about what one image leaves open."""
_FADES = 1.0 - 1.0 / 200.0
"""Of that largest error, a reading: some hundred readings are remembered."""
_CHANNELS = ((0, 1, 2, 6, 7, 8), (3, 4, 5, 9, 10, 11))
"""Of each sensor, upwards and downwards."""


class RangeLimits:
    """Finds the readings that are clipped at a sensor's range, without knowing the range.

    The six channels are followed upwards and downwards. A value that comes back again and again as the
    extreme of one of them is the end of the range, for all three channels of that sensor. A larger value
    later shows that it was not.
    """

    def __init__(self) -> None:
        self._extreme = [1e-9] * 12
        self._near = [_NEAR * 1e-9] * 12
        self._at = [0] * 12
        self._values: list[dict[float, int]] = [{} for _ in range(12)]
        self._clips = [False] * 12

    def clipped(self, six: Six) -> bool:
        """Whether a channel of a reading (rad/s, m/s^2) is at the end of its range."""
        a, b, c, d, e, f = six
        both = (a, b, c, d, e, f, -a, -b, -c, -d, -e, -f)
        extreme = self._extreme
        for i, (value, near) in enumerate(zip(both, self._near, strict=True)):
            if value > near:
                self._follow(i, value)
                self._near[i] = _NEAR * extreme[i]
        return True in self._clips and any(
            both[i] == extreme[i] and extreme[i] in self._ends(channels)
            for channels in _CHANNELS
            for i in channels
        )

    def _ends(self, channels: Sequence[int]) -> set[float]:
        """Where the range of a sensor ends."""
        return {self._extreme[i] for i in channels if self._clips[i]}

    def _follow(self, i: int, value: float) -> None:
        extreme, values = self._extreme[i], self._values[i]
        if value > extreme:
            values[extreme] = self._at[i]
            self._values[i] = {v: n for v, n in values.items() if v > _NEAR * value}
            self._extreme[i], self._at[i], self._clips[i] = value, 1, False
        elif value == extreme:
            self._at[i] += 1
            usual = sum(values.values()) / max(len(values), 1)
            self._clips[i] = (
                self._at[i] >= _AT_RANGE and len(values) >= _AT_RANGE and self._at[i] > _OFTEN * usual
            )
        elif value in values or len(values) < _VALUES:
            values[value] = values.get(value, 0) + 1


class SpikeFilter(Generic[T]):
    """Leaves out single readings that neither their neighbours nor the other sensor support.

    A straight line through the two readings before predicts each one. A reading that is far from it is held
    until the next one. It was a spike if that is back where the motion was and the other sensor saw nothing:
    a shock shows in gyro and accelerometer, and a motion goes on.

    Attributes:
        held: The reading that is held, with whatever was given along; None: none.
        spikes: Readings left out.
    """

    def __init__(self) -> None:
        self.held: tuple[Six, T] | None = None
        self.spikes = 0
        self._last: Six = (math.nan,) * 6
        self._before: Six = (math.nan,) * 6
        self._largest = [0.0, 0.0]  # error of prediction of late: gyro rad/s, accelerometer m/s^2
        self._first: list[tuple[float, float]] = []
        self._count = 0

    def restart(self) -> None:
        """Another recording follows: its first readings do not go on from the last ones."""
        self.held, self._count = None, 0
        self._last = self._before = (math.nan,) * 6

    def sift(self, six: Six, item: T) -> list[T]:
        """Take a reading (rad/s, m/s^2) and return the items of those that are good, in order."""
        if self.held is not None:
            held_six, held_item = self.held
            self.held = None
            back, off = _apart(six, self._last), _apart(held_six, self._last)
            gyro, accel = (x / max(usual, 1e-12) for x, usual in zip(off, self._largest, strict=True))
            which = int(accel > gyro)
            if back[which] < 0.5 * off[which]:
                self.spikes += 1
                self._note(six, self._missed(six))
                return [item]
            self._note(held_six, self._missed(held_six))
            self._note(six, self._missed(six))
            return [held_item, item]
        missed = self._missed(six)
        if len(self._first) >= LEARN:
            (gyro, accel), (usual_gyro, usual_accel) = missed, self._largest
            gyro_off = gyro > _HARMFUL[0] and gyro > _SPIKE * usual_gyro
            if gyro_off != (accel > _HARMFUL[1] and accel > _SPIKE * usual_accel):
                self.held = six, item
                return []
        self._note(six, missed)
        return [item]

    def _missed(self, six: Six) -> tuple[float, float]:
        """Errors of the prediction: gyro rad/s, accelerometer m/s^2."""
        a, b, c, d, e, f = self._last
        p, q, r, s, t, u = self._before
        return _apart(six, (2.0 * a - p, 2.0 * b - q, 2.0 * c - r, 2.0 * d - s, 2.0 * e - t, 2.0 * f - u))

    def _note(self, six: Six, missed: tuple[float, float]) -> None:
        if self._count >= 2:
            if len(self._first) < LEARN:  # there may be spikes among the first readings
                self._first.append(missed)
                self._largest = (2.0 * np.median(self._first, axis=0)).tolist()
            else:  # one that was not noticed at most doubles it
                (gyro, accel), (usual_gyro, usual_accel) = missed, self._largest
                self._largest = [
                    max(min(gyro, 2.0 * usual_gyro), _FADES * usual_gyro),
                    max(min(accel, 2.0 * usual_accel), _FADES * usual_accel),
                ]
        self._before, self._last = self._last, six
        self._count += 1


def _apart(a: Six, b: Six) -> tuple[float, float]:
    """How far two readings are from each other: gyro rad/s, accelerometer m/s^2."""
    return math.dist(a[:3], b[:3]), math.dist(a[3:], b[3:])
