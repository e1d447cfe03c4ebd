"""A rolling shutter in an epipolar fit: rays as the middle of the image would have seen them.

A feature that is read late is seen from a camera that has turned on by then. Between two readouts the camera
moves on, too; at a constant velocity that changes the length of the translation between two sightings, and
not its direction, so that the constraint holds. The readout may be negative: what turned an image upright may
have reversed the order in which its lines are read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.inertial.imu_model import cross
from vical_daemon.estimation.measurements import COLUMNS, ROWS, FloatArray
from vical_daemon.estimation.temporal.epipolar_pairs import Pairs

AXES = (COLUMNS, ROWS)
READOUT_SIGMA_S = 0.02  # of a shutter that rolls: at 30 images a second most read for 10 to 33 ms
SURELY_ROLLING = 5.0  # sigmas
SHORTEST_S = 1e-3  # of a readout that is worth a word

Rays = tuple[FloatArray, FloatArray]
RateCurve = Callable[[FloatArray], FloatArray]


@dataclass(slots=True)
class EpipolarShutter:
    """The shutter of a camera.

    Attributes:
        resolution: Width, height, px.
        axes: Which readouts are among the unknowns, places in `AXES`.
        readout_s: By columns and by rows, s, shape (2,).
    """

    resolution: tuple[int, int]
    axes: list[int]
    readout_s: FloatArray = field(default_factory=lambda: np.zeros(2))

    def shares(self, pairs: Pairs) -> tuple[FloatArray, FloatArray]:
        """How late features are read, as shares of both readouts, in both images, shape (n, 2) each."""
        size = np.array(self.resolution)
        return pairs.uv_1 / size - 0.5, pairs.uv_2 / size - 0.5

    def turning(self, rays: Rays, rate: RateCurve, t_s: FloatArray, pairs: Pairs) -> Rays:
        """How fast the rays turn while their lines wait to be read, rad/s, shape (n, 3) each.

        Args:
            rays: Of both images, shape (n, 3) each.
            rate: Turning rate of the camera in its frame, rad/s, (n, 3), at instants (n,).
            t_s: Instants of the images, s, shape (k,).
            pairs: Of images.
        """
        first, second = (share @ self.readout_s for share in self.shares(pairs))
        return (
            cross(rate(t_s[pairs.first][pairs.of] + 0.5 * first), rays[0]),
            cross(rate(t_s[pairs.second][pairs.of] + 0.5 * second), rays[1]),
        )

    def at_the_middle(self, rays: Rays, turning: Rays, pairs: Pairs) -> Rays:
        """Rays as the middle of each image would have seen them, shape (n, 3) each."""
        first, second = (share @ self.readout_s for share in self.shares(pairs))
        return rays[0] + first[:, None] * turning[0], rays[1] + second[:, None] * turning[1]

    def derivatives(
        self,
        by_first: FloatArray,
        by_second: FloatArray,
        turning: Rays,
        pairs: Pairs,
    ) -> FloatArray:
        """Derivatives of errors by the readouts that are among the unknowns, shape (n, a).

        Args:
            by_first: By the ray in the first image, shape (n, 3).
            by_second: In the second, shape (n, 3).
            turning: See above.
            pairs: Of images.
        """
        first, second = self.shares(pairs)
        one, two = (by_first * turning[0]).sum(-1), (by_second * turning[1]).sum(-1)
        return (first * one[:, None] + second * two[:, None])[:, self.axes]


def rolling_axis(found: list[tuple[FloatArray, FloatArray]]) -> str:
    """Name the axis along which a shutter rolls for sure, `COLUMNS` or `ROWS`; empty: none is.

    Args:
        found: Readouts by columns and rows, s, (2,), and their covariance, (2, 2), by parts of the data.
    """
    information = np.array([np.linalg.inv(C) if np.isfinite(C).all() else np.zeros((2, 2)) for _, C in found])
    total = information.sum(axis=0)
    if not total.any():
        return ""
    covariance = np.linalg.inv(total)
    readout_s = covariance @ np.einsum("kij,kj->i", information, np.array([r for r, _ in found]))
    sigmas = np.abs(readout_s) / np.sqrt(np.diag(covariance))
    axis = int(np.argmax(sigmas))
    sure = sigmas[axis] > SURELY_ROLLING and abs(readout_s[axis]) > SHORTEST_S
    return AXES[axis] if sure else ""
