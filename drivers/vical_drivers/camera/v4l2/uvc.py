"""UVC time stamps: the payload headers of the metadata node, and a fit of the camera's clock to ours.

Each payload header of a USB camera carries PTS (when the frame was captured, in ticks of the camera's
clock) and SCR (the same clock read when the payload was sent: STC, with the USB frame number). Linux
hands the headers out on a second node in the format ``UVCH``, with the host time at which each payload
arrived (kernel documentation, "V4L2_META_FMT_UVC"). Arrivals are late by a delay that is never negative,
so the *lower envelope* of (STC, arrival) gives the camera's clock on CLOCK_MONOTONIC; PTS through that
line is the stamp. Pure arithmetic: nothing here reads a clock or a device.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_drivers.clock import TickUnwrapper
from vical_drivers.envelope import EnvelopeOptions, LowerEnvelope

_HAS_PTS = 0x04
_HAS_SCR = 0x08
_ENTRY = struct.Struct("<QHBB")  # host ns, host USB frame number, header length, header flags
_HALF = 1 << 31

COMMON_CLOCKS_HZ = (1e6, 6e6, 10e6, 12e6, 15e6, 24e6, 25e6, 27e6, 30e6, 48e6, 50e6, 60e6, 90e3)
"""Clock frequencies seen in UVC cameras, for one that does not tell its own."""

MIN_AGE_S = 1.0
MAX_SIGMA_S = 0.5e-3
ARRIVALS = 600
LOOK_EVERY = 32
SCATTER_S = 0.5e-3
LOW_SHARE = 0.45
MAX_DELAY_S = 1.0
MAX_SUSPECTS = 20
MAX_CAPTURE_TO_PACKET_NS = 500_000_000
MAX_PACKET_BEFORE_CAPTURE_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class PayloadHeader:
    """One payload header with its arrival.

    Attributes:
        t_host_ns: Arrival, clock of the uvcvideo driver (CLOCK_MONOTONIC by default), ns.
        pts: Ticks, 32 bit; None where the header has none.
        stc: Ticks, 32 bit; None where the header has none.
        device_sof: USB frame number at `stc`; None where the header has none.
    """

    t_host_ns: int
    pts: int | None
    stc: int | None
    device_sof: int | None


def parse_metadata(data: bytes | memoryview) -> Iterator[PayloadHeader]:
    """Yield the payload headers of one UVCH buffer; stops at a header that is cut off or impossible."""
    at = 0
    while at + _ENTRY.size <= len(data):
        t_ns, _host_sof, length, flags = _ENTRY.unpack_from(data, at)
        end = at + _ENTRY.size - 2 + length  # the length counts itself and the flags
        need = 2 + (4 if flags & _HAS_PTS else 0) + (6 if flags & _HAS_SCR else 0)
        if length < need or end > len(data):
            return
        at += _ENTRY.size
        pts = stc = device_sof = None
        if flags & _HAS_PTS:
            (pts,) = struct.unpack_from("<I", data, at)
            at += 4
        if flags & _HAS_SCR:
            stc, device_sof = struct.unpack_from("<IH", data, at)
            device_sof &= 0x7FF
        yield PayloadHeader(t_ns, pts, stc, device_sof)
        at = end


def clock_frequency_hz(descriptors: bytes) -> float | None:
    """Return dwClockFrequency of the VideoControl header in a USB device's descriptors; None: not there."""
    at = 0
    video_control = False
    while at + 2 <= len(descriptors):
        length, kind = descriptors[at], descriptors[at + 1]
        if length < 2:
            return None
        body = descriptors[at : at + length]
        if kind == 0x04 and length >= 9:  # interface: class 14 is video, subclass 1 control
            video_control = (body[5], body[6]) == (0x0E, 0x01)
        if kind == 0x24 and video_control and length >= 11 and body[2] == 0x01:
            frequency = struct.unpack_from("<I", body, 7)[0]
            return float(frequency) if frequency else None
        at += length
    return None


@dataclass(frozen=True, slots=True)
class ClockHealth:
    """State of the fit.

    Attributes:
        usable: Stamps may be made with it.
        reason: Why not, in words; "" when usable.
        skew_ppm: Of the camera's clock against the host's.
        residual_sigma_ns: One sigma of the fitted line, ns.
        jitter_ns: Standard deviation of the arrivals' delay, ns.
    """

    usable: bool
    reason: str
    skew_ppm: float
    residual_sigma_ns: float
    jitter_ns: float


class UvcClock:
    """Maps the camera's ticks to the host by the lower envelope of the payload arrivals.

    Args:
        frequency_hz: Of the camera's clock, as its descriptors say; None: found from the data.
    """

    def __init__(self, frequency_hz: float | None = None) -> None:
        self._frequency_hz = frequency_hz
        self._waiting: list[tuple[int, int]] = []
        self._arrivals: deque[tuple[float, float]] = deque(maxlen=ARRIVALS)
        self._restart()
        self.restarts = 0

    def _restart(self) -> None:
        wide = EnvelopeOptions(max_skew=0.05, skew_prior=1e-3) if self._frequency_hz is None else None
        self._envelope = LowerEnvelope(wide)
        self._unwrap = TickUnwrapper(32)
        self._first: tuple[int, int] | None = None
        self._x_s = 0.0
        self._ticks = 0
        self._suspects = 0
        self._arrivals.clear()
        self._scatters = False
        self._looked = 0

    def add(self, header: PayloadHeader) -> None:
        """Take the clock reading of one payload; headers without SCR are ignored."""
        if header.stc is None:
            return
        if self._frequency_hz is None:
            self._waiting.append((header.stc, header.t_host_ns))
            self._find_frequency()
            return
        self._take(header.stc, header.t_host_ns)

    def _find_frequency(self) -> None:
        first, last = self._waiting[0], self._waiting[-1]
        if last[1] - first[1] < 1_000_000_000:
            return
        waiting, self._waiting = self._waiting, []
        unwrap = TickUnwrapper(32)
        ticks = np.array([unwrap.accept(stc) for stc, _ in waiting], dtype=float)
        seconds = np.array([(t - first[1]) * 1e-9 for _, t in waiting])
        found = float(np.polyfit(seconds, ticks, 1)[0])
        if found < 1e3:
            return  # the clock stands still: no camera clock to speak of
        nearest = min(COMMON_CLOCKS_HZ, key=lambda f: abs(f - found))
        if abs(nearest - found) < 5e-3 * nearest:
            self._frequency_hz = nearest
            self._restart()
        else:
            self._restart()
            self._frequency_hz = found
        for stc, t_ns in waiting:
            self._take(stc, t_ns)

    def _take(self, stc: int, t_host_ns: int) -> None:
        assert self._frequency_hz is not None
        if not self._possible(stc, t_host_ns):
            # a repeated header is older; a camera that restarted its clock is wrong again and again
            self._suspects += 1
            if self._suspects <= MAX_SUSPECTS:
                return
            self.restarts += 1
            self._restart()
        self._suspects = 0
        self._ticks = self._unwrap.accept(stc)
        if self._first is None:
            self._first = (self._ticks, t_host_ns)
        self._x_s = (self._ticks - self._first[0]) / self._frequency_hz
        delay_s = (t_host_ns - self._first[1]) * 1e-9 - self._x_s
        self._envelope.add(self._x_s, delay_s)
        self._arrivals.append((self._x_s, delay_s))
        self._looked += 1
        if self._looked % LOOK_EVERY == 0:
            x_s, d_s = np.array(self._arrivals).T
            line_s = self._envelope.line(0.0) + self._envelope.skew * x_s
            self._scatters = scatters_both_ways(d_s - line_s)

    def _possible(self, stc: int, t_host_ns: int) -> bool:
        if self._first is None or self._frequency_hz is None:
            return True
        step = self._unwrap.step(stc)
        x_s = (self._ticks + step - self._first[0]) / self._frequency_hz
        delay_s = (t_host_ns - self._first[1]) * 1e-9 - x_s - self._envelope.line(x_s)
        return step < _HALF and abs(delay_s) < MAX_DELAY_S

    def to_host_ns(self, ticks: int) -> int | None:
        """Map 32-bit ticks near the newest clock reading to the host's clock, ns; None: no reading yet."""
        if self._first is None or self._frequency_hz is None:
            return None
        newest = self._ticks % (1 << 32)
        offset = (ticks - newest + _HALF) % (1 << 32) - _HALF
        x_s = (self._ticks + offset - self._first[0]) / self._frequency_hz
        return self._first[1] + round((x_s + self._envelope.line(x_s)) * 1e9)

    def health(self) -> ClockHealth:
        """Say whether stamps may be made with the fit, and how good it is."""
        e = self._envelope
        reason = ""
        if self._first is None or self._x_s < MIN_AGE_S:
            reason = "too few clock readings yet"
        elif self._scatters:
            reason = "clock readings scatter both ways"
        elif e.sigma_s > MAX_SIGMA_S:
            reason = "the fitted line is too uncertain"
        sigma_ns = e.sigma_s * 1e9 if np.isfinite(e.sigma_s) else 1e9
        # the envelope's skew is host per device; a fast camera clock has a negative one
        return ClockHealth(not reason, reason, -e.skew * 1e6, sigma_ns, e.jitter_s * 1e9)


def scatters_both_ways(residuals_s: npt.NDArray[np.float64]) -> bool:
    """Tell readings that are wrong either way from arrivals that are merely late.

    Lateness alone piles the residuals up at the line (a tenth of them lies below 0.15 medians, were it
    exponential), however long its tail; errors of both signs leave the low end thin (0.6 for a bell).

    Args:
        residuals_s: Arrival minus line, s, shape (n,).
    """
    tenth, median = np.percentile(residuals_s, [10, 50])
    return bool(median > SCATTER_S and tenth > LOW_SHARE * median)


def plausible_capture(t_capture_ns: int, t_first_packet_ns: int) -> bool:
    """Tell whether a mapped PTS may belong to a frame whose first packet arrived then."""
    delay = t_first_packet_ns - t_capture_ns
    return -MAX_PACKET_BEFORE_CAPTURE_NS <= delay <= MAX_CAPTURE_TO_PACKET_NS


def metadata_bytes(array: npt.NDArray[np.uint8], used: int) -> bytes:
    """Return the used part of a mapped metadata buffer."""
    return array[:used].tobytes()
