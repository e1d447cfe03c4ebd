"""What a V4L2 driver's stamp is worth: its clock, its anchor, and the exposure in force."""

from __future__ import annotations

from dataclasses import dataclass

from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.stamps import Anchor, ExposureStamp, exposure_middle
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.node import DequeuedBuffer

PLAUSIBLE_NS = 10_000_000_000
"""A stamp further than this from a clock's now is not of that clock."""

SIGMA_NS = {
    Anchor.START_OF_EXPOSURE: 50_000,
    Anchor.END_OF_FRAME: 50_000,
    Anchor.SHUTTER_CLOSED: 50_000,
    Anchor.FIRST_PACKET: 2_000_000,
    Anchor.ARRIVAL: 5_000_000,
}
"""One sigma of a raw stamp by its anchor: interrupt latency; USB scheduling; process scheduling."""


@dataclass(frozen=True, slots=True)
class RawStamp:
    """A driver's stamp, understood.

    Attributes:
        t_raw_ns: CLOCK_MONOTONIC, ns.
        anchor: The instant it marks.
        origin: Name for the stamp rule where it is not the anchor's; None: the anchor's.
        t_sigma_ns: One sigma, ns.
    """

    t_raw_ns: int
    anchor: Anchor
    origin: str | None
    t_sigma_ns: int


def kernel_stamp(
    buffer: DequeuedBuffer,
    *,
    driver: str,
    monotonic_ns: int,
    realtime_ns: int,
    forced: str = "auto",
    uvc_hwtimestamps: bool = False,
) -> RawStamp:
    """Read the kernel's stamp with its flags.

    A stamp of CLOCK_MONOTONIC is carried through unchanged. One of CLOCK_REALTIME (uvcvideo with
    ``clock=REALTIME`` sets the same flag) is moved by the offset of the clocks now. Anything else is
    dated by its arrival. The uvcvideo driver always claims "start of exposure", but stamps the first
    packet that arrives: it is taken for that, unless its hwtimestamps=1 is on (then it dates the capture by
    an interpolation of its own, and the rule says so).

    Args:
        buffer: With stamp and flags.
        driver: Kernel driver.
        monotonic_ns: Now.
        realtime_ns: Now.
        forced: `CameraSettings.stamp`: overrides the anchor.
        uvc_hwtimestamps: Parameter of the uvcvideo module.
    """
    start_of_exposure = buffer.flags & abi.BUF_FLAG_TSTAMP_SRC_MASK == abi.BUF_FLAG_TSTAMP_SRC_SOE
    anchor = Anchor.START_OF_EXPOSURE if start_of_exposure else Anchor.END_OF_FRAME
    if driver == "uvcvideo" and not uvc_hwtimestamps:
        anchor = Anchor.FIRST_PACKET
    if forced not in ("auto", "raw"):
        anchor = Anchor(forced)
    origin = None
    t_ns = to_monotonic_ns(buffer.t_ns, monotonic_ns, realtime_ns)
    if t_ns is None:
        return RawStamp(monotonic_ns, Anchor.ARRIVAL, None, SIGMA_NS[Anchor.ARRIVAL])
    if t_ns != buffer.t_ns:
        origin = f"{anchor.value}(realtime)"
    elif driver == "uvcvideo" and uvc_hwtimestamps:
        origin = f"{anchor.value}(hwtimestamps)"
    elif buffer.flags & abi.BUF_FLAG_TIMESTAMP_MASK != abi.BUF_FLAG_TIMESTAMP_MONOTONIC:
        origin = f"{anchor.value}(unflagged)"
    return RawStamp(t_ns, anchor, origin, SIGMA_NS[anchor])


def to_monotonic_ns(t_ns: int, monotonic_ns: int, realtime_ns: int) -> int | None:
    """Return a recent stamp of either clock on CLOCK_MONOTONIC; None where it is of neither.

    Args:
        t_ns: The stamp.
        monotonic_ns: Now.
        realtime_ns: Now.
    """
    if abs(monotonic_ns - t_ns) <= PLAUSIBLE_NS:
        return t_ns
    if abs(realtime_ns - t_ns) <= PLAUSIBLE_NS:
        return t_ns - (realtime_ns - monotonic_ns)
    return None


class ExposureStamper:
    """Moves raw stamps to the middle of the exposure that was in force.

    Args:
        settings: Shutter, assumed exposure, and whether stamps stay raw.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self._shutter = settings.shutter
        self._raw = settings.stamp == "raw"
        assumed = settings.assume_exposure_s
        self._assumed_ns = None if assumed is None else round(assumed * 1e9)
        self._exposure_ns: int | None = None
        self._before_ns: int | None = None
        self._changed_ns = 0

    @property
    def exposure_ns(self) -> int | None:
        """Exposure in force now, ns; None where unknown."""
        return self._exposure_ns if self._exposure_ns is not None else self._assumed_ns

    def set_exposure(self, exposure_ns: int | None, t_set_ns: int) -> None:
        """Take a new exposure; frames that began to expose before `t_set_ns` keep the old one."""
        if exposure_ns == self._exposure_ns:
            return
        self._before_ns, self._exposure_ns = self.exposure_ns, exposure_ns
        self._changed_ns = t_set_ns

    def stamp(self, raw: RawStamp) -> tuple[ExposureStamp, int | None]:
        """Return the stamp of the middle of the exposure, and the exposure it was made with, ns."""
        exposure_ns = self.exposure_ns
        made = self._with(raw, exposure_ns)
        if exposure_ns is not None and made.t_exposure_mid_ns - exposure_ns // 2 < self._changed_ns:
            exposure_ns = self._before_ns
            made = self._with(raw, exposure_ns)
        return made, exposure_ns

    def _with(self, raw: RawStamp, exposure_ns: int | None) -> ExposureStamp:
        used = None if self._raw else exposure_ns
        return exposure_middle(raw.t_raw_ns, raw.anchor, used, self._shutter, origin=raw.origin)
