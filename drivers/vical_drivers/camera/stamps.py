"""From what a driver stamps to the middle of the exposure: pure integer arithmetic.

Let e be the exposure and r the readout (first row to last row). A *global* shutter exposes all rows at
once and then reads them out; a *rolling* shutter starts row after row, and the frame is dated by its
middle row, so that row k of H lies at t + (k/(H-1) - 1/2) r.

| anchor of the raw stamp | global shutter | rolling shutter |
|---|---|---|
| START_OF_EXPOSURE (first row) | t + e/2 | t + e/2 + r/2 |
| END_OF_FRAME (last row read out) | t - r - e/2 | t - r/2 - e/2 |
| FIRST_PACKET (first row leaves the camera) | t - e/2 | t - e/2 + r/2 |
| SHUTTER_CLOSED (end of the exposure) | t - e/2 | t - e/2 |

Without a known exposure nothing is corrected and the rule says "raw".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Anchor(Enum):
    """The instant that a raw stamp marks; the value is its short name in stamp rules."""

    START_OF_EXPOSURE = "soe"
    END_OF_FRAME = "eof"
    FIRST_PACKET = "first-packet"
    SHUTTER_CLOSED = "shutter-closed"
    ARRIVAL = "arrival"


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


@dataclass(frozen=True, slots=True)
class Shutter:
    """How the sensor exposes.

    Attributes:
        rolling: Rows start one after the other.
        readout_ns: First to last row, ns; 0 where unknown.
    """

    rolling: bool = False
    readout_ns: int = 0

    @property
    def row_spread_ns(self) -> int:
        """Time between the exposures of first and last row, ns: 0 for a global shutter."""
        return self.readout_ns if self.rolling else 0


@dataclass(frozen=True, slots=True)
class ExposureStamp:
    """A stamp and how it was made.

    Attributes:
        t_exposure_mid_ns: In the clock of the raw stamp, ns.
        rule: In words, e.g. "soe+exposure/2".
    """

    t_exposure_mid_ns: int
    rule: str


def exposure_middle(
    t_raw_ns: int,
    anchor: Anchor,
    exposure_ns: int | None,
    shutter: Shutter,
    *,
    origin: str | None = None,
) -> ExposureStamp:
    """Date the middle of the exposure (of the middle row), table at the top of this module.

    Args:
        t_raw_ns: What was stamped, ns, any clock.
        anchor: The instant it marks.
        exposure_ns: Exposure time, ns; None where unknown: the raw stamp is passed on.
        shutter: Kind of shutter and readout time.
        origin: Where the stamp came from, in place of the anchor's name in the rule ("uvc-pts").

    Returns:
        The stamp and its rule. Halves are exact for even figures, else rounded down.

    Example:
        >>> exposure_middle(1000, Anchor.END_OF_FRAME, 200, Shutter(readout_ns=300))
        ExposureStamp(t_exposure_mid_ns=600, rule='eof-readout-exposure/2')
    """
    name = origin or anchor.value
    if exposure_ns is None or anchor is Anchor.ARRIVAL:
        return ExposureStamp(t_raw_ns, f"raw-{name}")
    half, readout = exposure_ns // 2, shutter.readout_ns
    rolling = shutter.rolling and readout > 0
    if anchor is Anchor.START_OF_EXPOSURE:
        suffix = "+exposure/2+readout/2" if rolling else "+exposure/2"
        return ExposureStamp(t_raw_ns + half + (readout // 2 if rolling else 0), name + suffix)
    if anchor is Anchor.END_OF_FRAME:
        suffix = "-readout/2-exposure/2" if rolling else "-readout-exposure/2"
        return ExposureStamp(t_raw_ns - half - (readout // 2 if rolling else readout), name + suffix)
    if anchor is Anchor.FIRST_PACKET and rolling:
        return ExposureStamp(t_raw_ns - half + readout // 2, name + "-exposure/2+readout/2")
    return ExposureStamp(t_raw_ns - half, name + "-exposure/2")
