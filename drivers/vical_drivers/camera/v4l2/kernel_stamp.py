"""What a V4L2 driver's stamp is worth: its clock and its anchor."""

from __future__ import annotations

from vical_drivers.camera.stamps import SIGMA_NS, Anchor, RawStamp
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.node import DequeuedBuffer

PLAUSIBLE_NS = 10_000_000_000
"""A stamp further than this from a clock's now is not of that clock, unless it goes on from the one before:
then its image waited in the ring while this process was stopped."""


def kernel_stamp(
    buffer: DequeuedBuffer,
    *,
    driver: str,
    monotonic_ns: int,
    realtime_ns: int,
    forced: str = "auto",
    uvc_hwtimestamps: bool = False,
    before_ns: int | None = None,
) -> RawStamp:
    """Read the kernel's stamp with its flags.

    A stamp of CLOCK_MONOTONIC is carried through unchanged. One of CLOCK_REALTIME (uvcvideo with
    ``clock=REALTIME`` sets the same flag) is moved by the offset of the clocks now. Anything else is
    dated by its arrival. The uvcvideo driver always claims "start of exposure", but stamps the first
    packet that arrives: it is taken for that, unless its hwtimestamps=1 is on (then it dates the capture by
    an interpolation of its own, which the rule names).

    Args:
        buffer: With stamp and flags.
        driver: Kernel driver.
        monotonic_ns: Now.
        realtime_ns: Now.
        forced: `CameraSettings.stamp`: overrides the anchor.
        uvc_hwtimestamps: Parameter of the uvcvideo module.
        before_ns: See `to_monotonic_ns`.
    """
    start_of_exposure = buffer.flags & abi.BUF_FLAG_TSTAMP_SRC_MASK == abi.BUF_FLAG_TSTAMP_SRC_SOE
    anchor = Anchor.START_OF_EXPOSURE if start_of_exposure else Anchor.END_OF_FRAME
    if driver == "uvcvideo" and not uvc_hwtimestamps:
        anchor = Anchor.FIRST_PACKET
    if forced not in ("auto", "raw"):
        anchor = Anchor(forced)
    origin = None
    t_ns = to_monotonic_ns(buffer.t_ns, monotonic_ns, realtime_ns, before_ns)
    if t_ns is None:
        return RawStamp(monotonic_ns, Anchor.ARRIVAL, None, SIGMA_NS[Anchor.ARRIVAL])
    if t_ns != buffer.t_ns:
        origin = f"{anchor.value}(realtime)"
    elif driver == "uvcvideo" and uvc_hwtimestamps:
        origin = f"{anchor.value}(hwtimestamps)"
    elif buffer.flags & abi.BUF_FLAG_TIMESTAMP_MASK != abi.BUF_FLAG_TIMESTAMP_MONOTONIC:
        origin = f"{anchor.value}(unflagged)"
    return RawStamp(t_ns, anchor, origin, SIGMA_NS[anchor])


def to_monotonic_ns(
    t_ns: int, monotonic_ns: int, realtime_ns: int, before_ns: int | None = None
) -> int | None:
    """Return a stamp of either clock on CLOCK_MONOTONIC; None where it is of neither.

    Args:
        t_ns: The stamp.
        monotonic_ns: Now.
        realtime_ns: Now.
        before_ns: The stamp before it from the same ring, CLOCK_MONOTONIC; None: there was none.
    """
    oldest_ns = monotonic_ns - PLAUSIBLE_NS
    if before_ns is not None:
        oldest_ns = min(oldest_ns, before_ns)
    for moved_ns in (t_ns, t_ns - (realtime_ns - monotonic_ns)):
        if oldest_ns <= moved_ns <= monotonic_ns + PLAUSIBLE_NS:
            return moved_ns
    return None
