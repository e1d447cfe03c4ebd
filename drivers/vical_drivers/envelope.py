"""The lower envelope of one-way arrivals: offset and skew of two clocks. Pure arithmetic.

An arrival is late by a delay that is never negative, so the truth lies along the *lower* envelope of
(device time, arrival - device time): a straight line with the offset and the skew of the two clocks,
touched from above by the luckiest samples (Zhang, Liu, Xia, INFOCOM 2002). Averages (exponential,
alpha-beta) carry the mean delay as a bias; the envelope does not. No one-way method can see the
*smallest* delay itself: the caller subtracts the known part of it (wire time, the sensor's filters).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from itertools import islice

_DELAY_MEMORY = 1000
"""So many samples weigh in the mean delay."""
_PARTS = 8
"""Of the memory, each 2.5 s (12 blocks) or longer; of two neighbours the luckiest should touch the line."""


@dataclass(frozen=True, slots=True)
class EnvelopeOptions:
    """Tuning of `LowerEnvelope`; the defaults suit crystals of +-100 ppm on either side.

    Attributes:
        max_skew: Bound of the relative rate error of the two clocks (1e-6 is 1 ppm).
        skew_prior: One-sigma of that error before anything is known.
        skew_wander_per_s: How fast the skew itself drifts, 1/s (4e-8: 2.4 ppm a minute); with the jitter it
            sets the window: long enough for lucky samples, short enough for a straight line.
        min_window_s: Shortest memory.
        max_window_s: Longest memory.
        block_s: Only the luckiest sample of each block of this length is kept.
    """

    max_skew: float = 2000e-6
    skew_prior: float = 100e-6
    skew_wander_per_s: float = 4e-8
    min_window_s: float = 20.0
    max_window_s: float = 120.0
    block_s: float = 0.2


class LowerEnvelope:
    """Lower envelope of (x, d): device seconds x, and d = arrival - x in seconds.

    Keeps the luckiest point per block, forgets blocks older than a window chosen from the jitter, and
    supports the convex hull of the rest by a line. Cost: O(window / block) when a block ends or a point
    falls below the line, O(1) otherwise.

    Attributes:
        offset_s: Of the line `offset_s + skew * x`, host minus device at x = 0, s.
        skew: Relative rate error: host seconds per device second, minus one.
        sigma_s: One-sigma uncertainty of the line at the newest point, s.
    """

    def __init__(self, options: EnvelopeOptions | None = None) -> None:
        self.options = options or EnvelopeOptions()
        self._block_s = self.options.block_s
        self._blocks: deque[tuple[float, float]] = deque()
        self._block_delays_s: deque[float] = deque()  # the mean of each block
        self._best: tuple[float, float] | None = None
        self._best_delay_s = math.inf
        self._block_end_s = 0.0
        self._newest_s = 0.0
        self.offset_s = 0.0
        self.skew = 0.0
        self._delay_mean_s = 0.0
        self._delay_square_s2 = 0.0
        self._points = 0
        self._block_points, self._block_sum_s = 0, 0.0
        self._new, self._new_sum_s, self._new_sum_s2 = 0, 0.0, 0.0  # not yet in the mean
        self.sigma_s = math.inf
        self._skew_sigma = self.options.skew_prior

    @property
    def jitter_s(self) -> float:
        """Standard deviation of the arrival delay, s (recent samples weigh most)."""
        return math.sqrt(max(0.0, self._delay_square_s2 - self._delay_mean_s**2))

    @property
    def window_s(self) -> float:
        """Present length of the memory, s: the cube root balances jitter/W against wander * W^2."""
        o = self.options
        window = (
            1.5 * (self._delay_mean_s / o.skew_wander_per_s) ** (1 / 3) if self._delay_mean_s > 0 else 0.0
        )
        return min(max(window, o.min_window_s), o.max_window_s)

    @property
    def _typical_delay_s(self) -> float:
        """Median of the mean delays of the newest half of the blocks, s.

        A stall shorter than a quarter of the memory does not count. Jitter that begins counts from then on:
        before the slope rests on it, which is that at the middle of the memory.
        """
        delays_s = sorted(islice(reversed(self._block_delays_s), (len(self._block_delays_s) + 1) // 2))
        if not delays_s:
            return max(self._block_sum_s, 0.0) / max(1, self._block_points)
        return max(delays_s[len(delays_s) // 2], 0.0)

    def line(self, x_s: float) -> float:
        """Offset (host - device) at device time `x_s`, s."""
        return self.offset_s + self.skew * x_s

    def add(self, x_s: float, d_s: float) -> None:
        """Take one arrival; `x_s` must not decrease."""
        # 1000 times a second on a small computer: what most samples do not need is elsewhere.
        delay_s = d_s - (self.offset_s + self.skew * x_s)
        if delay_s < self._best_delay_s or x_s >= self._block_end_s:
            delay_s = self._note_luckiest(x_s, d_s, delay_s)
        self._new += 1
        self._new_sum_s += delay_s
        self._new_sum_s2 += delay_s * delay_s

    def _note_luckiest(self, x_s: float, d_s: float, delay_s: float) -> float:
        """Take the luckiest of its block so far, or its last; return its delay by the line as it is then."""
        if self._best is None:
            self._best, self._block_end_s = (x_s, d_s), x_s + self._block_s
        elif delay_s < self._best_delay_s:
            self._best = (x_s, d_s)
        ends = x_s >= self._block_end_s
        if ends or delay_s < 0.0 or not self._points:
            self._newest_s = x_s
            self._update_mean()
            if ends:
                self._close_block()
            self._fit()
            delay_s = d_s - self.line(x_s)
        best = self._best
        self._best_delay_s = math.inf if best is None else best[1] - self.line(best[0])
        return delay_s

    def _update_mean(self) -> None:
        """Let the samples since the last time into the mean delay: equal weights at first, then a memory."""
        count = self._new
        self._points += count
        if count:
            gain = count / max(count, min(self._points, _DELAY_MEMORY))
            self._delay_mean_s += gain * (self._new_sum_s / count - self._delay_mean_s)
            self._delay_square_s2 += gain * (self._new_sum_s2 / count - self._delay_square_s2)
            self._block_points += count
            self._block_sum_s += self._new_sum_s
            self._new, self._new_sum_s, self._new_sum_s2 = 0, 0.0, 0.0

    def _close_block(self) -> None:
        assert self._best is not None
        self._blocks.append(self._best)
        self._block_delays_s.append(self._block_sum_s / max(1, self._block_points))
        self._best, self._block_points, self._block_sum_s = None, 0, 0.0
        oldest = self._newest_s - self.window_s
        while len(self._blocks) > 2 and self._blocks[0][0] < oldest:
            self._blocks.popleft()
            self._block_delays_s.popleft()

    def _fit(self) -> None:
        points = list(self._blocks)
        if self._best is not None:
            points.append(self._best)
        hull = _possible(_lower_hull(points), self.options.max_skew)
        memory_s = min(self.window_s, hull[-1][0] - hull[0][0])
        slope = _slope_at(hull, hull[-1][0] - memory_s / 2.0, memory_s / 4.0)
        points = points[bisect_left(points, hull[0]) :]  # those before are late: they say nothing of jitter
        spread_s = self._spread_s(points)
        # A short memory of jittery points says little about the skew: weigh it against the prior.
        weight, bound = self._weight(spread_s, memory_s), self.options.max_skew
        self.skew = min(max(slope * weight, -bound), bound)
        self.offset_s = min(d - self.skew * x for x, d in hull)
        spread_s = max(spread_s, self._least_delay_changes_s(points))
        self._skew_sigma = self.options.skew_prior * math.sqrt(1.0 - self._weight(spread_s, memory_s))
        self.sigma_s = self._uncertainty_s(points, spread_s, points[-1][0] - hull[-1][0])

    def _weight(self, spread_s: float, memory_s: float) -> float:
        """Share of the slope of points with this spread in a mean with the prior, which is zero."""
        if memory_s <= 0:
            return 0.0
        return 1.0 / (1.0 + (2.0 * spread_s / memory_s / self.options.skew_prior) ** 2)

    def _spread_s(self, points: list[tuple[float, float]]) -> float:
        """How far block minima typically lie above the luckiest ones, s (upper decile of the lowest)."""
        residuals = sorted(d - self.line(x) for x, d in points)
        # A few points may agree by chance: their number bounds what can be believed.
        believable_s = self._typical_delay_s / math.sqrt(max(1, self._points))
        return max(residuals[len(residuals) // 10] - residuals[0], believable_s, 1e-6)

    def _least_delay_changes_s(self, points: list[tuple[float, float]]) -> float:
        """How far the luckiest of a quarter of the memory lies above that of another, s.

        The least delay changes with the load of the computer, and tilts the line: that is part of its sigma.
        The line itself stays as it is, since a slope that is not known yet looks the same.
        """
        if len(points) < 2 * _PARTS:
            return 0.0
        begin_s, part_s = points[0][0], (points[-1][0] - points[0][0]) / _PARTS
        luckiest = [math.inf] * _PARTS
        for x, d in points:
            part = min(int((x - begin_s) / part_s), _PARTS - 1)
            luckiest[part] = min(luckiest[part], d - self.line(x))
        quarters = [pair for pair in map(min, luckiest, luckiest[1:]) if pair < math.inf]
        return max(quarters) - min(luckiest)

    def _uncertainty_s(self, points: list[tuple[float, float]], spread_s: float, since_s: float) -> float:
        memory_s = max(points[-1][0] - points[0][0] - since_s, self.options.block_s)
        lead_s = memory_s / 3.0 + since_s
        if len(points) < 5:
            spread_s = max(spread_s, self._typical_delay_s)
        wander_s = 0.5 * self.options.skew_wander_per_s * lead_s**2
        return math.hypot(spread_s, self._skew_sigma * lead_s, wander_s)


def _lower_hull(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Lower convex hull of points ordered by x (monotone chain)."""
    hull: list[tuple[float, float]] = []
    for x, d in points:
        while len(hull) > 1:
            (x1, d1), (x2, d2) = hull[-2], hull[-1]
            if (d2 - d1) * (x - x1) < (d - d1) * (x2 - x1):
                break
            hull.pop()
        if hull and x <= hull[-1][0]:
            if d < hull[-1][1]:
                hull[-1] = (x, d)
            continue
        hull.append((x, d))
    return hull


def _possible(hull: list[tuple[float, float]], max_skew: float) -> list[tuple[float, float]]:
    """Leave out the ends of a hull that no two clocks can have: those points are late.

    At the start all arrivals may be late by much, as on a computer that is just loading programs. The slope
    down to the first arrival in time is then no skew of the clocks.
    """
    first, last = 0, len(hull) - 1
    while first < last and _slope(hull[first], hull[first + 1]) < -max_skew:
        first += 1
    while first < last and _slope(hull[last - 1], hull[last]) > max_skew:
        last -= 1
    return hull[first : last + 1]


def _slope_at(hull: list[tuple[float, float]], x_s: float, span_s: float) -> float:
    """Slope of the hull over `x_s`, from a chord of at least `span_s` where there is one.

    The hull's edge there may join two lucky neighbours, whose slope is mostly the tick's rounding; it is
    widened to whichever side bends less.
    """
    if len(hull) < 2:
        return 0.0
    right = 1
    while right < len(hull) - 1 and hull[right][0] < x_s:
        right += 1
    left = right - 1
    while hull[right][0] - hull[left][0] < span_s and (left > 0 or right < len(hull) - 1):
        slope = _slope(hull[left], hull[right])
        bend_left = abs(_slope(hull[left - 1], hull[left]) - slope) if left > 0 else math.inf
        bend_right = abs(_slope(hull[right], hull[right + 1]) - slope) if right < len(hull) - 1 else math.inf
        left, right = (left - 1, right) if bend_left < bend_right else (left, right + 1)
    return _slope(hull[left], hull[right])


def _slope(a: tuple[float, float], b: tuple[float, float]) -> float:
    return (b[1] - a[1]) / (b[0] - a[0])
