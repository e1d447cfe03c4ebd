"""Device clock to host clock, from one-way arrival times alone. Pure arithmetic: no clock is read here.

Three clocks meet, each with its own names: the device's ticks (``device_ticks``, wrapping on the wire,
unwrapped inside), device seconds since the mapping began (``x_s``), and CLOCK_MONOTONIC of the host
(``t_..._ns``). The line between the last two is that of `envelope.LowerEnvelope`.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from vical_drivers.envelope import EnvelopeOptions, LowerEnvelope

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
        self._last_t_ns: int | None = None
        self._stamped_ticks = 0

    @property
    def age_s(self) -> float:
        """Device seconds since the mapping began; below about 1 s it is not worth much."""
        return (self._last_ticks - self._first_ticks) / self.tick_hz

    def add(self, ticks: int, t_arrival_ns: int) -> DeviceTime | None:
        """Take one sample; return its device time, None where the value cannot be true or was seen.

        A value from the future is either damage or a restarted (or newly set) device timer. One such
        value is dropped; a second one that fits the first is a restart, and the mapping begins anew.
        """
        step = ticks - self._last_ticks
        if self._modulus:
            step %= self._modulus  # the counter wrapped: the step is still forward
        if not self._running:
            self._start(ticks, t_arrival_ns)
            step = 0
        elif not self._possible(step, t_arrival_ns):
            if not self._continues_suspect(ticks, t_arrival_ns):
                self._suspect = (ticks, t_arrival_ns)
                self.outliers += 1
                return None
            self.restarts += 1
            self.outliers -= 1
            self._begin()
            self._start(ticks, t_arrival_ns)
            step = 0
        elif step == 0:
            self._suspect = None
            self.repeats += 1
            return None
        self._suspect = None
        unwrapped = self._last_ticks + step
        self._fine = fine = self._refined(unwrapped, step)
        x_s = (fine - self._first_ticks) / self.tick_hz
        self.envelope.add(x_s, (t_arrival_ns - self._t0_ns) / _NS - x_s)
        self._last_ticks = unwrapped
        return DeviceTime(unwrapped, fine)

    def _start(self, ticks: int, t_arrival_ns: int) -> None:
        self._running, self._first_ticks, self._last_ticks = True, ticks, ticks
        self._fine, self._t0_ns = float(ticks), t_arrival_ns

    def _refined(self, unwrapped: int, step: int) -> float:
        """Ticks with the fraction that rounding took away.

        Samples come every 62.5 ticks at 1000 Hz, so the counter alternates between steps of 62 and 63. The
        instants themselves are evenly spaced by the same crystal: go on by whole periods, within the tick.
        """
        period = self._period
        if period <= 0.0:
            return float(unwrapped)
        fine = self._fine + round(step / period) * period
        if fine < unwrapped:
            return float(unwrapped)
        return fine if fine < unwrapped + 1.0 else unwrapped + 1.0

    def _possible(self, step: int, t_arrival_ns: int) -> bool:
        """Tell whether an arrival may be that of a sample `step` ticks after the last one."""
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
        x_s = (device.fine - self._first_ticks) / self.tick_hz
        t_ns = self._t0_ns + round((x_s + self.envelope.line(x_s)) * _NS)
        lost = 0
        if self._last_t_ns is not None:
            step_s = (device.ticks - self._stamped_ticks) / self.tick_hz
            earliest_ns = self._last_t_ns + int(0.5e9 * step_s) + 1
            if t_ns < earliest_ns:
                t_ns = earliest_ns
            # Half a period of tolerance swallows the 62/63 tick alternation at 1000 Hz.
            lost = round(step_s * self.rate_hz) - 1
            if lost > 0:
                self.lost += lost
            else:
                lost = 0
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
