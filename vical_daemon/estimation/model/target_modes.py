"""Modes of deformation of a printed target as a whole: narrow, skew, bowed, bent, twisted.

A board printed 0.3 % narrower than tall, or bent by half a millimetre, is taken for another lens and another
mounting, for it is wrong in the same way in every image. So its shape can be estimated with them: a
displacement of second order in both coordinates of the print. What is left, corner by corner, is too rough to
be mistaken for a lens. Turn, shift and size are no modes: they are the world frame and `target_scale`.
[Strobl & Hirzinger, "More accurate pinhole camera calibration with imperfect planar target", 2011;
docs/math/filter.md, eq. (17)]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.measurements import FloatArray

MODES = 11  # narrow, skew, and nine of second order, see `fields`
EXPECTED = 0.002
"""Of a mode, over half the target's larger side, one sigma."""


@dataclass(frozen=True, slots=True)
class TargetModes:
    """Displacement fields over a planar target, each a metre large at its edges.

    Args:
        centre_m: x and y of the middle of the target, m, shape (2,).
        half_m: Half of its larger side, m.
    """

    centre_m: FloatArray
    half_m: float

    @classmethod
    def of(cls, points_m: FloatArray) -> TargetModes:
        """The modes of a target; points shape (n, 3)."""
        low, high = points_m[:, :2].min(axis=0), points_m[:, :2].max(axis=0)
        return cls(0.5 * (low + high), float(0.5 * (high - low).max()))

    @property
    def sigma_m(self) -> float:
        """Expected distance of a target's edges from where the file puts them, by mode, one sigma, m."""
        return EXPECTED * self.half_m

    def fields(self, points_m: FloatArray) -> FloatArray:
        """Displacements of points by each mode.

        Args:
            points_m: Points of the target, m, shape (n, 3).

        Returns:
            Shape (n, 3, 11), per metre at the edges, in the order: narrow, skew; then with the square of x,
            the square of y, and x y: out of the plane (bent, bent, twisted), along x, along y (bowed).
        """
        uv = (points_m[:, :2] - self.centre_m) / self.half_m
        u, v = uv[:, 0], uv[:, 1]
        out = np.zeros((len(points_m), 3, MODES))
        out[:, 0, :2] = uv
        out[:, 1, 0], out[:, 1, 1] = -v, u
        second = out[:, 2, 2:5]
        second[:, :2] = uv * uv
        second[:, 2] = u * v
        out[:, 0, 5:8] = out[:, 1, 8:11] = second
        return out
