"""With the lens held: is the target as it is stated? It may as well be the lens that is not this camera's.

Stretches of the data (see `stretches`) are asked for the shape, whatever the poses; where it is there beyond
doubt, that is told, and nothing else. With the lens estimated the shape is among the states (see
`hypotheses`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.target_modes import TargetModes
from vical_daemon.estimation.noise.block_jackknife import Stretches

_STRETCH_S = 3.0
_BEYOND_DOUBT = 5.0  # sigmas of any mode; clean data reach three in ten minutes
_WEAK = 0.02  # of half the target's side: as good as nothing known
_EVERY_S = 0.2  # images closer together see the same


@dataclass(slots=True)
class TargetDoubt:
    """Running doubt of one camera about the target.

    Args:
        modes: The ways in which the target may be off.

    Attributes:
        off_m: How far the target's edges are off in each mode, m, shape (11,), where that is beyond doubt;
            None: as far as one can tell it is as stated.
    """

    modes: TargetModes
    off_m: FloatArray | None = None
    _stretches: Stretches = field(default_factory=lambda: Stretches(_STRETCH_S))
    _next_s: float = -np.inf

    def due(self, t_s: float) -> bool:
        """Whether an image so soon after the last one would tell anything new."""
        return t_s >= self._next_s

    def learn(self, t_s: float, innovation: FloatArray, by_pose: FloatArray, by_shape: FloatArray) -> None:
        """Take in one image before it is used.

        Args:
            t_s: Its instant, s.
            innovation: Measured minus predicted, over the corner noise, shape (2k,).
            by_pose: Derivatives of the whitened pixels by attitude and position, shape (2k, 6).
            by_shape: By the modes, shape (2k, 11).
        """
        self._next_s = t_s + _EVERY_S
        modes = by_shape.shape[1]
        if not self._stretches.learn(t_s, innovation, by_pose, by_shape, np.zeros(modes)):
            return
        told = self._stretches.compared(np.full(modes, _WEAK * self.modes.half_m))
        z = np.abs(told.values) / np.sqrt(told.factors * np.diag(told.covariance))
        self.off_m = told.values if z.max() > _BEYOND_DOUBT else None


def announcement(doubts: dict[str, TargetDoubt]) -> Event | None:
    """What is to be announced, once: then the cameras' doubts are forgotten. None while there is nothing."""
    off_m = [float(np.abs(d.off_m).max()) for d in doubts.values() if d.off_m is not None]
    if not off_m:
        return None
    doubts.clear()
    return Event(EventKind.TARGET_OR_LENS, value=max(off_m))
