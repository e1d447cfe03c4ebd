"""What a V4L2 driver's stamp is worth: its clock and its anchor."""

from __future__ import annotations

from vical_drivers.camera.stamps import SIGMA_NS, Anchor, RawStamp
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.node import DequeuedBuffer
from vical_drivers.host_clocks import HostClocks

PLAUSIBLE_NS = 10_000_000_000
"""A stamp further than this from a clock's now is not of that clock, unless it goes on from the one before:
then its image waited in the ring while this process was stopped."""
_CLEARLY_NS = 100_000_000
"""A stamp is of another clock than CLOCK_MONOTONIC if it is then nearer to its arrival by this. A suspension
takes longer; readings of two clocks fit within 20 us (`host_clocks`)."""


def kernel_stamp(
    buffer: DequeuedBuffer,
    *,
    driver: str,
    now: HostClocks,
    forced: str = "auto",
    uvc_hwtimestamps: bool = False,
    before_ns: int | None = None,
) -> RawStamp:
    """Read the kernel's stamp with its flags.

    A stamp of CLOCK_MONOTONIC is carried through unchanged. One of CLOCK_REALTIME (uvcvideo with
    ``clock=REALTIME`` sets the same flag) or of CLOCK_BOOTTIME (drivers written for Android) is moved by the
    offset of the clocks now. Anything else is dated by its arrival. The uvcvideo driver always claims "start
    of exposure", but stamps the first packet that arrives: it is taken for that, unless its hwtimestamps=1
    is on (then it dates the capture by an interpolation of its own, which the rule names).

    Args:
        buffer: With stamp and flags.
        driver: Kernel driver.
        now: The clocks of the host at its arrival.
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
    found = _clock_of(buffer.t_ns, now, before_ns)
    if found is None:
        return RawStamp(now.monotonic_ns, Anchor.ARRIVAL, None, SIGMA_NS[Anchor.ARRIVAL])
    t_ns, clock = found
    if clock != "monotonic":
        origin = f"{anchor.value}({clock})"
    elif driver == "uvcvideo" and uvc_hwtimestamps:
        origin = f"{anchor.value}(hwtimestamps)"
    elif buffer.flags & abi.BUF_FLAG_TIMESTAMP_MASK != abi.BUF_FLAG_TIMESTAMP_MONOTONIC:
        origin = f"{anchor.value}(unflagged)"
    return RawStamp(t_ns, anchor, origin, SIGMA_NS[anchor])


def to_monotonic_ns(t_ns: int, now: HostClocks, before_ns: int | None = None) -> int | None:
    """Return a stamp of any clock on CLOCK_MONOTONIC; None where it is of none of them.

    Args:
        t_ns: The stamp.
        now: The clocks of the host.
        before_ns: The stamp before it from the same ring, CLOCK_MONOTONIC; None: there was none.
    """
    found = _clock_of(t_ns, now, before_ns)
    return None if found is None else found[0]


def _clock_of(t_ns: int, now: HostClocks, before_ns: int | None) -> tuple[int, str] | None:
    """Return a stamp on CLOCK_MONOTONIC and the name of its clock; None: no clock is near it.

    After a suspension CLOCK_BOOTTIME is ahead of CLOCK_MONOTONIC by its length, and a stamp of it looks like
    one from the future. So the clock by which a stamp is nearest to its arrival counts.
    """
    here_ns = now.monotonic_ns
    oldest_ns = here_ns - PLAUSIBLE_NS
    if before_ns is not None:
        oldest_ns = min(oldest_ns, before_ns)
    clocks = (
        ("monotonic", t_ns, 0),
        ("realtime", t_ns - (now.realtime_ns - here_ns), _CLEARLY_NS),
        ("boottime", t_ns - (now.boottime_ns - here_ns), _CLEARLY_NS),
    )
    near = [
        (abs(here_ns - moved_ns) + handicap_ns, moved_ns, name)
        for name, moved_ns, handicap_ns in clocks
        if oldest_ns <= moved_ns <= here_ns + PLAUSIBLE_NS
        and (name != "realtime" or _in_order(moved_ns, here_ns, before_ns))
    ]
    return min(near)[1:] if near else None


def _in_order(t_ns: int, here_ns: int, before_ns: int | None) -> bool:
    """Whether a stamp lies between the one before it and now: if not, the wall clock was set after it."""
    return (before_ns is None or t_ns > before_ns - _CLEARLY_NS) and t_ns < here_ns + _CLEARLY_NS
