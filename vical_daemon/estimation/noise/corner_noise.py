"""Corner noise, measured from what no state error can explain (the part of the residuals left by QR)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.robust import MEDIAN_RAYLEIGH, median
from vical_daemon.estimation.significance import PERHAPS_SIGMAS

POSE_DOF = 6  # degrees of freedom of an image that its pose takes up
_GUESS_DOF, _GUESS_FADES = 100.0, 300.0  # degrees of freedom
LEAST_PX, MOST_PX = 0.005, 20.0  # of a corner's noise: a simulation without any, a detector that guesses
_USUAL_DOF = 30.0
"""What the usual noise weighs against that of one image: 15 corners. With 10 or 100 it matters as little."""


def relative_noise(stated_px: FloatArray | None, n: int) -> FloatArray:
    """Noise of each corner of an image over their usual one, as the detector states it, shape (n,)."""
    if stated_px is None or not len(stated_px):
        return np.ones(n)
    return np.asarray(np.clip(stated_px / np.sqrt(np.mean(stated_px**2)), 0.3, 10.0))


def noise_of_image(rest: float, dof: float) -> float:
    """Noise of the corners of one image over the usual noise of its camera.

    Motion blurs images, and light and distance change: on EuRoC noise is 0.15 to 0.7 px. The usual noise
    is the mean of an inverse chi-square prior of the variance, and the result that of its posterior.
    [Gelman et al., "Bayesian data analysis", 3rd ed., section 2.6]

    Args:
        rest: Sum of squares, over the usual noise, of what no state error explains.
        dof: Its degrees of freedom.
    """
    return math.sqrt((_USUAL_DOF + rest) / (_USUAL_DOF + dof))


def median_noise(lengths: FloatArray, images: int = 1) -> float:
    """Noise of corners per axis by the median length of residuals, as far as poses have not taken them up.

    Args:
        lengths: Of the residuals of all images, shape (n,).
        images: How many.
    """
    share = max(1.0 - POSE_DOF * images / (2.0 * len(lengths)), 0.05)
    return median(lengths) / MEDIAN_RAYLEIGH / math.sqrt(share)


@dataclass(slots=True)
class CornerNoise:
    """Running estimate of the noise per axis of one camera's corners.

    The first guess weighs as much as one well-filled frame, and nothing after some more: corners fifty times
    better than it would otherwise never be believed. The estimate forgets slowly, so that a change of light
    or focus is followed within some hundred frames.

    Attributes:
        sigma_px: Present estimate, px.
        guess_px: First guess, px.
        memory: Degrees of freedom remembered.
    """

    guess_px: float
    memory: float = 60_000.0
    sigma_px: float = 0.0
    _sum: float = 0.0
    _dof: float = 0.0

    def __post_init__(self) -> None:
        self.sigma_px = self.guess_px

    def sigmas(self, stated_px: FloatArray | None, n: int) -> FloatArray:
        """Noise of each corner: the measured level, shared out by the detector's own weights."""
        return self.sigma_px * relative_noise(stated_px, n)

    def learn(self, whitened_rest: float, dof: int) -> None:
        """Take in the unexplained sum of squares of one frame (whitened by the present sigma)."""
        if dof < 4:
            return
        ratio = min(whitened_rest / dof, PERHAPS_SIGMAS**2)
        self._sum += ratio * dof * self.sigma_px**2
        self._dof += dof
        if self._dof > self.memory:
            keep = self.memory / self._dof
            self._sum *= keep
            self._dof *= keep
        guess = _GUESS_DOF * math.exp(-self._dof / _GUESS_FADES)
        square = (self._sum + guess * self.guess_px**2) / (self._dof + guess)
        self.sigma_px = min(max(math.sqrt(square), LEAST_PX), MOST_PX)
