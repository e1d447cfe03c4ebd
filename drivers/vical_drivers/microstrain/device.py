"""A MicroStrain inertial sensor as an `ImuSource`: probe, identify, configure, stream, reconnect, close."""

from __future__ import annotations

import contextlib
import logging
import time
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from vical_drivers.clock import DeviceClock, DeviceTime, EnvelopeOptions, SampleCounter
from vical_drivers.errors import DeviceLostError, DeviceTimeoutError, DriverError
from vical_drivers.microstrain.probe import PROTOCOLS, connect
from vical_drivers.microstrain.session import ImuSettings, RawSample, Session
from vical_drivers.samples import DeviceInfo, ImuSample, SourceStats

_log = logging.getLogger(__name__)
WARM_UP_S = 1.0
"""Samples are held back this long at first: the clock mapping needs some arrivals."""
SILENCE_S = 2.0
"""A stream that is silent for this long counts as lost."""
_STUCK_SAMPLES = 20
"""So many samples with one and the same device time: the timer stands."""
_BACKOFF_S = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)


@dataclass(frozen=True, slots=True)
class ImuOptions:
    """How to open and keep the device; see `open_imu` for each."""

    protocol: str = "auto"
    link: str = "auto"
    reconnect: bool = True
    warm_up_s: float = WARM_UP_S
    silence_s: float = SILENCE_S
    clock: EnvelopeOptions = field(default_factory=EnvelopeOptions)


def open_imu(
    port: str,
    *,
    protocol: str = "auto",
    rate_hz: float = 100.0,
    filter_width: int = 15,
    baud: int | None = None,
    link: str = "auto",
    reconnect: bool = True,
    warm_up_s: float = WARM_UP_S,
    silence_s: float = SILENCE_S,
) -> MicrostrainImu:
    """Find the device on a port, set it up and start it.

    Args:
        port: Path of the serial port; ``/dev/serial/by-id/...`` survives a replug.
        protocol: "single-byte", "mip", or "auto": whichever is answered.
        rate_hz: Samples per second; the nearest rate the device can divide to is taken.
        filter_width: M of the GX3's moving average, 1 .. 32 ms; its delay is taken off the stamps.
        baud: Bits a second for streaming; None: as found, or more where the rate needs it. Temporary.
        link: What lies in between: "auto", "usb", "ftdi" or "uart"; decides whether bytes take wire time.
        reconnect: Come back by itself after an unplug.
        warm_up_s: The first samples are held back this long, then all delivered, none lost.
        silence_s: A stream without bytes for this long counts as lost.

    Returns:
        The running source; close it, or use it as a context manager.

    Raises:
        DriverError: One line that says what is wrong and what to try.
    """
    if protocol not in PROTOCOLS:
        raise DriverError(f"{port}: unknown protocol {protocol!r}; known are {', '.join(PROTOCOLS)}")
    options = ImuOptions(protocol, link, reconnect, warm_up_s, silence_s)
    return MicrostrainImu(port, ImuSettings(rate_hz, filter_width, baud), options)


class MicrostrainImu:
    """The source behind `open_imu`. One thread at a time may use it."""

    def __init__(self, path: str, settings: ImuSettings, options: ImuOptions | None = None) -> None:
        self._path = path
        self._settings = settings
        self._options = options or ImuOptions()
        self._session: Session | None = None
        self._close_port = contextlib.ExitStack()
        self._samples = 0
        self._lost = 0
        self._past_checksum_errors = 0
        self._past_skipped_bytes = 0
        self._reconnects = 0
        self._attempts = 0
        self._held: list[tuple[RawSample, DeviceTime]] = []
        self._closed = False
        self._last_data_ns = 0
        self._next_attempt_ns = 0
        self._last_stamp_ns = 0
        self._span: tuple[int, int, int] | None = None
        self._open()

    @property
    def info(self) -> DeviceInfo:
        """Who the device is."""
        return self._info

    def _open(self) -> None:
        o = self._options
        session, port = connect(
            self._path, o.protocol, o.link, self._settings.baud, patient=not self._samples
        )
        self._close_port.callback(port.close)
        try:
            self._info = session.identify()
            self.applied = session.configure(self._settings)
            session.start()
        except BaseException:
            session.stop()
            self._close_port.close()
            raise
        self._session = session
        a = self.applied
        # Without a time field the samples themselves are the clock: one tick each.
        self._counter = None if a.tick_hz else SampleCounter(a.rate_hz)
        self.clock = DeviceClock(
            a.tick_hz or a.rate_hz, tick_bits=a.tick_bits, rate_hz=a.rate_hz, options=o.clock
        )
        # The device reads its timer, then sends; what the stamp means lies a filter delay earlier.
        self._delay_ns = round(a.group_delay_s * 1e9 + a.record_bytes * port.wire_byte_ns)
        self._last_data_ns = time.monotonic_ns()
        self._attempts = 0
        self._held = []
        self._stuck = 0
        self._span = None
        _log.info("imu=%s model=%s serial=%s", self._path, self._info.model, self._info.serial_number)

    def read(self, timeout_s: float) -> list[ImuSample]:
        """See `ImuSource.read`."""
        if self._closed:
            raise DeviceLostError(f"{self._path}: this source was closed")
        if self._session is None:
            self._try_again(timeout_s)
            return []
        try:
            raw = self._session.read(timeout_s)
            self._watch_silence(bool(raw))
        except DriverError:
            self._drop()
            raise
        return self._stamped(raw)

    def _watch_silence(self, alive: bool) -> None:
        now_ns = time.monotonic_ns()
        if alive:
            self._last_data_ns = now_ns
        elif now_ns - self._last_data_ns > self._options.silence_s * 1e9:
            raise DeviceTimeoutError(f"{self._path}: the stream went silent; check power and cable")

    def _stamped(self, raw: list[RawSample]) -> list[ImuSample]:
        for sample in raw:
            if sample.ticks is None and self._counter is None:
                self._switch_to_counting()
            raw_ticks = sample.ticks if self._counter is None else self._counter.count(sample.t_arrival_ns)
            assert raw_ticks is not None
            restarts, repeats = self.clock.restarts, self.clock.repeats
            device_time = self.clock.add(raw_ticks, sample.t_arrival_ns)
            if self.clock.restarts != restarts:
                self._held.clear()
            self._stuck = self._stuck + 1 if self.clock.repeats != repeats else 0
            if self._stuck > _STUCK_SAMPLES:
                self._switch_to_counting()
            if device_time is not None:
                self._held.append((sample, device_time))
        if not self._held or self.clock.age_s < self._options.warm_up_s:
            return []
        held, self._held = self._held, []
        out = [self._to_sample(sample, device_time) for sample, device_time in held]
        self._samples += len(out)
        first_ns, count, _ = self._span or (out[0].t_host_ns, 0, 0)
        self._span = (first_ns, count + len(out), out[-1].t_host_ns)
        return out

    def _switch_to_counting(self) -> None:
        """The device does not date its samples (no GPS time yet, a timer that stands): count them."""
        self._stuck = 0
        self._counter = SampleCounter(self.applied.rate_hz)
        self._renew_clock(self.applied.rate_hz, None)

    def _renew_clock(self, tick_hz: float, tick_bits: int | None) -> None:
        self._held = []
        restarts = self.clock.restarts + 1
        self.clock = DeviceClock(
            tick_hz, tick_bits=tick_bits, rate_hz=self.applied.rate_hz, options=self._options.clock
        )
        self.clock.restarts = restarts

    def _to_sample(self, raw: RawSample, device_time: DeviceTime) -> ImuSample:
        stamp = self.clock.stamp(device_time)
        self._lost += stamp.lost_before
        # A new clock (restart, reconnect) may begin a little before the old one ended.
        self._last_stamp_ns = max(stamp.t_device_event_ns - self._delay_ns, self._last_stamp_ns + 1)
        return ImuSample(
            t_host_ns=self._last_stamp_ns,
            t_arrival_ns=raw.t_arrival_ns,
            device_ticks=device_time.ticks,
            gyro_rps=raw.gyro_rps,
            specific_force_mps2=raw.specific_force_mps2,
            t_sigma_ns=stamp.t_sigma_ns,
            lost_before=stamp.lost_before,
        )

    def _drop(self) -> None:
        """Give up the present connection; counters go on."""
        if self._session is not None:
            self._past_checksum_errors += self._session.checksum_errors
            self._past_skipped_bytes += self._session.skipped_bytes
        self._session = None
        self._close_port.close()
        self._next_attempt_ns = time.monotonic_ns()

    def _try_again(self, timeout_s: float) -> None:
        """Wait for the next attempt, at most `timeout_s`, and make it; failures only lengthen the pause."""
        if not self._options.reconnect:
            raise DeviceLostError(f"{self._path}: the device is gone")
        wait_s = (self._next_attempt_ns - time.monotonic_ns()) / 1e9
        if wait_s > 0:
            time.sleep(min(wait_s, timeout_s))
            if wait_s > timeout_s:
                return
        try:
            self._open()
            self._reconnects += 1
        except DriverError as error:
            pause_s = _BACKOFF_S[min(self._attempts, len(_BACKOFF_S) - 1)]
            self._attempts += 1
            self._next_attempt_ns = time.monotonic_ns() + round(pause_s * 1e9)
            _log.debug("imu=%s reconnect=failed reason=%s", self._path, error)

    def stats(self) -> SourceStats:
        """See `ImuSource.stats`."""
        session = self._session
        return SourceStats(
            samples=self._samples,
            lost=self._lost,
            checksum_errors=self._past_checksum_errors + (session.checksum_errors if session else 0),
            resync_bytes=self._past_skipped_bytes + (session.skipped_bytes if session else 0),
            reconnects=self._reconnects,
            rate_hz=self._measured_rate_hz(),
            clock_skew_ppm=-self.clock.envelope.skew * 1e6,
            jitter_us=self.clock.envelope.jitter_s * 1e6,
            extra={
                "clock_restarts": float(self.clock.restarts),
                "impossible_times": float(self.clock.outliers),
                "repeated_times": float(self.clock.repeats),
                "group_delay_s": self.applied.group_delay_s,
            },
        )

    def _measured_rate_hz(self) -> float:
        """Samples per host second since the connection began; nominal until there are two."""
        if self._span is None or self._span[2] == self._span[0]:
            return self.applied.rate_hz
        first_ns, count, last_ns = self._span
        return (count - 1) * 1e9 / (last_ns - first_ns)

    def close(self) -> None:
        """Stop the stream and free the port; may be called twice."""
        self._closed = True
        session, self._session = self._session, None
        if session is not None:
            self._past_checksum_errors += session.checksum_errors
            self._past_skipped_bytes += session.skipped_bytes
            session.stop()
        self._close_port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
