"""Is the target as it is stated? If not, mounting and lens are taken for what they are not.

To estimate the shape of every target would cost accuracy where targets are true: the images show it only
beside the lens. So it is a hypothesis: stretches of the data (see `stretches`) are asked for lens and shape
together, whatever the poses, and only where the shape is there beyond doubt does the filter take it in.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.lens_agreement import lens_sigmas, with_next_power
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.stretches import Stretches
from vical_daemon.estimation.target_modes import TargetModes

_STRETCH_S = 3.0
_BEYOND_DOUBT = 5.0  # sigmas of any mode; clean data reach three in ten minutes
_SUSPECT = 3.5
_WEAK = 0.02  # of half the target's side: as good as nothing known
_EVERY_S = 0.2  # images closer together see the same


@dataclass(slots=True)
class TargetDoubt:
    """Running doubt of one camera about the target.

    Args:
        model: Distortion model.
        modes: The ways in which the target may be off.

    Attributes:
        off_m: How far the target's edges are off in each mode, m, shape (11,), where that is beyond doubt;
            None: as far as one can tell it is as stated.
        undecided: It is too early to tell, or a mode may be off.
    """

    model: str
    modes: TargetModes
    off_m: FloatArray | None = None
    undecided: bool = True
    _stretches: Stretches = field(default_factory=lambda: Stretches(_STRETCH_S))
    _next_s: float = -np.inf

    def due(self, t_s: float) -> bool:
        """Whether an image so soon after the last one would tell anything new."""
        return t_s >= self._next_s

    def learn(
        self,
        t_s: float,
        innovation: FloatArray,
        by_pose: FloatArray,
        by_lens: FloatArray,
        lens: FloatArray,
        by_shape: FloatArray,
    ) -> None:
        """Take in one image before it is used.

        Args:
            t_s: Its instant, s.
            innovation: Measured minus predicted, over the corner noise, shape (2k,).
            by_pose: Derivatives of the whitened pixels by attitude and position, shape (2k, 6).
            by_lens: By fx fy cx cy and the distortion, shape (2k, n); n = 0 where the lens is held.
            lens: Present values, shape (n,).
            by_shape: By the modes, shape (2k, 11).
        """
        self._next_s = t_s + _EVERY_S
        sigmas = np.full(by_shape.shape[1], _WEAK * self.modes.half_m)
        if len(lens):
            by_lens, lens = with_next_power(by_lens, self.model), np.append(lens, 0.0)
            sigmas = np.concatenate([lens_sigmas(lens[0], len(lens)), sigmas])
        by = np.column_stack([by_lens, by_shape])
        values = np.concatenate([lens, np.zeros(by_shape.shape[1])])
        if not self._stretches.learn(t_s, innovation, by_pose, by, values):
            return
        told = self._stretches.compared(sigmas)
        shape = slice(len(lens), None)
        off_m = told.values[shape]
        z = np.abs(off_m) / np.sqrt((told.factors * np.diag(told.covariance))[shape])
        self.off_m = off_m if z.max() > _BEYOND_DOUBT else None
        self.undecided = bool(z.max() > _SUSPECT)
