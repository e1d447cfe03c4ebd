"""Device clock to host clock, from one-way arrival times alone. Pure arithmetic: no clock is read here.

Three clocks meet, each with its own names: the device's ticks (``device_ticks``, wrapping on the wire,
unwrapped inside), device seconds since the mapping began (``x_s``), and CLOCK_MONOTONIC of the host
(``t_..._ns``). The line between the last two is that of `envelope.LowerEnvelope`.
"""

from __future__ import annotations

import math
from collections import deque

import msgspec

from vical_drivers.envelope import EnvelopeOptions, LowerEnvelope

_NS = 1e9
_SURELY_POSSIBLE_S = 0.02
"""A sample that is not earlier than this, compared with the luckiest ones, may be true."""
_LEAST_STEP = 0.5 * _NS
"""Stamps go on by at least half of what the device's clock did, ns per device second."""


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


class DeviceTime(msgspec.Struct, frozen=True, gc=False):
    """When one sample was taken, on the device's clock.

    Attributes:
        ticks: Unwrapped ticks of the device.
        x_s: Device seconds since the mapping began, with the fraction of a tick that rounding took away.
        lost_before: Samples missing just before.
    """

    ticks: int
    x_s: float
    lost_before: int = 0


class Stamp(msgspec.Struct, frozen=True, gc=False):
    """Host time of one sample.

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
        outliers: Samples dropped because their time is impossible.
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
        self._period = tick_hz / rate_hz if rate_hz > 0.0 else 1.0
        self._options = options
        self._modulus = 0 if tick_bits is None else 1 << tick_bits
        self._suspect: tuple[int, int] | None = None
        self._begin()

    def _begin(self) -> None:
        self.envelope = LowerEnvelope(self._options)
        self._running = False
        self._first_ticks = 0
        self._last_ticks = 0
        self._fine = 0.0
        self._t0_ns = 0
        self._last_t_ns = -(1 << 62)
        self._last_x_s = 0.0
        self._sigma_s, self._t_sigma_ns = math.inf, int(_NS)

    @property
    def age_s(self) -> float:
        """Device seconds since the mapping began; below about 1 s the mapping is inaccurate."""
        return (self._last_ticks - self._first_ticks) / self.tick_hz

    def add(self, ticks: int, t_arrival_ns: int) -> DeviceTime | None:
        """Take one sample; return its device time, None where the value cannot be true or was seen.

        A value from the future is either damage or a restarted (or newly set) device timer. One such
        value is dropped; a second one that fits the first is a restart, and the mapping begins anew.
        """
        if not self._running:
            return self._start(ticks, t_arrival_ns)
        step = ticks - self._last_ticks
        if self._modulus:
            step %= self._modulus  # the counter wrapped: the step is still forward
        unwrapped = self._last_ticks + step
        # Samples come every 62.5 ticks at 1000 Hz, so the counter alternates between steps of 62 and 63. The
        # instants themselves are evenly spaced by the same crystal: go on by whole periods, within the tick.
        periods = round(step / self._period)
        fine = self._fine + periods * self._period
        if not unwrapped <= fine <= unwrapped + 1:
            fine = float(unwrapped if fine < unwrapped else unwrapped + 1)
        x_s = (fine - self._first_ticks) / self.tick_hz
        d_s = (t_arrival_ns - self._t0_ns) / _NS - x_s
        envelope = self.envelope
        # The line is spelt out, here and in `stamp`: 1000 times a second on a small computer.
        early = d_s < envelope.offset_s + envelope.skew * x_s - _SURELY_POSSIBLE_S
        if step <= 0 or (early and not self._possible(step, t_arrival_ns)):
            return self._doubt(ticks, step, t_arrival_ns)
        self._last_ticks, self._fine, self._suspect = unwrapped, fine, None
        envelope.add(x_s, d_s)
        return DeviceTime(unwrapped, x_s, periods - 1 if periods > 1 and self.rate_hz > 0.0 else 0)

    def _start(self, ticks: int, t_arrival_ns: int) -> DeviceTime:
        self._running, self._first_ticks, self._last_ticks = True, ticks, ticks
        self._fine, self._t0_ns, self._suspect = float(ticks), t_arrival_ns, None
        self.envelope.add(0.0, 0.0)
        return DeviceTime(ticks, 0.0)

    def _doubt(self, ticks: int, step: int, t_arrival_ns: int) -> DeviceTime | None:
        """Tell a repeated time, one that cannot be true, and a timer that began anew from one another."""
        if step == 0:
            self._suspect = None
            self.repeats += 1
            return None
        if not self._continues_suspect(ticks, t_arrival_ns):
            self._suspect = (ticks, t_arrival_ns)
            self.outliers += 1
            return None
        self.restarts += 1
        self.outliers -= 1
        self._begin()
        return self._start(ticks, t_arrival_ns)

    def _possible(self, step: int, t_arrival_ns: int) -> bool:
        """Tell whether an early arrival may be that of a sample `step` ticks after the last one."""
        x_s = (self._last_ticks + step - self._first_ticks) / self.tick_hz
        earliness_s = x_s + self.envelope.line(x_s) - (t_arrival_ns - self._t0_ns) / _NS
        # Before the envelope has settled an arrival may lie well below the first guess.
        allowed_s = _SURELY_POSSIBLE_S + 1e-3 * step / self.tick_hz + (1.0 if x_s < 5.0 else 0.0)
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
        envelope, x_s, lost = self.envelope, device.x_s, device.lost_before
        t_ns = self._t0_ns + round((x_s + (envelope.offset_s + envelope.skew * x_s)) * _NS)
        earliest_ns = self._last_t_ns + int(_LEAST_STEP * (x_s - self._last_x_s)) + 1
        if t_ns < earliest_ns:
            t_ns = earliest_ns
        self._last_t_ns, self._last_x_s = t_ns, x_s
        if lost:
            self.lost += lost
        if envelope.sigma_s != self._sigma_s:
            self._sigma_s = envelope.sigma_s
            sigma_s = math.hypot(self._sigma_s, self._tick_sigma_s)
            self._t_sigma_ns = int(min(sigma_s, 1.0) * _NS)
        return Stamp(t_ns, self._t_sigma_ns, device.ticks, lost)


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
