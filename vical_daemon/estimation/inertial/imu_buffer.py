"""Inertial readings of the recent past: a bounded buffer that cuts a stretch exactly where asked.

Between two samples the measured rate and specific force are cubic in time (Hermite, slopes by central
differences of fourth order): straight lines would shorten a 3 Hz shake by 0.3 % at 100 Hz.
[docs/math/filter.md]
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dgelss

from vical_daemon.estimation.measurements import FloatArray, IntArray

GAP_S = 0.05
"""Between samples further apart than this nothing is known, s. A cubic over 50 ms misses a 3 Hz motion of
1 rad/s by at most h^4 w^4 / 384 = 2e-3 rad/s, less than 1e-4 rad in all; over 100 ms by 16 times as much."""
EVEN = 1.5  # usual intervals: between even readings there is no longer one
GAP_PERIODS = 4.0  # and than this many usual intervals: a slow IMU has no gap at every sample
_LEAST_HALF_S = 1e-3  # of an average at either end of the data: one interval of the fastest IMUs
BLOCK_S = 5.005e-3
"""A block of `BlockMeans` may be so long: readings of up to 333 Hz stay as they are; stamps have jitter."""
_DISTINCT = 1e-3
"""Stamps nearer to each other than this share of the others' distance are one: the parabola through even ones
has a ratio of singular values of 0.04 or more."""
_ROOM = 4096  # readings for which there is room at first
_USUAL = 201  # samples whose median interval is the usual one


class ImuSegment(NamedTuple):
    """Consecutive inertial readings that start and end exactly where asked.

    Attributes:
        t_s: Instants, s since the buffer's base, shape (n + 1,).
        gyro: Measured rates, rad/s, shape (n + 1, 3).
        accel: Measured specific forces, m/s^2, shape (n + 1, 3).
        gap_s: Longest interval between two real samples used, s.
        gyro_slope: Their derivatives by time, rad/s^2, shape (n + 1, 3); None: straight lines.
        accel_slope: m/s^3, shape (n + 1, 3).
        clipping_sigma: One sigma of what clipped readings miss, common to the segment, rad/s and m/s^2, shape
            (n + 1, 6); None: none is clipped.
        trend: See `ImuBuffer.trend`, at the end; None: too few readings.
    """

    t_s: FloatArray
    gyro: FloatArray
    accel: FloatArray
    gap_s: float
    gyro_slope: FloatArray | None = None
    accel_slope: FloatArray | None = None
    clipping_sigma: FloatArray | None = None
    trend: FloatArray | None = None


class ImuBuffer:
    """Time-ordered inertial readings of the recent past, in one growing array that is trimmed.

    Args:
        base_ns: All float times are seconds since this stamp.

    Attributes:
        spread_s2: Variance of the instants of which a row is the mean, s^2; 0: rows are single readings.
    """

    def __init__(self, base_ns: int) -> None:
        self.base_ns, self.spread_s2 = base_ns, 0.0
        self._rows = np.empty((_ROOM, 7))
        self._start = 0
        self._stop = 0
        self._clipping_sigma: FloatArray | None = None  # of each row; None: no reading was clipped

    def __len__(self) -> int:
        return self._stop - self._start

    def __getstate__(self) -> dict[str, object]:
        """A copy, or a saved estimator, holds the readings without the room around them."""
        live = slice(self._start, self._stop)
        sigma = None if self._clipping_sigma is None else self._clipping_sigma[live].copy()
        rows = {"_rows": self.rows.copy(), "_start": 0, "_stop": len(self), "_clipping_sigma": sigma}
        return self.__dict__ | rows

    @property
    def rows(self) -> FloatArray:
        """All readings held: columns t_s, gyro xyz, accel xyz; shape (n, 7)."""
        return self._rows[self._start : self._stop]

    @property
    def newest_s(self) -> float:
        """Time of the newest reading, s; -inf when empty."""
        return float(self._rows[self._stop - 1, 0]) if len(self) else -np.inf

    @property
    def settled_s(self) -> float:
        """Time up to which no later reading changes what is between the readings, s; -inf without three.

        Slopes are by two readings on either side.
        """
        return float(self._rows[self._stop - 3, 0]) if len(self) > 2 else -np.inf

    @property
    def oldest_s(self) -> float:
        """Time of the oldest reading held, s; +inf when empty."""
        return float(self._rows[self._start, 0]) if len(self) else np.inf

    def append(
        self,
        t_s: float,
        gyro: Sequence[float] | FloatArray,
        accel: Sequence[float] | FloatArray,
        clipping_sigma: Sequence[float] | None = None,
    ) -> bool:
        """Add a reading; False (and nothing done) when it is not newer than the last, or not finite.

        Args:
            t_s: Its time, s.
            gyro: rad/s, shape (3,).
            accel: m/s^2, shape (3,).
            clipping_sigma: One sigma of each, beyond the sensor's noise, shape (6,); None: there is none.
        """
        if t_s <= self.newest_s:
            return False
        if self._stop == len(self._rows):
            self._make_room()
        row = (t_s, *gyro, *accel)
        if not math.isfinite(sum(row)):
            return False
        self._rows[self._stop] = row
        if clipping_sigma is not None and self._clipping_sigma is None:
            self._clipping_sigma = np.zeros((len(self._rows), 6))
        if self._clipping_sigma is not None:
            self._clipping_sigma[self._stop] = 0.0 if clipping_sigma is None else clipping_sigma
        self._stop += 1
        return True

    def replace(self, row: int, six: Sequence[float], clipping_sigma: Sequence[float]) -> None:
        """Give a row of `rows` other values, rad/s and m/s^2, and their sigma beyond the noise."""
        if self._clipping_sigma is None:
            self._clipping_sigma = np.zeros((len(self._rows), 6))
        self._rows[self._start + row, 1:] = six
        self._clipping_sigma[self._start + row] = clipping_sigma

    def remove(self, t_s: float) -> None:
        """Forget the reading of an instant, s, or the mean that it is part of, where there is one."""
        if not len(self):
            return
        row = self._start + int(np.argmin(np.abs(self.rows[:, 0] - t_s)))
        if abs(self._rows[row, 0] - t_s) < 0.5 * BLOCK_S:
            for column in (self._rows, self._clipping_sigma):
                if column is not None:
                    column[row : self._stop - 1] = column[row + 1 : self._stop]
            self._stop -= 1

    def _make_room(self) -> None:
        length = max(_ROOM, len(self._rows) * (2 if len(self) > len(self._rows) // 2 else 1))
        live = slice(self._start, self._stop)
        self._rows = _moved(self._rows, live, length)
        if self._clipping_sigma is not None:
            self._clipping_sigma = _moved(self._clipping_sigma, live, length)
        self._start, self._stop = 0, len(self)

    @property
    def usual_gap_s(self) -> float:
        """Longest interval between two readings that interpolation bridges, s."""
        recent = self.rows[-_USUAL:, 0]
        period_s = float(np.median(recent[1:] - recent[:-1])) if len(recent) > 2 else 0.0
        return max(GAP_S, GAP_PERIODS * period_s)

    def gap_within(self, from_s: float, to_s: float) -> bool:
        """Whether readings are missing somewhere between two instants, ends included."""
        t = self.rows[:, 0]
        low = max(int(t.searchsorted(from_s, side="right")) - 1, 0)
        span = t[low : int(t.searchsorted(to_s, side="left")) + 1]
        widest_s = float((span[1:] - span[:-1]).max(initial=0.0))
        return widest_s > GAP_S and widest_s > self.usual_gap_s

    def cut(self, before_s: float) -> None:
        """Forget every reading before `before_s`."""
        self._start += int(self.rows[:, 0].searchsorted(before_s))

    def trim(self, before_s: float) -> None:
        """Forget readings older than `before_s`, but for the last one before it."""
        index = int(self.rows[:, 0].searchsorted(before_s)) - 1
        self._start += max(index, 0)

    def segment(self, from_s: float, to_s: float) -> ImuSegment | None:
        """Return the readings between two instants with interpolated ends; None where not covered."""
        found = self.intervals(np.array([from_s, to_s]))
        return None if found is None else found[0]._replace(trend=self.trend(to_s))

    def trend(self, t_s: float) -> FloatArray | None:
        """First and second derivative of the readings at an instant, by s and by s^2, shape (2, 6).

        By the parabola through two readings on either side (least squares); None: there are less than three.
        """
        rows = self.rows
        after = int(rows[:, 0].searchsorted(t_s))
        near = rows[max(after - 2, 0) : after + 2]
        if len(near) < 3:
            return None
        t = near[:, 0] - t_s
        span_s = max(-float(t[0]), float(t[-1]))
        powers = np.ones((len(t), 3))
        powers[:, 1] = u = t / span_s
        powers[:, 2] = 0.5 * u * u
        _, found, _, _, _, info = dgelss(powers, near[:, 1:], cond=_DISTINCT)
        found[1] /= span_s
        found[2] /= span_s**2
        return None if info else np.asarray(found[1:3])

    def intervals(self, t_s: FloatArray) -> tuple[ImuSegment, npt.NDArray[np.intp]] | None:
        """Return the readings of each interval between instants, one interval after the other.

        Args:
            t_s: Instants in order, s, shape (m + 1,).

        Returns:
            The readings, where the end of an interval and the begin of the next are two nodes of the same
            time, and the first node of each interval, shape (m,). None where not covered.
        """
        rows = self.rows
        if len(rows) < 2 or t_s[0] < rows[0, 0] or t_s[-1] > rows[-1, 0] or (t_s[1:] < t_s[:-1]).any():
            return None
        t = rows[:, 0]
        after, before = (t.searchsorted(t_s, side=side) for side in ("right", "left"))
        inside = np.maximum(before[1:] - after[:-1], 0)
        first = min(max(int(after[0]) - 1, 0), len(rows) - 2)
        last = max(int(before[-1]), first + 1)
        near = rows[max(first - 2, 0) : last + 3]
        slope = _slopes(near, first - max(first - 2, 0), last + 1 - first)
        if self.spread_s2:
            near = _at_instants(near, self.spread_s2)
        here = near[first - max(first - 2, 0) :][: last + 1 - first]
        k = np.minimum(np.maximum(after - 1 - first, 0), last - first - 1)
        value, change = _hermite(here, slope, t_s, k)
        begin = np.zeros(len(t_s), np.intp)
        (inside + 2).cumsum(out=begin[1:])
        read = np.concatenate([here, slope], axis=1)
        rows = np.concatenate([read, np.concatenate([t_s[:, None], value, change], axis=1)])
        at = np.arange(begin[-1]) + (after[:-1] - begin[:-1] - 1 - first).repeat(inside + 2)
        ends = np.arange(len(read), len(rows))
        at[begin[:-1]], at[begin[1:] - 1] = ends[:-1], ends[1:]
        nodes = rows[at]
        gap = float((t[first + 1 : last + 1] - t[first:last]).max())
        sigma = self._clipping_sigma_at(slice(first, last + 1), at, k, t_s, begin)
        segment = ImuSegment(
            *(nodes[:, 0], nodes[:, 1:4], nodes[:, 4:7], gap, nodes[:, 7:10], nodes[:, 10:], sigma)
        )
        return segment, begin[:-1]

    def _clipping_sigma_at(
        self, rows: slice, at: IntArray, before: IntArray, t_s: FloatArray, begin: IntArray
    ) -> FloatArray | None:
        """See `ImuSegment`, at the nodes of intervals: that of rows, and at their ends on straight lines.

        Args:
            rows: Those that count.
            at: Row of each node among them.
            before: Row before each instant.
            t_s: Instants, s, shape (m + 1,).
            begin: First node of each interval, and the number of nodes, shape (m + 1,).
        """
        if self._clipping_sigma is None:
            return None
        sigma, t = self._clipping_sigma[self._start : self._stop][rows], self.rows[rows, 0]
        if not sigma.any():
            return None
        share = ((t_s - t[before]) / (t[before + 1] - t[before]))[:, None]
        ends = sigma[before] + share * (sigma[before + 1] - sigma[before])
        nodes = np.take(sigma, at, axis=0, mode="clip")
        nodes[begin[:-1]], nodes[begin[1:] - 1] = ends[:-1], ends[1:]
        return np.asarray(nodes)

    def around(self, t_s: FloatArray, half_s: float) -> tuple[FloatArray, FloatArray]:
        """Rate and specific force around instants, and their derivatives.

        The imu's turn in a time u is rate u + derivative u^2 / 2, exactly so at u = +-half_s; likewise its
        velocity by the specific force.

        A single reading is noisy, and differences between images miss what a hand shakes in between.

        Args:
            t_s: Instants within the readings held, s, shape (m,).
            half_s: How far around them; less next to the ends of the readings.

        Returns:
            Rate, rad/s, and specific force, m/s^2, as one, shape (m, 6); likewise their derivatives.
        """
        rows = self.rows
        first = max(int(rows[:, 0].searchsorted(t_s[0] - half_s)) - 2, 0)
        rows = rows[first : int(rows[:, 0].searchsorted(t_s[-1] + half_s)) + 2]
        t = rows[:, 0]
        half = np.clip(np.minimum(t_s - t[0], t[-1] - t_s), _LEAST_HALF_S, half_s)
        sums = _Integrals(rows[:, :7], _slopes(rows, 0, len(rows)))
        before, at, after = sums.at(np.concatenate([t_s - half, t_s, t_s + half])).reshape(3, -1, 6)
        half = half[:, None]
        return (after - before) / (2.0 * half), (after - 2.0 * at + before) / half**2


def _moved(values: FloatArray, live: slice, length: int) -> FloatArray:
    """Copy the live rows to the begin of an array of some length."""
    out = np.empty((length, values.shape[1]))
    out[: live.stop - live.start] = values[live]
    return out


class _Integrals:
    """Integrals of readings along cubics between them: t_s, gyro xyz, accel xyz (n, 7) and slopes (n, 6)."""

    def __init__(self, rows: FloatArray, slope: FloatArray) -> None:
        self._t, self._read, self._slope = rows[:, 0], rows[:, 1:], slope
        h = np.diff(self._t)[:, None]
        steps = 0.5 * h * (self._read[:-1] + self._read[1:]) + h * h / 12.0 * (slope[:-1] - slope[1:])
        self._sum = np.concatenate([np.zeros((1, 6)), np.cumsum(steps, axis=0)])

    def at(self, t_s: FloatArray) -> FloatArray:
        """From the first reading to instants, rad and m/s, shape (m, 6)."""
        k = np.clip(self._t.searchsorted(t_s, side="right") - 1, 0, len(self._t) - 2)
        h = (self._t[k + 1] - self._t[k])[:, None]
        u = (t_s - self._t[k])[:, None] / h
        A, B, d = self._slope[k] * h, self._slope[k + 1] * h, self._read[k + 1] - self._read[k]
        bent = 0.5 * A + u * ((3.0 * d - 2.0 * A - B) / 3.0 + u * (A + B - 2.0 * d) / 4.0)
        return np.asarray(self._sum[k] + u * h * (self._read[k] + u * bent))


def _slopes(rows: FloatArray, begin: int, count: int) -> FloatArray:
    """Derivatives of the readings at `count` rows from `begin` on, shape (count, 6).

    By central differences over one and two readings on either side, extrapolated (Richardson): their error is
    h^4 w^4 / 30 instead of h^2 w^2 / 6. Next to a hole (four times the usual step and more) the difference
    over the hole says nothing about the slope: the chord of the other side is taken, or none.
    """
    t, values = rows[:, 0], rows[:, 1:]
    dt = t[1:] - t[:-1]
    usual = np.sort(dt)[(len(dt) - 1) // 4]  # of two stamps that nearly coincide, the step says nothing
    chord = (values[1:] - values[:-1]) / dt[:, None]
    whole = (dt <= GAP_PERIODS * usual).astype(np.float64)
    sides = np.zeros((len(rows), 1))
    sides[:-1, 0] = whole
    sides[1:, 0] += whole
    out = np.empty_like(values)
    chord *= whole[:, None]
    out[:-1], out[-1] = chord, 0.0
    out[1:] += chord
    out /= np.maximum(sides, 1.0)
    if len(rows) > 4:
        even = (whole[:-3] * whole[1:-2] * whole[2:-1] * whole[3:])[:, None]
        out[2:-2] += even * (out[2:-2] - (values[4:] - values[:-4]) / (t[4:] - t[:-4])[:, None]) / 3.0
    return out[begin : begin + count]


def _at_instants(rows: FloatArray, spread_s2: float) -> FloatArray:
    """Rows with what was measured at their instants, from means around these, but for the first and last.

    The mean of a curve is off by its second derivative times half the variance of the instants.
    """
    step = np.diff(rows, axis=0)
    out = rows.copy()
    bend = np.diff(step[:, 1:] / step[:, :1], axis=0) / (step[1:, :1] + step[:-1, :1])  # half of it
    apart = np.minimum(step[1:, 0], step[:-1, 0]) > math.sqrt(spread_s2)  # else their noise is no bend
    out[1:-1, 1:] -= spread_s2 * bend * apart[:, None]
    return out


def _hermite(
    rows: FloatArray, slope: FloatArray, t_s: FloatArray, k: npt.NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Value and derivative of the cubic through rows k and k + 1 at instants `t_s`, shapes (m, 6)."""
    before, after = rows[k], rows[k + 1]
    h = after[:, :1] - before[:, :1]
    u = (t_s[:, None] - before[:, :1]) / h
    a, b = before[:, 1:], after[:, 1:]
    A, B = slope[k] * h, slope[k + 1] * h
    d = b - a
    third = A + B - 2.0 * d
    second = d - A - third
    return a + u * (A + u * (second + u * third)), (A + u * (2.0 * second + (3.0 * u) * third)) / h
