"""How often rules of the calibration without a board change a decision: `benchmarks ablation --firing`.

A rule that never changes one on some data brings nothing there, and need not be taken away to know it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any
from unittest.mock import patch

from vical_daemon.estimation.smoother import target_free_status
from vical_daemon.estimation.smoother.alternative_models import AlternativeModels
from vical_daemon.estimation.smoother.target_free_status import TargetFreeStatus


def _fired(counts: Counter[str]) -> list[tuple[Any, str, Callable[[Any], Any]]]:
    def excess(old: Any) -> Any:
        @wraps(old)
        def new(self: Any, square: float, dof: int) -> float:
            result = float(old(self, square, dof))
            strict = result * (50.0 if self._windows < target_free_status._LEARNING else 1.0)
            counts["tolerant at first"] += result <= 1.0 < strict
            return result

        return new

    def fits(old: Any) -> Any:
        @wraps(old)
        def new(self: Any, fit: Any, **how: Any) -> bool:
            result = bool(old(self, fit, **how))
            counts["windows fit, links"] += self.misfit[0] is target_free_status.Cause.INERTIAL_MISFIT
            return result

        return new

    def reported(old: Any) -> Any:
        @wraps(old)
        def new(self: Any) -> float:
            result = float(old(self))
            counts["scatter before two windows"] += result > self.factor()
            return result

        return new

    def weighed(old: Any) -> Any:
        @wraps(old)
        def new(self: Any, carry: Any, factor: float, compared: bool) -> Any:
            weights = self._weights(carry, factor)
            counts["imu before comparison"] += not compared and weights[max(weights, key=len)] < 0.5
            return old(self, carry, factor, compared)

        return new

    return [
        (TargetFreeStatus, "excess", excess),
        (TargetFreeStatus, "fits", fits),
        (TargetFreeStatus, "_reported_factor", reported),
        (AlternativeModels, "weighed", weighed),
    ]


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Count, while the estimation runs as it is, how often each rule changes what it decides on."""
    counts: Counter[str] = Counter()
    with ExitStack() as stack:
        for owner, name, make in _fired(counts):
            stack.enter_context(patch.object(owner, name, make(getattr(owner, name))))
        yield counts
