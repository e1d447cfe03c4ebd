"""A fixed lens: its values stay, and its uncertainty is included in the sigmas of everything else.

Its errors are states of the filter all the same. An alternative model takes the lens as given, exactly or to
the sigma that the user gives. The reported calibration is the one for the given values; its covariance
includes what errors of these values do to it. [Schmidt, "Application of state-space methods to
navigation problems", 1966: parameters that are considered; docs/math/filter.md, eq. (19)]
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.geometry.camera_model import project_jacobians
from vical_daemon.estimation.measurements import CameraPrior, FloatArray
from vical_daemon.estimation.model.camera_rays import rays_over_image
from vical_daemon.estimation.model.priors import OFF

OFF_SHARE = 0.02  # of the focal length, of fx fy cx cy; EuRoC's published lens is 1.5 % off in cx
_OFF_DISTORTION = 0.05  # EuRoC's k1: 0.045
_ROUNDING = 1e-9  # of the sigma of a lens that is off: less is arithmetic
_WIDER = 3.0  # times the sigma that is stated: which may be too small


@dataclass(frozen=True, slots=True)
class FixedLens:
    """What is known of a lens that is held: fx fy cx cy (px), distortion.

    Attributes:
        values: As given, shape (n,).
        sigma: How well they are known, as given; zeros: exactly; shape (n,).
        off_sigma: By how much a lens is off that is not as given, one sigma, shape (n,).
        off: Probability that it is not as given, before any image.
    """

    values: FloatArray
    sigma: FloatArray
    off_sigma: FloatArray
    off: float = OFF

    @classmethod
    def of(cls, prior: CameraPrior) -> FixedLens | None:
        """Return the lens of a camera; None where none is given."""
        if prior.intrinsics is None:
            return None
        values = np.concatenate([prior.intrinsics, prior.coefficients()])
        n = len(values)
        sigma = np.concatenate(
            [prior.intrinsics_sigma or np.zeros(4), prior.distortion_sigma or np.zeros(n - 4)]
        )
        default = np.array([OFF_SHARE * values[0]] * 4 + [_OFF_DISTORTION] * (n - 4))
        return cls(values, sigma, np.maximum(default, _WIDER * sigma))

    @classmethod
    def considered(cls, prior: CameraPrior, fix: frozenset[str]) -> FixedLens | None:
        """Return the lens of a camera whose errors matter to something that is estimated; None: it has none.

        Args:
            prior: What is known about the camera.
            fix: See `CalibrationOptions`.
        """
        if "intrinsics" not in fix or {"extrinsics", "timeshift"} <= fix:
            return None
        return cls.of(prior)

    def may_have_jumped(self, covariance: FloatArray) -> FixedLens:
        """The lens when images no longer fit: it is as likely to be another as to be the same.

        Its values are correlated, and `off_sigma` is not. So that is as much smaller as makes the density at
        the values as given, by which the alternatives are compared, that of the covariance.

        Args:
            covariance: Of how far it may be off now, shape (n, n): what images have said of values that have
                not jumped still holds.
        """
        sigma = np.sqrt(np.diag(covariance))
        sigma = sigma * np.exp(np.linalg.slogdet(covariance / np.outer(sigma, sigma))[1] / (2 * len(sigma)))
        return replace(self, off_sigma=np.maximum(sigma, _WIDER * self.sigma), off=0.5)

    def reported(self, sigma: FloatArray) -> FloatArray:
        """Standard deviations of what is reported: zeros where only rounding is left; shape (at most n,)."""
        return np.where(sigma > _ROUNDING * self.off_sigma[: len(sigma)], sigma, 0.0)

    def displacement_px(
        self, off: FloatArray, covariance: FloatArray, model: str, resolution: tuple[int, int]
    ) -> tuple[float, float]:
        """How far it projects points from where they appear, RMS over the image, and its sigma, px.

        To first order: with J the derivatives by the lens at n places, the square is off' (J'J/n) off.

        Args:
            off: Estimated errors of its values, shape (n,).
            covariance: Of them, shape (n, n).
            model: Distortion model.
            resolution: Width and height, px.
        """
        rays = rays_over_image(self.values[:4], self.values[4:], model, resolution)
        J = project_jacobians(rays, self.values[:4], self.values[4:], model)[2]
        apart = J @ off
        rms = float(np.sqrt((apart**2).sum(axis=1).mean()))
        slope = np.einsum("pij,pi->j", J, apart) / (len(rays) * rms)
        return rms, float(np.sqrt(slope @ covariance @ slope))
