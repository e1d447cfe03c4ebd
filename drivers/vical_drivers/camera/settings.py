"""What is asked of a camera, the same for every kind of source."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from vical_drivers.camera.formats import ENCODINGS, ImageDecoder
from vical_drivers.camera.stamps import Anchor, Shutter
from vical_drivers.errors import DeviceRefusedError

HELD_UP_S = 0.25
MIN_BUFFERS, MAX_BUFFERS = 6, 32
STAMP_CHOICES = ("auto", "raw", *(a.value for a in Anchor if a is not Anchor.ARRIVAL))


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSettings:
    """Settings of one camera; None leaves a thing as the camera has it.

    Attributes:
        width: Pixels; given together with `height`.
        height: Pixels.
        rate_hz: Frames per second.
        pixel_format: What travels from the camera: a V4L2 four-character code, an IIDC coding
            (mono8, mono16, raw8) or a GenICam name; None: the cheapest that gives `encoding`.
        encoding: What frames hold: mono8, mono16 or bgr8.
        exposure_s: Exposure time, s; switches automatic exposure off.
        assume_exposure_s: Exposure time of a camera that cannot tell it, s; only dates frames.
        gain: In the camera's own unit (V4L2: raw number, IIDC and GenICam: dB); switches automatic
            gain off.
        controls: More controls by the camera's own names, written in this order.
        rolling_shutter: The sensor exposes row after row.
        readout_s: First to last row, s; 0: unknown or nothing to correct.
        stamp: "auto", "raw" (publish the driver's stamp as it is) or the anchor that the driver's stamp
            really marks: "soe", "eof", "first-packet", "shutter-closed".
        buffers: Kernel buffers asked for; None: enough for a quarter of a second.
        borrow: Frames show the kernel's memory and are valid only until the next `read`: one copy less.
        decoder: Decompressor for MJPG, PNG and JPEG.
    """

    width: int | None = None
    height: int | None = None
    rate_hz: float | None = None
    pixel_format: str | None = None
    encoding: str = "mono8"
    exposure_s: float | None = None
    assume_exposure_s: float | None = None
    gain: float | None = None
    controls: Mapping[str, float] = field(default_factory=dict)
    rolling_shutter: bool = False
    readout_s: float = 0.0
    stamp: str = "auto"
    buffers: int | None = None
    borrow: bool = False
    decoder: ImageDecoder | None = None

    def __post_init__(self) -> None:
        if (self.width is None) != (self.height is None):
            raise DeviceRefusedError("camera: give width and height together, or neither")
        if self.encoding not in ENCODINGS:
            raise DeviceRefusedError(f"camera: encoding {self.encoding!r} is none of {', '.join(ENCODINGS)}")
        if self.stamp not in STAMP_CHOICES:
            raise DeviceRefusedError(f"camera: stamp {self.stamp!r} is none of {', '.join(STAMP_CHOICES)}")
        for name in ("width", "height", "rate_hz", "exposure_s", "assume_exposure_s"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise DeviceRefusedError(f"camera: {name} = {value} must be above 0")
        if self.readout_s < 0 or (self.buffers is not None and self.buffers < 2):
            raise DeviceRefusedError("camera: readout_s must be at least 0 and buffers at least 2")

    def ring_size(self, rate_hz: float) -> int:
        """Return how many buffers to ask for at a frame rate: a process may be held up for so long."""
        if self.buffers is not None:
            return self.buffers
        return min(max(MIN_BUFFERS, math.ceil(HELD_UP_S * rate_hz)), MAX_BUFFERS)

    @property
    def shutter(self) -> Shutter:
        """How the sensor exposes."""
        return Shutter(rolling=self.rolling_shutter, readout_ns=round(self.readout_s * 1e9))
