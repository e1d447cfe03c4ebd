"""Random errors of a camera's stamps, measured: each moves all corners of an image along their motion.

A stamp that is late by e shifts every corner by e times its speed in the image. From one image e is known as
well as corners and predicted pose are; how much it varies beyond that, over many images, is the jitter. It is
0 until it is significant, so that good stamps pay nothing. [docs/math/filter.md, eq. (12)]
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.measurements import FloatArray

_MEMORY = 400  # images
_LEAST = 20
_EVERY = 5  # images between two looks at all that is remembered
_SIGNIFICANT = 5.0  # standard deviations above what stamps without jitter would give
_CLIP = 36.0  # squared standard deviations: outliers are not jitter
_FLOOR_S = 2e-5
_ROUNDS = 8
_TOLD_S = 3e-4  # what to do about it is often a setting of the camera's driver


@dataclass(slots=True)
class StampJitter:
    """Running estimate of one camera.

    Attributes:
        sigma_s: Standard deviation of a stamp, s; 0 while it cannot be told from none.
        images: Images taken in.
    """

    sigma_s: float = 0.0
    images: int = 0
    _square: FloatArray = field(default_factory=lambda: np.zeros(_MEMORY))
    _usual: FloatArray = field(default_factory=lambda: np.zeros(_MEMORY))

    def learn(
        self, innovation: FloatArray, by_shift: FloatArray, state: FloatArray, level: float = 1.0
    ) -> None:
        """Take in one image before it is used.

        Args:
            innovation: Measured minus predicted, over the corner noise, shape (2n,).
            by_shift: Derivative of the whitened pixels by the time shift, 1/s, shape (2n,).
            state: `by_shift` times H S of the whitened pixels (what states add to the sum), shape (c,).
            level: By how much innovations of any kind exceed their variances: where the model does not fit,
                that along the motion of the corners is no jitter.
        """
        size = float(by_shift @ by_shift)
        if not size > 0.0:
            return
        part = state / size
        error = float(by_shift @ innovation) / size
        place = self.images % _MEMORY
        self._square[place] = error * error
        self._usual[place] = level * (1.0 / size + float(part @ part))
        self.images += 1
        if self.images >= _LEAST and self.images % _EVERY == 0:
            self.sigma_s = excess(self._square[: self.images], self._usual[: self.images])


def jitter_told(camera: str, jitter_s: float) -> str:
    """Announcement of a jitter; empty where it is too small to be worth a word."""
    if jitter_s < _TOLD_S:
        return ""
    return f"{camera}: the stamps of the images jitter by {1e3 * jitter_s:.1f} ms; allowed for"


def excess(square: FloatArray, usual: FloatArray) -> float:
    """Standard deviation, s, that squared errors show beyond their usual variances; 0 if by chance."""
    ratio = np.minimum(square / usual, _CLIP)
    if ratio.mean() < 1.0 + _SIGNIFICANT * np.sqrt(2.0 / len(ratio)):
        return 0.0
    # maximum likelihood by scoring; 0.455 is the median of a chi-square variable
    variance = max(float(np.median(square)) / 0.455 - float(np.median(usual)), 0.0)
    for _ in range(_ROUNDS):
        expected = usual + variance
        weight = expected**-2
        excess = np.minimum(square, _CLIP * expected) - usual
        variance = max(float(weight @ excess / weight.sum()), 0.0)
    return float(np.sqrt(variance)) if variance > _FLOOR_S**2 else 0.0
