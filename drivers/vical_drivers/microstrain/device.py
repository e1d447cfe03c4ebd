"""A MicroStrain inertial sensor as an `ImuSource`: probe, identify, configure, stream, reconnect, close."""

from __future__ import annotations

import contextlib
import logging
import time
from dataclasses import dataclass, field
from pathlib import Path

from vical_drivers.closing import Closing
from vical_drivers.envelope import EnvelopeOptions
from vical_drivers.errors import DeviceLostError, DeviceReplacedError, DeviceTimeoutError, DriverError
from vical_drivers.microstrain.port import SerialPort
from vical_drivers.microstrain.probe import PROBE_BAUDS, PROTOCOLS, connect
from vical_drivers.microstrain.session import ImuSettings, Session
from vical_drivers.microstrain.stamping import WARM_UP_S, SampleStamper
from vical_drivers.samples import DeviceInfo, ImuSample, SourceStats

_log = logging.getLogger(__name__)
SILENCE_S = 2.0
"""A stream that is silent for this long counts as lost."""
_ABSENT_S = 0.1
"""A host that is away for longer than this between two reads has not listened: no silence of the device."""
_LEAST_CONNECTION_S = 1.0
"""A device whose timer begins anew all the time is set up again this often at most."""
_BACKOFF_S = (0.1, 0.25)
"""Pauses between attempts to come back: an attempt on a port that is not there costs a system call, one on a
silent port half a second."""


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
    filter_width: int | None = None,
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
        filter_width: M of the GX3's moving average: 1 .. 32 ms; its delay is subtracted from stamps. None:
            one sample interval, so that averages neither overlap nor leave gaps.
        baud: Bits per second for streaming; None: as found, or more where the rate needs it. Temporary.
        link: Kind of link: "auto", "usb", "ftdi" or "uart"; decides whether bytes take wire time.
        reconnect: Reconnect automatically after an unplug.
        warm_up_s: The first samples are held back this long, then all delivered, none lost.
        silence_s: A stream without samples for this long counts as lost; pauses of the host do not count.

    Returns:
        The running source; close it, or use it as a context manager.

    Raises:
        DriverError: One line that says what is wrong and what to try.
    """
    if protocol not in PROTOCOLS:
        raise DriverError(f"{port}: unknown protocol {protocol!r}; known are {', '.join(PROTOCOLS)}")
    options = ImuOptions(protocol, link, reconnect, warm_up_s, silence_s)
    return MicrostrainImu(port, ImuSettings(rate_hz, filter_width, baud), options)


class MicrostrainImu(Closing):
    """The source behind `open_imu`. One thread at a time may use it."""

    def __init__(self, path: str, settings: ImuSettings, options: ImuOptions | None = None) -> None:
        self._path = path
        self._settings = settings
        self._options = options or ImuOptions()
        self._session: Session | None = None
        self._close_port = contextlib.ExitStack()
        self._stamper: SampleStamper | None = None
        self._past_checksum_errors = 0
        self._past_skipped_bytes = 0
        self._reconnects = 0
        self._attempts = 0
        self._closed = False
        self._silent_s = self._last_read_s = 0.0
        self._next_attempt_ns = 0
        self._known: DeviceInfo | None = None
        self._likely_bauds: list[int] = []
        self._open()

    @property
    def info(self) -> DeviceInfo:
        """Who the device is."""
        return self._info

    def _open(self) -> None:
        o = self._options
        session, port = self._connect()
        self._close_port.callback(port.close)
        try:
            info = session.identify()
            self._expect(info)
            found_baud = port.baud
            self.applied = session.configure(self._settings)
            session.start()
        except BaseException:
            session.stop()
            self._close_port.close()
            raise
        self._known = self._info = info
        self._likely_bauds = list(dict.fromkeys((found_baud, port.baud, PROBE_BAUDS[0])))
        self._session = session
        if self._stamper is None:
            self._stamper = SampleStamper(self.applied, port.wire_byte_ns, o.warm_up_s, o.clock)
        else:
            self._stamper.begin(self.applied, port.wire_byte_ns)
        self._silent_s, self._last_read_s = 0.0, time.monotonic()
        self._opened_s = self._last_read_s
        self._attempts = 0
        _log.info("imu=%s model=%s serial=%s", self._path, self._info.model, self._info.serial_number)

    def _connect(self) -> tuple[Session, SerialPort]:
        """Find the device; a known one with its last settings first."""
        o, known = self._options, self._known
        if known is None:
            return connect(self._path, o.protocol, o.link, self._settings.baud)
        if self._attempts % 2 == 0:
            return connect(self._path, known.protocol, o.link, bauds=self._likely_bauds, patient=False)
        # in between at one other baud, in any protocol: during a whole search, 4 s, it may come back
        other = PROBE_BAUDS[self._attempts // 2 % len(PROBE_BAUDS)]
        return connect(self._path, o.protocol, o.link, bauds=[other], patient=False)

    def _expect(self, info: DeviceInfo) -> None:
        """Refuse another device: clock, counters and calibration belong to the first one."""
        known = self._known
        if known is None or (info.serial_number, info.model) == (known.serial_number, known.model):
            return
        if known.serial_number and not info.serial_number:
            raise DeviceTimeoutError(f"{self._path}: the device does not report its serial number")
        if info.serial_number == known.serial_number:
            return
        self._closed = True
        raise DeviceReplacedError(
            f"{self._path}: another device came back: {info.model} serial {info.serial_number}, "
            f"not {known.model} serial {known.serial_number}"
        )

    def read(self, timeout_s: float) -> list[ImuSample]:
        """See `ImuSource.read`."""
        if self._closed:
            raise DeviceLostError(f"{self._path}: this source was closed")
        if self._session is None:
            self._try_again(timeout_s)
            return []
        try:
            raw = self._session.read(timeout_s)
            if raw:
                self._silent_s, self._last_read_s = 0.0, time.monotonic()
            else:
                self._watch_silence(timeout_s)
        except DriverError:
            self._drop()
            raise
        if not raw:
            return []
        assert self._stamper is not None
        samples = self._stamper.stamp(raw)
        if self._stamper.timer_began_anew and self._options.reconnect:
            # Where it streams from power-up, a device that was reset goes on as its EEPROM says: at another
            # rate, or with another filter, whose delay would be missing in all stamps.
            if self._last_read_s - self._opened_s > _LEAST_CONNECTION_S:
                _log.warning("imu=%s it may have been reset (its timer was): set up again", self._path)
                self._drop()
            return []
        return samples

    def _watch_silence(self, timeout_s: float) -> None:
        """Add up the time in which the host listened and nothing came."""
        now_s = time.monotonic()
        self._silent_s += min(now_s - self._last_read_s, timeout_s + _ABSENT_S)
        self._last_read_s = now_s
        if self._silent_s > self._options.silence_s:
            raise DeviceTimeoutError(f"{self._path}: the stream went silent; check power and cable")

    def _drop(self) -> None:
        """Close the present connection; keep the counters."""
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
        except DeviceReplacedError:
            raise
        except DriverError as error:
            pause_s = _BACKOFF_S[min(self._attempts, len(_BACKOFF_S) - 1)]
            # a port that is not there was not asked: it will be asked first where the device was
            self._attempts = self._attempts + 1 if Path(self._path).exists() else 0
            self._next_attempt_ns = time.monotonic_ns() + round(pause_s * 1e9)
            _log.debug("imu=%s reconnect=failed reason=%s", self._path, error)

    def stats(self) -> SourceStats:
        """See `ImuSource.stats`."""
        session, stamper = self._session, self._stamper
        assert stamper is not None
        clock = stamper.clock
        return SourceStats(
            samples=stamper.samples,
            lost=stamper.lost,
            checksum_errors=self._past_checksum_errors + (session.checksum_errors if session else 0),
            resync_bytes=self._past_skipped_bytes + (session.skipped_bytes if session else 0),
            reconnects=self._reconnects,
            rate_hz=stamper.rate_hz,
            clock_skew_ppm=-clock.envelope.skew * 1e6,
            jitter_us=clock.envelope.jitter_s * 1e6,
            extra={
                "clock_restarts": float(clock.restarts),
                "impossible_times": float(clock.outliers),
                "repeated_times": float(clock.repeats),
                "group_delay_s": self.applied.group_delay_s,
            },
        )

    def close(self) -> None:
        """Stop the stream and free the port; may be called twice."""
        self._closed = True
        session, self._session = self._session, None
        if session is not None:
            self._past_checksum_errors += session.checksum_errors
            self._past_skipped_bytes += session.skipped_bytes
            session.stop()
        self._close_port.close()
