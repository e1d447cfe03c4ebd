"""Device clock to host clock, from one-way arrival times alone. Pure arithmetic: no clock is read here.

Three clocks meet, each with its own names: the device's ticks (``device_ticks``, wrapping on the wire,
unwrapped inside), device seconds since the mapping began (``x_s``), and CLOCK_MONOTONIC of the host
(``t_..._ns``).

An arrival is late by a delay that is never negative, so the truth lies along the *lower* envelope of
(device time, arrival - device time): a straight line with the offset and the skew of the two clocks,
touched from above by the luckiest samples (Zhang, Liu, Xia, INFOCOM 2002). Averages (exponential,
alpha-beta) carry the mean delay as a bias; the envelope does not. What no one-way method can see is the
*smallest* delay itself: the caller takes off what it knows of it (wire time, the sensor's filters).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

_NS = 1e9


class TickUnwrapper:
    """Turns a counter of `bits` bits into one that never wraps (None: it does not wrap)."""

    def __init__(self, bits: int | None = 32) -> None:
        self._modulus = None if bits is None else 1 << bits
        self._last: int | None = None

    def step(self, ticks: int) -> int:
        """Ticks from the last accepted value to this one, taken forward: 0 <= step < 2^bits."""
        if self._last is None:
            return 0
        step = ticks - self._last
        return step if self._modulus is None else step % self._modulus

    def accept(self, ticks: int) -> int:
        """Make this the newest value and return it unwrapped (starts at the first raw value)."""
        self._last = ticks if self._last is None else self._last + self.step(ticks)
        return self._last

    def restart(self) -> None:
        """Forget the past; the next value is taken as it is."""
        self._last = None


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
    """

    def __init__(self, options: EnvelopeOptions | None = None) -> None:
        self.options = options or EnvelopeOptions()
        self._blocks: deque[tuple[float, float]] = deque()
        self._best: tuple[float, float] | None = None
        self._block_start_s = 0.0
        self._newest_s = 0.0
        self._offset_s = 0.0
        self._skew = 0.0
        self._delay_mean_s = 0.0
        self._delay_square_s2 = 0.0
        self._points = 0
        self._sigma_s = math.inf
        self._skew_sigma = self.options.skew_prior

    @property
    def skew(self) -> float:
        """Relative rate error: host seconds per device second, minus one."""
        return self._skew

    @property
    def jitter_s(self) -> float:
        """Standard deviation of the arrival delay, s (recent samples weigh most)."""
        return math.sqrt(max(0.0, self._delay_square_s2 - self._delay_mean_s**2))

    @property
    def sigma_s(self) -> float:
        """One-sigma uncertainty of the line at the newest point, s."""
        return self._sigma_s

    @property
    def window_s(self) -> float:
        """Present length of the memory, s: the cube root balances jitter/W against wander * W^2."""
        o = self.options
        window = (
            1.5 * (self._delay_mean_s / o.skew_wander_per_s) ** (1 / 3) if self._delay_mean_s > 0 else 0.0
        )
        return min(max(window, o.min_window_s), o.max_window_s)

    def line(self, x_s: float) -> float:
        """Offset (host - device) at device time `x_s`, s."""
        return self._offset_s + self._skew * x_s

    def add(self, x_s: float, d_s: float) -> None:
        """Take one arrival; `x_s` must not decrease."""
        self._newest_s = x_s
        self._points += 1
        if self._best is None:
            self._best, self._block_start_s = (x_s, d_s), x_s
        elif d_s - self._skew * x_s < self._best[1] - self._skew * self._best[0]:
            self._best = (x_s, d_s)
        below = self._points < 2 or d_s < self.line(x_s)
        if x_s - self._block_start_s >= self.options.block_s:
            self._close_block()
            below = True
        if below:
            self._fit()
        self._note_delay(d_s - self.line(x_s))

    def _close_block(self) -> None:
        assert self._best is not None
        self._blocks.append(self._best)
        self._best = None
        oldest = self._newest_s - self.window_s
        while len(self._blocks) > 2 and self._blocks[0][0] < oldest:
            self._blocks.popleft()

    def _note_delay(self, delay_s: float) -> None:
        gain = max(1.0 / self._points, 1e-3)
        self._delay_mean_s += gain * (delay_s - self._delay_mean_s)
        self._delay_square_s2 += gain * (delay_s * delay_s - self._delay_square_s2)

    def _fit(self) -> None:
        points = list(self._blocks)
        if self._best is not None:
            points.append(self._best)
        hull = _lower_hull(points)
        memory_s = min(self.window_s, points[-1][0] - points[0][0])
        slope = _slope_at(hull, self._newest_s - memory_s / 2.0, memory_s / 4.0)
        spread_s = self._spread_s(points)
        # A short memory of jittery points says little about the skew: weigh it against the prior.
        skew_sigma = 2.0 * spread_s / memory_s if memory_s > 0 else math.inf
        prior = self.options.skew_prior
        weight = 1.0 / (1.0 + (skew_sigma / prior) ** 2)
        bound = self.options.max_skew
        self._skew = min(max(slope * weight, -bound), bound)
        self._offset_s = min(d - self._skew * x for x, d in hull)
        self._skew_sigma = prior * math.sqrt(1.0 - weight)
        self._sigma_s = self._uncertainty_s(points, spread_s)

    def _spread_s(self, points: list[tuple[float, float]]) -> float:
        """How far block minima typically lie above the luckiest ones, s (upper decile of the lowest)."""
        residuals = sorted(d - self.line(x) for x, d in points)
        # A few points may agree by chance: their number bounds what can be believed.
        believable_s = self._delay_mean_s / math.sqrt(self._points)
        return max(residuals[len(residuals) // 10] - residuals[0], believable_s, 1e-6)

    def _uncertainty_s(self, points: list[tuple[float, float]], spread_s: float) -> float:
        memory_s = max(points[-1][0] - points[0][0], self.options.block_s)
        lead_s = memory_s / 3.0
        if len(points) < 5:
            spread_s = max(spread_s, self._delay_mean_s)
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


class DeviceTime(NamedTuple):
    """When one sample was taken, on the device's clock.

    Attributes:
        ticks: Unwrapped ticks, as the device said.
        fine: The same with the fraction of a tick that its rounding took away, as far as it is known.
    """

    ticks: int
    fine: float


class Stamp(NamedTuple):
    """What the clock says of one sample.

    Attributes:
        t_device_event_ns: When the device's timer was read, on CLOCK_MONOTONIC, ns.
        t_sigma_ns: One-sigma of it, ns.
        device_ticks: Unwrapped ticks.
        lost_before: Samples missing just before.
    """

    t_device_event_ns: int
    t_sigma_ns: int
    device_ticks: int
    lost_before: int


class DeviceClock:
    """Maps ticks to the host: unwraps, notices restarts, counts lost samples, fits the envelope.

    Attributes:
        restarts: How often the device's timer began anew.
        outliers: Samples dropped because their time cannot be true.
        repeats: Samples dropped because their time is that of the one before.
        lost: Samples missing between those that came.

    Args:
        tick_hz: Ticks per device second.
        tick_bits: Width of the counter on the wire; None where it does not wrap.
        rate_hz: Nominal sample rate, for counting losses; 0 to not count.
        options: Tuning of the envelope.
    """

    def __init__(
        self, tick_hz: float, *, tick_bits: int | None = 32, rate_hz: float = 0.0,
        options: EnvelopeOptions | None = None,
    ) -> None:  # fmt: skip
        self.tick_hz = tick_hz
        self.rate_hz = rate_hz
        self.restarts = 0
        self.outliers = 0
        self.repeats = 0
        self.lost = 0
        self._tick_sigma_s = 0.5 / tick_hz
        self._period = tick_hz / rate_hz if rate_hz > 0.0 else 0.0
        self._options = options
        self._unwrap = TickUnwrapper(tick_bits)
        self._suspect: tuple[int, int] | None = None
        self._begin()

    def _begin(self) -> None:
        self._unwrap.restart()
        self.envelope = LowerEnvelope(self._options)
        self._first_ticks: int | None = None
        self._last_ticks = 0
        self._fine = 0.0
        self._t0_ns = 0
        self._last_t_ns: int | None = None
        self._stamped_ticks = 0

    @property
    def age_s(self) -> float:
        """Device seconds since the mapping began; below about 1 s it is not worth much."""
        return 0.0 if self._first_ticks is None else (self._last_ticks - self._first_ticks) / self.tick_hz

    def add(self, ticks: int, t_arrival_ns: int) -> DeviceTime | None:
        """Take one sample; return its device time, None where the value cannot be true or was seen.

        A value from the future is either damage or a restarted (or newly set) device timer. One such
        value is dropped; a second one that fits the first is a restart, and the mapping begins anew.
        """
        step = self._unwrap.step(ticks)
        if self._first_ticks is not None and not self._possible(step, t_arrival_ns):
            if not self._continues_suspect(ticks, t_arrival_ns):
                self._suspect = (ticks, t_arrival_ns)
                self.outliers += 1
                return None
            self.restarts += 1
            self.outliers -= 1
            self._begin()
        self._suspect = None
        if self._first_ticks is not None and step == 0:
            self.repeats += 1
            return None
        unwrapped = self._unwrap.accept(ticks)
        if self._first_ticks is None:
            self._first_ticks, self._t0_ns = unwrapped, t_arrival_ns
            self._fine, self._last_ticks = float(unwrapped), unwrapped
        self._fine = self._refined(unwrapped)
        x_s = (self._fine - self._first_ticks) / self.tick_hz
        self.envelope.add(x_s, (t_arrival_ns - self._t0_ns) / _NS - x_s)
        self._last_ticks = unwrapped
        return DeviceTime(unwrapped, self._fine)

    def _refined(self, unwrapped: int) -> float:
        """Ticks with the fraction that rounding took away.

        Samples come every 62.5 ticks at 1000 Hz, so the counter alternates between steps of 62 and 63. The
        instants themselves are evenly spaced by the same crystal: go on by whole periods, within the tick.
        """
        if self._period <= 0.0:
            return float(unwrapped)
        periods = round((unwrapped - self._last_ticks) / self._period)
        fine = self._fine + periods * self._period
        return float(unwrapped) if fine < unwrapped else min(fine, unwrapped + 1.0)

    def _possible(self, step: int, t_arrival_ns: int) -> bool:
        """Tell whether an arrival may be that of a sample `step` ticks after the last one."""
        assert self._first_ticks is not None
        if step < 0:
            return False
        x_s = (self._last_ticks + step - self._first_ticks) / self.tick_hz
        earliness_s = x_s + self.envelope.line(x_s) - (t_arrival_ns - self._t0_ns) / _NS
        # Before the envelope has settled an arrival may lie well below the first guess.
        allowed_s = 0.02 + 1e-3 * step / self.tick_hz + (1.0 if x_s < 5.0 else 0.0)
        return earliness_s < allowed_s

    def _continues_suspect(self, ticks: int, t_arrival_ns: int) -> bool:
        if self._suspect is None:
            return False
        step_s = (ticks - self._suspect[0]) / self.tick_hz
        host_s = (t_arrival_ns - self._suspect[1]) / _NS
        return 0.0 < step_s < host_s + 1.0

    def stamp(self, device: DeviceTime) -> Stamp:
        """Map a device time that `add` returned; call it once per sample and in order.

        Stamps never go back: where the envelope just moved, the step is spread over some samples.
        """
        assert self._first_ticks is not None
        x_s = (device.fine - self._first_ticks) / self.tick_hz
        t_ns = self._t0_ns + round((x_s + self.envelope.line(x_s)) * _NS)
        lost = 0
        if self._last_t_ns is not None:
            step_s = (device.ticks - self._stamped_ticks) / self.tick_hz
            earliest_ns = self._last_t_ns + int(0.5e9 * step_s) + 1
            if t_ns < earliest_ns:
                t_ns = earliest_ns
            # Half a period of tolerance swallows the 62/63 tick alternation at 1000 Hz.
            lost = max(0, round(step_s * self.rate_hz) - 1)
            self.lost += lost
        self._last_t_ns, self._stamped_ticks = t_ns, device.ticks
        sigma_s = math.hypot(self.envelope.sigma_s, self._tick_sigma_s)
        return Stamp(t_ns, int(sigma_s * _NS) if sigma_s < 1.0 else int(_NS), device.ticks, lost)


class SampleCounter:
    """A clock for devices that send none: one tick per sample, with losses guessed from the arrivals.

    A lost sample makes everything after it late by one period, for good; so ticks are left out when even the
    luckiest of the last samples is most of a period behind the luckiest before them. The guess comes `memory`
    samples after the loss.

    Args:
        rate_hz: Nominal sample rate.
        memory: Number of samples that must agree.
    """

    def __init__(self, rate_hz: float, memory: int = 50) -> None:
        self._period_ns = _NS / rate_hz
        self._memory = memory
        self._recent: deque[float] = deque(maxlen=memory)
        self._before: deque[float] = deque(maxlen=memory * 20)
        self._ticks = 0
        self._first_ns: int | None = None

    def count(self, t_arrival_ns: int) -> int:
        """Return the tick of the sample that arrived now."""
        if self._first_ns is None:
            self._first_ns = t_arrival_ns
        self._ticks += 1
        lateness = (t_arrival_ns - self._first_ns) - self._ticks * self._period_ns
        if len(self._recent) == self._memory:
            self._before.append(self._recent[0])
        self._recent.append(lateness)
        if len(self._before) >= self._memory:
            behind = (min(self._recent) - min(self._before)) / self._period_ns
            if behind > 0.75:
                self._ticks += round(behind)
                self._before.clear()
                self._recent.clear()
        return self._ticks
