"""Faults of single inertial readings: clipped at the sensor's range, and spikes.

Both are left out before integration; what remains is a short gap that interpolation bridges, or a gap.
"""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np

from vical_daemon.estimation.measurements import BoolArray, FloatArray

T = TypeVar("T")

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
_HARMFUL = np.array([0.1, 1.0])
"""Smaller spikes are left in, rad/s and m/s^2: at 100 Hz one such reading turns the attitude by 1 mrad and
changes the velocity by 10 mm/s, about what one image leaves open."""
_FADES = 1.0 - 1.0 / 200.0
"""Of that largest error, a reading: some hundred readings are remembered."""
_LEARN = 20
"""Readings that show how well the motion is predicted, before any of them can be a spike."""


class RangeLimits:
    """Finds the readings that are clipped at a sensor's range, without knowing the range.

    The six channels are followed upwards and downwards. A value that comes back again and again as the
    extreme of one of them is the end of the range, for all three channels of that sensor. A larger value
    later shows that it was not.
    """

    def __init__(self) -> None:
        self._extreme = np.full(12, 1e-9)
        self._at = np.zeros(12, dtype=np.int64)
        self._values: list[dict[float, int]] = [{} for _ in range(12)]
        self._clips = np.zeros(12, dtype=bool)

    def clipped(self, six: FloatArray) -> BoolArray:
        """Tell which channels of a reading (rad/s, m/s^2, shape (6,)) are at their range; shape (6,)."""
        both = np.concatenate([six, -six])
        high = both > _NEAR * self._extreme
        if high.any():
            for i in np.flatnonzero(high).tolist():
                self._follow(i, float(both[i]))
        if not self._clips.any():
            return self._clips[:6]
        at_end = both == self._extreme
        for sensor in (slice(0, 3), slice(3, 6)):
            opposite = slice(sensor.start + 6, sensor.stop + 6)
            ends = {
                *self._extreme[sensor][self._clips[sensor]],
                *self._extreme[opposite][self._clips[opposite]],
            }
            for part in (sensor, opposite):
                at_end[part] &= np.isin(self._extreme[part], list(ends))
        clipped: BoolArray = at_end[:6] | at_end[6:]
        return clipped

    def _follow(self, i: int, value: float) -> None:
        extreme, values = float(self._extreme[i]), self._values[i]
        if value > extreme:
            values[extreme] = int(self._at[i])
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
        self.held: tuple[FloatArray, T] | None = None
        self.spikes = 0
        self._last: FloatArray = np.full(6, np.nan)
        self._before: FloatArray = np.full(6, np.nan)
        self._largest = np.zeros(2)  # error of prediction of late: gyro rad/s, accelerometer m/s^2
        self._first: list[FloatArray] = []
        self._count = 0

    def restart(self) -> None:
        """Another recording follows: its first readings do not go on from the last ones."""
        self.held, self._count = None, 0
        self._last, self._before = np.full(6, np.nan), np.full(6, np.nan)

    def sift(self, six: FloatArray, item: T) -> list[T]:
        """Take a reading (rad/s, m/s^2, shape (6,)) and return the items of those that are good, in order."""
        if self.held is not None:
            held_six, held_item = self.held
            self.held = None
            back = np.linalg.norm((six - self._last).reshape(2, 3), axis=1)
            off = np.linalg.norm((held_six - self._last).reshape(2, 3), axis=1)
            which = int((off / np.maximum(self._largest, 1e-12)).argmax())
            if back[which] < 0.5 * off[which]:
                self.spikes += 1
                self._note(six)
                return [item]
            self._note(held_six)
            self._note(six)
            return [held_item, item]
        missed = self._missed(six)
        stands_out = missed > np.maximum(_SPIKE * self._largest, _HARMFUL)
        if len(self._first) >= _LEARN and stands_out.sum() == 1:
            self.held = six, item
            return []
        self._note(six)
        return [item]

    def _missed(self, six: FloatArray) -> FloatArray:
        error = (six - 2.0 * self._last + self._before).reshape(2, 3)
        size: FloatArray = np.sqrt((error**2).sum(axis=1))
        return size

    def _note(self, six: FloatArray) -> None:
        if self._count >= 2:
            missed = self._missed(six)
            if len(self._first) < _LEARN:  # there may be spikes among the first readings
                self._first.append(missed)
                self._largest = 2.0 * np.median(self._first, axis=0)
            else:  # one that was not noticed at most doubles it
                missed = np.minimum(missed, 2.0 * self._largest)
                self._largest = np.maximum(missed, _FADES * self._largest)
        self._before, self._last = self._last, six
        self._count += 1
