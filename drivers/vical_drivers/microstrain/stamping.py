"""From raw samples to stamped ones: clock mapping, warm-up, counting where a device sends no time. No I/O."""

from __future__ import annotations

from collections import deque

from vical_drivers.clock import DeviceClock, DeviceTime, SampleCounter
from vical_drivers.envelope import EnvelopeOptions
from vical_drivers.microstrain.session import Applied, RawSample
from vical_drivers.samples import ImuSample

WARM_UP_S = 1.0
"""Samples are held back this long at first: the clock mapping needs some arrivals."""
_RATE_NS = 5_000_000_000  # the rate of late is that of one to two such times
_STUCK_SAMPLES = 20
"""So many samples with one and the same device time: the timer stands."""


class SampleStamper:
    """Dates the samples of one device, over all its connections.

    Attributes:
        clock: The mapping of the present connection.
        samples: Stamped so far.
        lost: Known to be missing so far.
        timer_began_anew: The device's timer did on this connection, or is sent no more: the device may have
            been reset.

    Args:
        applied: What the device does.
        byte_ns: Time one byte occupies the wire, ns.
        warm_up_s: The first samples of a mapping are held back this long, then all delivered.
        options: Tuning of the mapping.
    """

    def __init__(
        self, applied: Applied, byte_ns: float, warm_up_s: float = WARM_UP_S,
        options: EnvelopeOptions | None = None,
    ) -> None:  # fmt: skip
        self._warm_up_s, self._options = warm_up_s, options
        self.samples = 0
        self.lost = 0
        self._last_stamp_ns = 0
        self._restarts = 0
        self._marks: deque[tuple[int, int]] = deque(maxlen=2)  # a stamp, and how many samples there were then
        self.begin(applied, byte_ns)

    def begin(self, applied: Applied, byte_ns: float) -> None:
        """Start with a new connection: another mapping, while stamps and counters go on."""
        self._rate_hz = applied.rate_hz
        # The device reads its timer, then sends; what the stamp means lies a filter delay earlier.
        self._delay_ns = round(applied.group_delay_s * 1e9 + applied.record_bytes * byte_ns)
        self._span_samples = 0
        self._marks.clear()
        self.timer_began_anew = False
        # Without a time field the samples themselves are the clock: one tick each.
        self._counter = None if applied.tick_hz else SampleCounter(applied.rate_hz)
        self._begin_clock(applied.tick_hz or applied.rate_hz, applied.tick_bits, restarts=self._restarts)

    def _begin_clock(self, tick_hz: float, tick_bits: int | None, restarts: int) -> None:
        self.clock = DeviceClock(tick_hz, tick_bits=tick_bits, rate_hz=self._rate_hz, options=self._options)
        self.clock.restarts = self._restarts = restarts
        self._held: list[tuple[RawSample, DeviceTime]] = []
        self._warm = False
        self._stuck = 0
        self._repeats = 0

    @property
    def rate_hz(self) -> float:
        """Samples per host second over the last 5 to 10 s of the connection; nominal until there are two."""
        if self._span_samples < 2:
            return self._rate_hz
        since_ns, before = self._marks[0]
        elapsed_ns = self._last_stamp_ns - since_ns
        return (self._span_samples - before) * 1e9 / elapsed_ns if elapsed_ns > 0 else self._rate_hz

    def stamp(self, raw: list[RawSample]) -> list[ImuSample]:
        """Date what one read brought; [] while the mapping warms up."""
        # All of a read go to the clock before any is stamped: the last of a bunch is the luckiest.
        for sample in raw:
            ticks = sample.ticks
            if self._counter is not None or ticks is None:
                ticks = self._counted(sample.t_arrival_ns)
            device_time = self.clock.add(ticks, sample.t_arrival_ns)
            if device_time is None:
                self._note_unusable()
                continue
            self._stuck = 0
            if self.clock.restarts != self._restarts:
                self._restarts, self._warm = self.clock.restarts, False
                self.timer_began_anew = True
                self._held.clear()
            self._held.append((sample, device_time))
        if not self._held or not (self._warm or self.clock.age_s >= self._warm_up_s):
            return []
        self._warm = True
        return self._release()

    def _release(self) -> list[ImuSample]:
        """Date what is held."""
        stamp, delay_ns, last_ns = self.clock.stamp, self._delay_ns, self._last_stamp_ns
        out = []
        for raw, device_time in self._held:
            s = stamp(device_time)
            t_host_ns = s.t_device_event_ns - delay_ns
            if t_host_ns <= last_ns:  # a new clock (restart, reconnect) may begin before the old one ended
                t_host_ns = last_ns + 1
            last_ns = t_host_ns
            if s.lost_before:
                self.lost += s.lost_before
            out.append(
                ImuSample(
                    t_host_ns, raw.t_arrival_ns, s.device_ticks, raw.gyro_rps, raw.specific_force_mps2,
                    s.t_sigma_ns, s.lost_before,
                )
            )  # fmt: skip
        self._held = []
        if not self._span_samples:
            self._marks.append((out[0].t_host_ns, 1))
        self._last_stamp_ns = last_ns
        self._span_samples += len(out)
        if last_ns - self._marks[-1][0] > _RATE_NS:
            self._marks.append((last_ns, self._span_samples))
        self.samples += len(out)
        return out

    def _counted(self, t_arrival_ns: int) -> int:
        """Tick of a sample that its device did not date."""
        if self._counter is None:
            self.timer_began_anew = self.clock.age_s > 0.0
            self._switch_to_counting()
        assert self._counter is not None
        return self._counter.count(t_arrival_ns)

    def _note_unusable(self) -> None:
        """Take note of a time that is impossible or repeated; when it repeats for long, the timer stands."""
        repeats, self._repeats = self._repeats, self.clock.repeats
        self._stuck = self._stuck + 1 if self.clock.repeats != repeats else 0
        if self._stuck > _STUCK_SAMPLES:
            self._switch_to_counting()

    def _switch_to_counting(self) -> None:
        """The device does not date its samples (no GPS time yet, a timer that stands): count them."""
        self._counter = SampleCounter(self._rate_hz)
        self._begin_clock(self._rate_hz, None, restarts=self._restarts + 1)
