"""Sigmas of the lens: do stretches of the data agree about it, and does its model lack a term?

A lens model never fits exactly. Its misfit depends on where in the image and at which slant the target is
seen. So each stretch gives its own lens (block jackknife), and the variances of the lens grow by as much as
the stretches disagree. No comparison shows an error that all stretches share. So the next power of the radius
is estimated as well: if it is significant, the sigmas are at least as large as what it would move.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.geometry.camera_model import EQUIDISTANT, PLUMB_BOB, RADTAN
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.next_term import onto_model
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.noise.block_jackknife import BlockJackknife
from vical_daemon.estimation.significance import LIKELY_SIGMAS, STRETCH_S

_WEAK = 0.1  # of the focal length: as good as nothing known
_WEAK_DISTORTION = 0.5  # of a coefficient: likewise
# the two highest powers of the radius among fx fy cx cy and the distortion
_RADIAL = {RADTAN: (4, 5), PLUMB_BOB: (5, 8), EQUIDISTANT: (6, 7)}


@dataclass(slots=True)
class LensAgreement:
    """Running agreement of one camera's lens.

    Attributes:
        factors: Multiply the variances of fx fy cx cy and the distortion as they are reported, >= 1, shape
            (m,), or (1,) at first.
        moved: How far those would move with one more power of the radius, where that is there beyond doubt;
            else zeros; px and -, likewise.
        seen: Sum over the images of J'J, J the derivatives by the lens of points over their noise, (n, n).
    """

    factors: FloatArray = field(default_factory=lambda: np.ones(1))
    moved: FloatArray = field(default_factory=lambda: np.zeros(1))
    seen: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    _stretches: BlockJackknife = field(default_factory=lambda: BlockJackknife(STRETCH_S))

    def learn(
        self,
        t_s: float,
        innovation: FloatArray,
        by_pose: FloatArray,
        by_lens: FloatArray,
        camera: CameraState,
    ) -> None:
        """Take in one image before it is used.

        Args:
            t_s: Its instant, s.
            innovation: Measured minus predicted, over the corner noise, shape (2k,).
            by_pose: Derivatives of the whitened pixels by attitude and position, shape (2k, 6).
            by_lens: By fx fy cx cy and the distortion, shape (2k, n).
            camera: Its lens at present.
        """
        self.seen = self.seen + by_lens.T @ by_lens
        lens = np.concatenate([camera.intrinsics, camera.distortion])
        by = with_next_power(by_lens, camera.distortion_model)
        if not self._stretches.learn(t_s, innovation, by_pose, by, lens):
            return
        weak = lens_sigmas(lens[0], len(lens) + 1)
        n, onto = len(lens), onto_model(camera, self.seen)
        self.factors = self._stretches.compared(weak[:n], onto).factors
        free = self._stretches.compared(weak, np.eye(n + 1))
        power, variance = free.values[n], free.covariance[n, n]
        doubt = LIKELY_SIGMAS**2 * free.factors[n] * variance
        there = power if power**2 > doubt else 0.0
        self.moved = onto @ free.covariance[:n, n] * (there / variance)

    def anew(self) -> LensAgreement:
        """Without what stretches have said."""
        return LensAgreement(seen=self.seen)


def lens_sigmas(focal_px: float, n: int) -> FloatArray:
    """Standard deviations of fx fy cx cy and n - 4 coefficients of which as good as nothing is known."""
    return np.array([_WEAK * focal_px] * 4 + [_WEAK_DISTORTION] * (n - 4))


def with_next_power(by_lens: FloatArray, model: str) -> FloatArray:
    """Add the derivative by the coefficient that a distortion model would have next.

    Args:
        by_lens: Derivatives by fx fy cx cy and the distortion, shape (2k, n).
        model: radtan, plumb_bob or equidistant.

    Returns:
        Shape (2k, n + 1).
    """
    below, highest = (by_lens[:, k].reshape(-1, 2) for k in _RADIAL[model])
    size = np.maximum(np.vecdot(below, below), 1e-30)
    ratio = np.vecdot(below, highest) / size  # each power is the one below times radius squared
    return np.concatenate([by_lens, (highest * ratio[:, None]).reshape(-1, 1)], axis=1)
