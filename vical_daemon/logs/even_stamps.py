"""Stamps of an IMU that samples evenly, recovered from stamps that were taken on arrival.

Many drivers stamp a reading when its bytes arrive: late by whatever the bus, the scheduler and the buffers
added, or four readings at once. The device itself samples evenly, so the *number* of a reading says when it
was taken, up to offset and rate. A delay is never negative: both follow the lower envelope of the stamps,
as in `vical_drivers.envelope`, here with all of the recording at hand. Stamps may also be early and late
alike (a noisy clock, interpolated stamps): then there is no lower envelope, and both follow their mean.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray

_BLOCK_S = 1.0
"""Of each block the earliest arrival counts, s: 100 to 1000 readings, among which some are hardly delayed."""
_WINDOW_S = 15.0
"""Half width of the local line through the earliest arrivals, s. A crystal's rate wanders by 2.4 ppm a minute
(`vical_drivers.envelope`): within the window that bends a line by 4e-8 / 2 * 15**2 = 5 us."""
_EVEN_S = 5e-5
"""Stamps that deviate less from an even grid come from a device's clock and stay as they are, s; as in
`estimation.inertial.stamp_steps`."""
_LEAST_BLOCKS = 5
"""Pieces without losses must hold so many blocks on average: fewer do not show whether the device is even."""
_FLOOR, _NO_FLOOR = 0.16, 0.53
"""Scatter of the earliest arrivals of blocks over that of all, by 20 in a block: of delays 0.05 (exponential)
to 0.16 (even); of normal errors 0.53, and with 200 in a block 0.43."""
_TINY_S = 1e-9
_DECIMAL_NS = (10**4, 10**5, 10**6, 10**7)
"""Steps in which programs write stamps, ns: 10 us to 10 ms. Finer ones do not matter."""
CERTAIN = 3.0
"""Standard errors by which the motion must be smoother over the even stamps: one chance in 740."""


class EvenStamps(NamedTuple):
    """What `even_stamps` found.

    Attributes:
        t_ns: New stamps, ns, shape (n,), strictly increasing.
        jitter_s: Standard deviation of what was taken off, s.
        largest_s: Most that was taken off beyond the median, s.
        sigma_s: How well the lower envelope is known, s: the scatter of the earliest arrivals about it. What
            every reading is delayed by at least cannot be seen from the stamps.
        pieces: Parts between losses, each with an envelope of its own.
        log_odds: Logarithm of the odds that stamps are late, and not late and early alike.
    """

    t_ns: IntArray
    jitter_s: float
    largest_s: float
    sigma_s: float
    pieces: int
    log_odds: float

    @property
    def delays(self) -> bool:
        """Stamps are late; else they are late and early alike, and on the grid in the mean."""
        return self.log_odds >= 0.0

    def describe(self, name: str, what: str = "readings") -> str:
        """Return one line for the user about the sensor of this name."""
        return (
            f"{name}: its stamps jitter by {self.jitter_s * 1e3:.3g} ms but it samples evenly: {what} were "
            f"put on an even grid along the {'earliest arrivals' if self.delays else 'mean of the stamps'} "
            f"(moved by up to {self.largest_s * 1e3:.3g} ms)"
        )


def even_stamps(t_ns: IntArray, gyro_rps: FloatArray) -> EvenStamps | None:
    """Put readings on the even grid of their device.

    Args:
        t_ns: Stamps in the order in which the readings were recorded, ns, shape (n,).
        gyro_rps: Rates, rad/s, shape (n, 3): they tell on which time axis the motion is smoother.

    Returns:
        None where the stamps are fine as they are: even already, rounded to a small decimal unit, or of
        readings that were really taken unevenly.
    """
    if len(t_ns) < 3:
        return None
    t_s = (t_ns - t_ns[0]) * 1e-9
    sort = np.argsort(t_s, kind="stable")
    period_s = _period_s(t_s[sort])
    if not period_s > 0.0:
        return None
    block = max(round(_BLOCK_S / period_s), 2)
    starts = _pieces(t_s, period_s, block)
    if starts is None:
        return None
    bounds = [*starts, len(t_s)]
    grid_s = np.concatenate([period_s * np.arange(end - begin) for begin, end in pairwise(bounds)])
    late = lateness(grid_s, t_s - grid_s, bounds, block)
    written_s = 1e-9 * _written_in_ns(t_ns)
    if written_s and np.ptp(t_s - grid_s - late.late_s) < 1.05 * written_s:  # rounded up or down, not late
        late = lateness(grid_s, t_s - grid_s, bounds, block, log_odds=-math.inf)
        late = late._replace(sigma_s=math.hypot(late.sigma_s, written_s / math.sqrt(12.0)))
    even_s = grid_s + late.late_s
    taken_s = t_s - even_s
    jitter_s = float(taken_s.std())
    new_ns = t_ns[0] + np.round(even_s * 1e9).astype(np.int64)
    known = not written_s and rounded(t_ns, taken_s, period_s)
    if jitter_s < _EVEN_S or known or (np.diff(new_ns) <= 0).any():
        return None
    gain = _surprise(gyro_rps[sort], t_s[sort]) - _surprise(gyro_rps, even_s)
    if not gain.mean() > CERTAIN * gain.std() / np.sqrt(len(gain)):
        return None
    largest_s = float(taken_s.max() - np.median(taken_s))
    return EvenStamps(new_ns, jitter_s, largest_s, late.sigma_s, len(starts), late.log_odds)


def _period_s(t_s: FloatArray) -> float:
    """Interval between readings, s: the median over blocks, most of which lost nothing."""
    guess_s = float(t_s[-1] - t_s[0]) / (len(t_s) - 1)
    span = min(max(round(_BLOCK_S / guess_s), 1), len(t_s) - 1) if guess_s > 0.0 else len(t_s) - 1
    return float(np.median(t_s[span:] - t_s[:-span])) / span


def _pieces(t_s: FloatArray, period_s: float, block: int) -> list[int] | None:
    """First reading of each piece in which none is missing; None where the device cannot be even.

    A loss moves all later arrivals up by whole periods against the count, a doubled reading down.
    """
    starts, checked = [0], 0
    while checked < len(starts):
        if len(starts) * _LEAST_BLOCKS * block > len(t_s):
            return None
        begin, end = starts[checked], [*starts, len(t_s)][checked + 1]
        cut = _loss(t_s[begin:end], period_s, block) if end - begin >= 2 * block else None
        if cut is None:
            checked += 1
        else:
            starts.insert(checked + 1, begin + cut)
    return starts


def _loss(t_s: FloatArray, period_s: float, block: int) -> int | None:
    """First reading behind the largest step of the earliest arrivals; None if all are below half a period.

    No reading comes before its time: the last one that would be too early on the later grid precedes a loss,
    the first one that would be too early on the earlier grid follows a doubled reading.
    """
    late_s = t_s - period_s * np.arange(len(t_s))
    earliest = _earliest(late_s, block)
    steps = np.diff(late_s[earliest])
    at = int(np.abs(steps).argmax())
    if abs(steps[at]) < 0.5 * period_s:
        return None
    low, high = int(earliest[at]), int(earliest[at + 1])
    between = late_s[low : high + 1]
    bound_s = max(between[0], between[-1]) - 0.25 * abs(steps[at])
    too_early = np.flatnonzero(between < bound_s)
    return low + int(too_early[-1] + 1 if steps[at] > 0.0 else too_early[0])


def _earliest(late_s: FloatArray, block: int) -> IntArray:
    """Index of the earliest arrival of each block; a rest at the end belongs to the last one."""
    count = max(len(late_s) // block, 1)
    bounds = [*range(0, count * block, block), len(late_s)]
    return np.array([a + int(late_s[a:b].argmin()) for a, b in pairwise(bounds)])


class Lateness(NamedTuple):
    """Where the samples of a sensor are against its even grid.

    Attributes:
        late_s: By how much the grid is to be moved at each sample, s, shape (n,).
        sigma_s: How well that is known, s.
        log_odds: See `EvenStamps`.
    """

    late_s: FloatArray
    sigma_s: float
    log_odds: float


def lateness(
    grid_s: FloatArray, late_s: FloatArray, bounds: list[int], block: int, log_odds: float | None = None
) -> Lateness:
    """Lower envelopes of arrivals, one for each piece; or their means, where arrivals have no lower limit.

    Args:
        grid_s: Even time axis, s, shape (n,).
        late_s: How much later than on the grid each sample arrived, s, shape (n,).
        bounds: First sample of each piece, and n.
        block: Of so many samples the earliest one counts.
        log_odds: See `EvenStamps`, where known; None: by these samples, all pieces together.
    """
    pieces = [slice(a, b) for a, b in pairwise(bounds)]
    lower = [_envelope(grid_s[piece], late_s[piece], block) for piece in pieces]
    means = [_mean(grid_s[piece], late_s[piece], block) for piece in pieces]
    odds = _log_odds(late_s, lower, pieces) if log_odds is None else log_odds
    lines = lower if odds >= 0.0 else means
    apart_s = float(
        np.median(np.concatenate([a.late_s - b.late_s for a, b in zip(means, lower, strict=True)]))
    )
    unsure = math.exp(-0.5 * abs(odds)) / (1.0 + math.exp(-abs(odds)))  # root of p (1 - p)
    steps_s = np.concatenate([x.steps_s for x in lines])
    scatter_s = float(np.sqrt((steps_s**2).mean() / 2.0)) if len(steps_s) else 0.0
    return Lateness(np.concatenate([x.late_s for x in lines]), math.hypot(scatter_s, apart_s * unsure), odds)


class _Line(NamedTuple):
    """Lateness of one piece at each sample, s; steps from each of its blocks to the next, s."""

    late_s: FloatArray
    steps_s: FloatArray


def _envelope(grid_s: FloatArray, late_s: FloatArray, block: int) -> _Line:
    """Lower envelope of arrivals."""
    earliest = _earliest(late_s, block)
    return _Line(_line(grid_s, grid_s[earliest], late_s[earliest]), np.diff(late_s[earliest]))


def _mean(grid_s: FloatArray, late_s: FloatArray, block: int) -> _Line:
    """Line through the means of blocks."""
    parts = np.array_split(np.arange(len(late_s)), max(len(late_s) // block, 1))
    x, y = (np.array([values[part].mean() for part in parts]) for values in (grid_s, late_s))
    return _Line(_line(grid_s, x, y), np.diff(y))


def _log_odds(late_s: FloatArray, lower: list[_Line], pieces: list[slice]) -> float:
    """Odds that there is a lower envelope, by the steps of the earliest arrivals from block to block."""
    odds = 0.0
    for piece, line in zip(pieces, lower, strict=True):
        variance = float(np.var(late_s[piece] - line.late_s))
        square = float(line.steps_s @ line.steps_s) / max(2.0 * variance, _TINY_S**2)
        odds += len(line.steps_s) * math.log(_NO_FLOOR / _FLOOR)
        odds -= 0.5 * square * (_FLOOR**-2 - _NO_FLOOR**-2)
    return odds


def _line(grid_s: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """A smooth line through points, at each sample, shape (n,)."""
    if len(x) < 2:
        return np.full(len(grid_s), y[0])
    line = np.array([_local_line(x, y, float(at)) for at in x])
    fitted: FloatArray = np.interp(grid_s, x, line)
    for end, inner in ((0, 1), (-1, -2)):  # beyond the first and the last one: straight on
        outside = grid_s < x[0] if end == 0 else grid_s > x[-1]
        slope = (line[inner] - line[end]) / (x[inner] - x[end])
        fitted[outside] = line[end] + slope * (grid_s[outside] - x[end])
    return fitted


def _local_line(x: FloatArray, y: FloatArray, at: float) -> float:
    """Value at one place of the line through the points around it (tricube weights: Cleveland 1979)."""
    reach_s = max(_WINDOW_S, float(np.sort(np.abs(x - at))[min(3, len(x) - 1)]) * 1.01)
    weight = np.clip(1.0 - np.abs((x - at) / reach_s) ** 3, 0.0, None) ** 3
    centre = weight @ x / weight.sum()
    spread = weight @ (x - centre) ** 2
    slope = weight @ ((x - centre) * y) / spread if spread > 0.0 else 0.0
    return float(weight @ y / weight.sum() + slope * (at - centre))


def rounded(t_ns: IntArray, taken_s: FloatArray, period_s: float) -> bool:
    """Whether the deviations are those of stamps written in whole 10 us to 10 ms: rounding, not delays."""
    spread_ns = float(np.ptp(taken_s)) * 1e9
    return any(
        spread_ns < 1.05 * unit <= 1.05e9 * period_s and not ((t_ns - t_ns[0]) % unit).any()
        for unit in _DECIMAL_NS
    )


def _written_in_ns(t_ns: IntArray) -> int:
    """The shortest interval, ns, if it is a power of ten and intervals are 0, once and several times that.

    Else 0. Stamps of a device are so if they were rounded to about its interval, or if it loses readings.
    """
    ordered_ns = np.sort(t_ns)
    intervals_ns: IntArray = ordered_ns[1:] - ordered_ns[:-1]
    shortest_ns = int(intervals_ns[intervals_ns > 0].min(initial=np.iinfo(np.int64).max))
    alike = (intervals_ns == shortest_ns).all() or (intervals_ns % shortest_ns).any()
    return shortest_ns if not alike and shortest_ns in _DECIMAL_NS else 0


def _surprise(values: FloatArray, t_s: FloatArray) -> FloatArray:
    """Squared error of a line from both neighbours to each inner reading, shape (n - 2,).

    It is divided by what white noise alone would give, so a rig at rest prefers no time axis.
    """
    before_s, span_s = t_s[1:-1] - t_s[:-2], t_s[2:] - t_s[:-2]
    share = np.divide(before_s, span_s, out=np.full(len(span_s), 0.5), where=span_s > 0.0)[:, None]
    error = values[1:-1] - (1.0 - share) * values[:-2] - share * values[2:]
    squares: FloatArray = ((error**2) / (1.0 + share**2 + (1.0 - share) ** 2)).sum(axis=1)
    return squares
