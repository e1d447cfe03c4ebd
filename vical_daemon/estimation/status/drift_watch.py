"""Notices that a parameter taken as constant is not: two estimates of the same filter, some time apart.

For a consistent filter the later estimate is the earlier one plus news, and the variance of their difference
is P_earlier - P_later. A difference far outside it means that the parameter moved (a clock whose rate
changes), however small the filter believes its error to be. [Hausman, 1978, applied to a filter]
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.significance import EVERY_S, PERHAPS_SIGMAS, SURE_SIGMAS

_SPAN = 20


@dataclass(slots=True)
class DriftWatch:
    """Watches one scalar parameter.

    Attributes:
        floor: Smallest standard deviation of a difference that is taken seriously, in the parameter's unit.
        doubtful: The last estimate lies further off than chance would have it, though not yet surely.
    """

    floor: float
    doubtful: bool = False
    _past: deque[tuple[float, float, float]] = field(default_factory=lambda: deque(maxlen=_SPAN))

    def due(self, t_s: float) -> bool:
        """Whether it is time for the next estimate; more would only be more of the same."""
        return not self._past or t_s >= self._past[-1][0] + EVERY_S

    def drifts(self, t_s: float, value: float, variance: float, factor: float, walk: float = 0.0) -> bool:
        """Take the estimate at `t_s`; True when it has left where an earlier one said it would be.

        Args:
            t_s: Time of the estimate, s.
            value: Estimate.
            variance: The filter's own.
            factor: Measured correlation factor (`Consistency.factor`), widens the test.
            walk: Variance that the parameter may gain in a second.
        """
        if not self.due(t_s):
            return False
        far = max(
            (
                abs(value - old)
                / np.sqrt(factor * max(old_variance + walk * (t_s - at_s) - variance, 0.0) + self.floor**2)
                for at_s, old, old_variance in self._past
            ),
            default=0.0,
        )
        self._past.append((t_s, value, variance))
        self.doubtful = bool(far > PERHAPS_SIGMAS)
        return bool(far > SURE_SIGMAS)
