"""Random errors of a camera's stamps, measured: each moves all corners of an image along their motion.

A stamp that is late by e shifts every corner by e times its speed in the image. From one image e is known as
well as corners and predicted pose are; how much it varies beyond that, over many images, is the jitter. It is
0 until it is significant, so that good stamps pay nothing. [docs/math/filter.md, eq. (12)]
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.measurements import BoolArray, FloatArray

_MEMORY = 400  # images
_LEAST = 20
_LEAST_ASSUMED = 10
_EVERY = 5  # images between two looks at all that is remembered
_SIGNIFICANT = 5.0  # standard deviations above what stamps without jitter would give
_STILL_SIGNIFICANT = 1.0  # to go on with a jitter that was found
_CLIP = 36.0  # squared standard deviations: outliers are not jitter
_FLOOR_S = 2e-5
_GROWN = 1.5  # the variance; less is scatter
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
    _allowed: FloatArray = field(default_factory=lambda: np.zeros(_MEMORY))  # s^2, when the image was used
    _counts: BoolArray = field(default_factory=lambda: np.zeros(_MEMORY, dtype=bool))
    _assumed: bool = False

    @classmethod
    def assumed(cls, sigma_s: float) -> StampJitter:
        """A jitter that is allowed for until `begin` puts in its place what the images said."""
        return cls(sigma_s, _assumed=True)

    def begin(self) -> None:
        """Go on with what was learnt, in a filter that has used none of these images."""
        if self._assumed:
            enough = self.images >= _LEAST_ASSUMED
            learnt = self._square[: self.images], self._usual[: self.images]
            self.sigma_s = excess(*learnt, significant=0.0) if enough else 0.0
            self._assumed = False
        self._counts[:] = False

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
        self._allowed[place], self._counts[place] = self.sigma_s**2, True
        self.images += 1
        if self._assumed:
            return
        if self.images >= _LEAST and self.images % _EVERY == 0:
            significant = _STILL_SIGNIFICANT if self.sigma_s else _SIGNIFICANT
            self.sigma_s = excess(self._square[: self.images], self._usual[: self.images], significant)

    def owed(self) -> float:
        """Variance, s^2, by which the time shift is known less well than a filter thinks; asked once.

        Images used with less jitter than is known by now weighed too much: the variance of their weighted
        mean is sum w^2 (variance + jitter^2) / (sum w)^2, and not 1 / sum w.
        """
        counts, variance = self._counts, self.sigma_s**2
        short = counts & (variance > _GROWN * self._allowed)
        if not short.any():
            return 0.0
        weight = 1.0 / (self._usual[counts] + self._allowed[counts])
        lacking = np.where(short[counts], variance - self._allowed[counts], 0.0)
        self._allowed[short] = variance
        return float(weight**2 @ lacking / weight.sum() ** 2)


def jitter_told(camera: str, jitter_s: float) -> str:
    """Announcement of a jitter; empty where it is too small to be worth a word."""
    if jitter_s < _TOLD_S:
        return ""
    return f"{camera}: the stamps of the images jitter by {1e3 * jitter_s:.1f} ms; allowed for"


def excess(square: FloatArray, usual: FloatArray, significant: float = _SIGNIFICANT) -> float:
    """Standard deviation, s, that squared errors show beyond their usual variances; 0 if by chance.

    Args:
        square: Squared errors, s^2, shape (n,).
        usual: Their variances without, s^2, shape (n,).
        significant: Standard deviations of chance by which they must be larger.
    """
    ratio = np.minimum(square / usual, _CLIP)
    telling = 1.0 / np.maximum(usual, np.median(usual))  # images with a wide prior have little to say
    if telling @ (ratio - 1.0) < significant * np.sqrt(2.0 * float(telling @ telling)):
        return 0.0
    # maximum likelihood by scoring; 0.455 is the median of a chi-square variable
    variance = max(float(np.median(square)) / 0.455 - float(np.median(usual)), 0.0)
    for _ in range(_ROUNDS):
        expected = usual + variance
        weight = expected**-2
        excess = np.minimum(square, _CLIP * expected) - usual
        variance = max(float(weight @ excess / weight.sum()), 0.0)
    return float(np.sqrt(variance)) if variance > _FLOOR_S**2 else 0.0
