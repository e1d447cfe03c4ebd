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

from collections import deque
from dataclasses import dataclass
from enum import Enum
from statistics import fmean, median


class Anchor(Enum):
    """The instant that a raw stamp marks; the value is its short name in stamp rules."""

    START_OF_EXPOSURE = "soe"
    END_OF_FRAME = "eof"
    FIRST_PACKET = "first-packet"
    SHUTTER_CLOSED = "shutter-closed"
    ARRIVAL = "arrival"


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


class SequenceCounter:
    """Counts the frames that a source's own numbers say are missing.

    Args:
        bits: Width of the number.
        skips_zero: The number goes from its highest value to 1 (GigE Vision's 16-bit frame id).
    """

    def __init__(self, bits: int = 32, *, skips_zero: bool = False) -> None:
        self._modulus = 1 << bits
        self._skips_zero = skips_zero
        self._last: int | None = None

    def restart(self) -> None:
        """Forget the last number: the source was opened anew."""
        self._last = None

    def missing_before(self, number: int) -> int:
        """Take the next number and return how many were skipped; 0 at the start or after a restart.

        A step back by more than half the range is a source that began to count anew, not a loss.
        """
        last, self._last = self._last, number
        if last is None:
            return 0
        step = (number - last) % self._modulus
        if self._skips_zero and number < last:
            step -= 1
        return step - 1 if 1 <= step < self._modulus // 2 else 0


class StampGaps:
    """Counts the frames that are missing without a gap in the source's numbers: they never left the camera.

    The numbers of a V4L2 driver count what it received. What a camera or its cable loses before shows in the
    stamps alone: a longer step, and then the old pace again. A step that is only late (its successor comes
    early) and a pace that changes (a longer automatic exposure) are no losses. So the answer comes with the
    first frame that keeps the old pace again, one frame after the gap.
    """

    LEARNED = 5
    """Steps that make a pace: their median bears two losses."""
    KEPT = 60
    """Steps whose mean is the pace: two seconds at 30 Hz follow a slow change of the exposure."""
    GAP = 0.5
    """A step is a gap when it differs from what its frames take by more than this part of a period."""
    PACE = 0.3
    """A step within this part of a period keeps the pace."""
    PATIENCE = 4
    """So many steps in a row at another pace are another pace."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget pace and stamps: the source was opened anew."""
        self._t_last_ns: int | None = None
        self._begin_pace()

    def _begin_pace(self) -> None:
        self._paces_ns: deque[float] = deque(maxlen=self.KEPT)
        self._learned = False
        self._begin_run()

    def _begin_run(self) -> None:
        self._odd_ns = self._odd_frames = self._odd_steps = 0

    def found(self, t_ns: int, missing_before: int = 0) -> int:
        """Take the next frame; return how many losses in the steps before it are now certain.

        Args:
            t_ns: Its stamp, on a clock that nobody sets, ns.
            missing_before: Frames missing before it by the source's own numbers: they are known already.
        """
        last_ns, self._t_last_ns = self._t_last_ns, t_ns
        if last_ns is None:
            return 0
        step_ns, frames = t_ns - last_ns, 1 + missing_before
        pace_ns = step_ns / frames
        if not self._learned:
            self._learn(pace_ns)
            return 0
        usual_ns = fmean(self._paces_ns)
        off = abs(step_ns / usual_ns - frames)
        if not self._odd_steps and off <= self.GAP:
            self._paces_ns.append(pace_ns)
            return 0
        self._odd_ns += step_ns
        self._odd_frames += frames
        self._odd_steps += 1
        if off <= self.PACE:
            missing = round(self._odd_ns / usual_ns) - self._odd_frames
            self._begin_run()
            return max(0, missing)
        if self._odd_steps > self.PATIENCE:
            self._begin_pace()
        return 0

    def _learn(self, pace_ns: float) -> None:
        self._paces_ns.append(pace_ns)
        if len(self._paces_ns) < self.LEARNED:
            return
        usual_ns = median(self._paces_ns)
        near = [p for p in self._paces_ns if usual_ns > 0 and abs(p / usual_ns - 1.0) <= self.PACE]
        if len(near) > self.LEARNED // 2:
            self._paces_ns, self._learned = deque(near, maxlen=self.KEPT), True
        else:
            self._paces_ns.popleft()
