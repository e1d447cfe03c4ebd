"""Frames that a source did not deliver: by its own numbers, and by its stamps. Pure arithmetic."""

from __future__ import annotations

from collections import deque
from statistics import fmean, median


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
