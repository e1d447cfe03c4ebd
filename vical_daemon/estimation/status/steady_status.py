"""The status as it is published: what the evaluators decide, without flicker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from vical_daemon.estimation.guidance import Guidance, WeakDirection
from vical_daemon.estimation.result import Status

_STANDS_S = 2.0
"""For so long the data must speak against a converged calibration before it is called converging again, s of
data: twice the second over which noise moves what the evaluators look at."""
_HYSTERESIS = 2.0
"""Sigma over its limit up to which a direction that was known well enough still is."""
CONFIRMING = "sigmas are small; waiting for more data to confirm them"


class Verdict(NamedTuple):
    """Where a calibration stands by the data up to now.

    Attributes:
        status: Where.
        reason: Why, as text.
        guidance: What to do next.
        against_s: For how long the data speak against a converged calibration already, s of data.
    """

    status: Status
    reason: str = ""
    guidance: Guidance = Guidance()
    against_s: float = 0.0


@dataclass(slots=True)
class SteadyStatus:
    """Follows the verdicts; a converged calibration stays so over a short doubt and a slightly larger sigma.

    Only the step from converged back to converging waits. A contradiction, a lost direction or a changed rig
    shows at once.

    Attributes:
        status: As published last.
    """

    status: Status = Status.WAITING
    _doubted_s: float | None = None

    def reset(self, status: Status) -> None:
        """The rig is not what it was."""
        self.status, self._doubted_s = status, None

    def counted(self, weak: list[WeakDirection]) -> list[WeakDirection]:
        """Return those of the directions above their limits that speak against convergence."""
        if self.status is not Status.CONVERGED:
            return weak
        return [direction for direction in weak if direction.excess > _HYSTERESIS]

    def follow(self, verdict: Verdict, now_s: float) -> Verdict:
        """Return what is to be published.

        Args:
            verdict: By the data up to now.
            now_s: Time of the data, s.
        """
        if self.status is Status.CONVERGED and verdict.status is Status.CONVERGING:
            if self._doubted_s is None:
                self._doubted_s = now_s - verdict.against_s
            if now_s - self._doubted_s < _STANDS_S:
                return Verdict(Status.CONVERGED)
        self.reset(verdict.status)
        return verdict
