"""A camera as a V4L2 driver shows it: timing with truth, controls, pictures, faults. No system calls.

Truth is kept for every frame, so that a grabber's stamps can be checked against the instant at which the
simulated shutter really was open. All times are ns of the host's CLOCK_MONOTONIC.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]
Picture = Callable[[int, str, int, int], Bytes]
"""(frame number, four-character code, width, height) -> bytes of the frame."""

CID_EXPOSURE_AUTO = 0x009A0901
CID_EXPOSURE_ABSOLUTE = 0x009A0902
CID_EXPOSURE_AUTO_PRIORITY = 0x009A0903
CID_FOCUS_ABSOLUTE = 0x009A090A
CID_FOCUS_AUTO = 0x009A090C
CID_GAIN = 0x00980913
CID_AUTOGAIN = 0x00980912
INACTIVE = 0x0010

INTEGER, BOOLEAN, MENU = 1, 2, 3


@dataclass
class FakeControl:
    """One control; `off_unless` names (control id, value) that must hold, or the kernel says EACCES.

    `broken` is the error of every request about it: the camera announces it and does not know it. `stalled`
    that of reading and writing alone.
    """

    control_id: int
    name: str
    kind: int
    minimum: int
    maximum: int
    value: int
    step: int = 1
    menu: dict[int, str] = field(default_factory=dict)
    off_unless: tuple[int, int] | None = None
    broken: int = 0
    stalled: int = 0


def webcam_controls() -> list[FakeControl]:
    """Controls of a typical USB camera, all automatic at first."""
    modes = {1: "Manual Mode", 3: "Aperture Priority Mode"}
    return [
        FakeControl(CID_AUTOGAIN, "Gain, Automatic", BOOLEAN, 0, 1, 1),
        FakeControl(CID_GAIN, "Gain", INTEGER, 0, 255, 16, off_unless=(CID_AUTOGAIN, 0)),
        FakeControl(CID_EXPOSURE_AUTO, "Auto Exposure", MENU, 0, 3, 3, menu=modes),
        FakeControl(
            CID_EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", INTEGER, 1, 5000, 100,
            off_unless=(CID_EXPOSURE_AUTO, 1),
        ),
        FakeControl(CID_EXPOSURE_AUTO_PRIORITY, "Exposure, Dynamic Framerate", BOOLEAN, 0, 1, 1),
        FakeControl(
            CID_FOCUS_ABSOLUTE, "Focus, Absolute", INTEGER, 0, 250, 20,
            off_unless=(CID_FOCUS_AUTO, 0),
        ),
        FakeControl(CID_FOCUS_AUTO, "Focus, Automatic Continuous", BOOLEAN, 0, 1, 1),
    ]  # fmt: skip


@dataclass
class UvcClockModel:
    """The clock inside a USB camera and the way of its payloads to the host.

    Attributes:
        frequency_hz: Nominal, as its descriptors say.
        skew_ppm: It runs fast by this.
        delay_floor_ns: Least time from reading the clock to the host's stamp of the payload.
        delay_mean_ns: Mean of the exponential delay on top.
        scatter_ns: Extra error of the clock readings, one sigma (a camera with bad readings).
        states_frequency: The descriptors hold the frequency.
    """

    frequency_hz: float = 48e6
    skew_ppm: float = 37.0
    delay_floor_ns: int = 15_000
    delay_mean_ns: int = 300_000
    scatter_ns: float = 0.0
    states_frequency: bool = True

    def ticks(self, t_ns: float) -> int:
        """Reading of the clock at host time `t_ns`, 32 bit."""
        return int(t_ns * 1e-9 * self.frequency_hz * (1 + 1e-6 * self.skew_ppm)) & 0xFFFFFFFF


@dataclass(frozen=True)
class FrameTruth:
    """What really happened: when frame `number` was exposed, and what the driver stamped."""

    number: int
    t_start_ns: int
    exposure_ns: int
    t_mid_ns: int
    t_stamp_ns: int
    t_ready_ns: int


@dataclass
class FakeCamera:
    """One camera.

    Attributes:
        formats: Four-character code -> {(width, height): rates}.
        stamps: What the driver stamps: "soe", "eof" or "first-packet".
        flags: Time-stamp flags of its buffers; None: MONOTONIC with the anchor of `stamps`.
        faults: Frame number -> "empty", "flagged", "short", "lost" (the driver counts it), "kept" (it never
            leaves the camera, and the driver does not know of it) or "unplug".
        stamp_offset_ns: Added to the stamps (another clock).
        static: Pictures do not change but for their number: costs no time, for benchmarks.
    """

    name: str = "Fake Cam: Fake Cam"
    driver: str = "vical_fake"
    serial_number: str = "SN0001"
    port: str = "1-1"
    formats: dict[str, dict[tuple[int, int], tuple[float, ...]]] = field(
        default_factory=lambda: {"GREY": {(640, 480): (30.0, 60.0), (1280, 1024): (30.0, 60.0)}}
    )
    controls: list[FakeControl] = field(default_factory=webcam_controls)
    stamps: str = "eof"
    flags: int | None = None
    readout_ns: int = 8_000_000
    rolling: bool = False
    transfer_ns: int = 400_000
    uvc: UvcClockModel | None = None
    picture: Picture | None = None
    faults: dict[int, str] = field(default_factory=dict)
    stamp_offset_ns: int = 0
    static: bool = False
    open_errno: int = 0
    request_errno: dict[int, int] = field(default_factory=dict)
    max_buffers: int = 32
    seed: int = 1

    def __post_init__(self) -> None:
        self.pixel_format = next(iter(self.formats))
        self.width, self.height = next(iter(self.formats[self.pixel_format]))
        self.rate_hz = self.formats[self.pixel_format][self.width, self.height][0]
        self.truth: list[FrameTruth] = []
        self._rng = np.random.default_rng(self.seed)
        self._exposures: list[tuple[int, int]] = [(0, self.exposure_ns)]
        self._cache: dict[tuple[str, int, int], Bytes] = {}

    def control(self, control_id: int) -> FakeControl | None:
        """Return a control by its number."""
        return next((c for c in self.controls if c.control_id == control_id), None)

    @property
    def exposure_ns(self) -> int:
        """Exposure set now, ns; 5 ms for a camera without the control."""
        control = self.control(CID_EXPOSURE_ABSOLUTE)
        return 5_000_000 if control is None else control.value * 100_000

    def note_control(self, t_ns: int) -> None:
        """Remember that the exposure may have changed now."""
        self._exposures.append((t_ns, self.exposure_ns))

    @property
    def image_bytes(self) -> int:
        """Size of a buffer."""
        per_pixel = {"YUYV": 2, "UYVY": 2, "Y16": 2, "BGR3": 3, "RGB3": 3}.get(self.pixel_format, 1)
        return self.stride * self.height if per_pixel else self.width * self.height

    @property
    def stride(self) -> int:
        """Bytes per row."""
        wide = {"YUYV": 2, "UYVY": 2, "Y16": 2, "BGR3": 3, "RGB3": 3, "MJPG": 0}
        return self.width * wide.get(self.pixel_format, 1) or self.width

    def frame(self, number: int, t_on_ns: int) -> FrameTruth:
        """Expose frame `number` of a stream that was started at `t_on_ns`."""
        t_start_ns = t_on_ns + round(number * 1e9 / self.rate_hz)
        exposure_ns = next(e for t, e in reversed(self._exposures) if t <= t_start_ns)
        t_end_ns = t_start_ns + exposure_ns
        t_mid_ns = t_start_ns + exposure_ns // 2 + (self.readout_ns // 2 if self.rolling else 0)
        t_eof_ns = t_end_ns + self.readout_ns
        delay_ns = 0
        if self.uvc is not None:
            delay_ns = self.uvc.delay_floor_ns + round(self._rng.exponential(self.uvc.delay_mean_ns))
        stamp = {"soe": t_start_ns, "eof": t_eof_ns, "first-packet": t_end_ns + delay_ns}[self.stamps]
        ready_ns = t_eof_ns + self.transfer_ns + delay_ns
        # a struct timeval holds whole microseconds
        t_stamp_ns = (stamp + self.stamp_offset_ns) // 1000 * 1000
        return FrameTruth(number, t_start_ns, exposure_ns, t_mid_ns, t_stamp_ns, ready_ns)

    def time_flags(self) -> int:
        """Time-stamp flags of a buffer."""
        if self.flags is not None:
            return self.flags
        return 0x2000 | (0x10000 if self.stamps in ("soe", "first-packet") else 0)

    def fill(self, number: int, memory: Bytes) -> int:
        """Write the picture of a frame into a buffer; returns the bytes used."""
        if self.picture is not None:
            data = self.picture(number, self.pixel_format, self.width, self.height)
            memory[: data.size] = data
            return int(data.size)
        key = (self.pixel_format, self.width, self.height)
        if key not in self._cache:
            self._cache[key] = (np.arange(self.image_bytes, dtype=np.uint32) % 251).astype(np.uint8)
        if not self.static:
            memory[: self.image_bytes] = self._cache[key]
        memory[:4] = np.frombuffer(struct.pack("<I", number), dtype=np.uint8)
        return self.image_bytes

    def metadata(self, truth: FrameTruth, *, payloads: int = 6) -> bytes:
        """Return the UVCH metadata of a frame: one entry a payload, spread over the read-out."""
        if self.uvc is None:
            return b""
        clock, entries = self.uvc, []
        pts = clock.ticks(truth.t_start_ns)
        t_end_ns = truth.t_start_ns + truth.exposure_ns
        for k in range(payloads):
            t_sent_ns = t_end_ns + (k * self.readout_ns) // payloads
            read_ns = t_sent_ns + self._rng.normal(0.0, clock.scatter_ns)
            t_host_ns = t_sent_ns + clock.delay_floor_ns + round(self._rng.exponential(clock.delay_mean_ns))
            sof = (t_sent_ns // 1_000_000) & 0x7FF
            header = struct.pack("<BBIIH", 12, 0x8C, pts, clock.ticks(read_ns), sof)
            host = struct.pack("<QH", t_host_ns + self.stamp_offset_ns, (t_host_ns // 1_000_000) & 0x7FF)
            entries.append(host + header)
        return b"".join(entries)

    def usb_descriptors(self) -> bytes:
        """Device and VideoControl descriptors as sysfs shows them."""
        device = bytes([18, 1]) + bytes(16)
        interface = bytes([9, 4, 0, 0, 1, 0x0E, 0x01, 0, 0])
        frequency = round(self.uvc.frequency_hz) if self.uvc and self.uvc.states_frequency else 0
        header = struct.pack("<BBBHHIBB", 13, 0x24, 0x01, 0x0100, 13, frequency, 1, 1)
        return device + interface + header
