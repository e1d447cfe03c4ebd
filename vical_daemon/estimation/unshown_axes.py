"""Lever arms along axes that have not turned: held in the filter, unknown in what is said.

Where an axis `a` of the imu keeps its direction R a in the world, a lever arm longer by `a` and an imu that
stands back by `R a` give the same images: the motion shows nothing of it, and whatever it is assumed to be,
the rest comes out the same. A filter that lets it float sees `R a` in slightly different directions at each
image and takes that for information (as SLAM filters do; Huang et al. 2010): its sigma collapses while it
runs off. So it is held, its variance is added where the estimate leaves, and the first real turn of the
axis releases it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from vical_daemon.estimation.initialise import STILL_RAD
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.state import POSITION

if TYPE_CHECKING:
    from vical_daemon.estimation.calibration_filter import CalibrationFilter

UNKNOWN_M = 0.3
"""Sigma of a lever arm that nothing is known of, m: a robot's, not a telephone's."""
BENT_M = 1e-3
"""By how much holding one axis bends the others, m: the axis is known to a milliradian, what is held along it
is wrong by centimetres, and the filter's own sigmas come out below the bound (errors of 1 to 1.5 mm seen)."""
_EVERY_S = 1.0


@dataclass(slots=True)
class UnshownAxes:
    """Follows the attitude of a filter from its partial start on.

    Attributes:
        axes: Of the imu, along which lever arms are held, unit length, shape (k, 3).
    """

    axes: FloatArray
    _mean: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    _count: int = 0
    _next_s: float = float("-inf")

    def follow(self, f: CalibrationFilter) -> None:
        """Look at the filter after an image, and release what has turned by now."""
        self._count += 1
        self._mean += (f.state.R_world_imu - self._mean) / self._count
        if f.state.t_s < self._next_s:
            return
        self._next_s = f.state.t_s + _EVERY_S
        length = np.linalg.norm(self._mean @ self.axes.T, axis=0)
        turned = 1.0 - length**2 > STILL_RAD**2
        for axis in self.axes[turned]:
            self._release(f, axis)
        self.axes = self.axes[~turned]

    @staticmethod
    def _release(f: CalibrationFilter, axis: FloatArray) -> None:
        column = np.zeros(f.layout.size)
        column[POSITION] = -UNKNOWN_M * (f.state.R_world_imu @ axis)
        for where in f.layout.cameras.values():
            if where.position is not None:
                column[where.position] = UNKNOWN_M * axis
        f.loosen(column)

    @property
    def projector(self) -> FloatArray:
        """Onto the axes, shape (3, 3)."""
        out: FloatArray = self.axes.T @ self.axes
        return out

    def covariance(self) -> FloatArray:
        """What is not known of a lever arm beyond the filter's own covariance, m^2, shape (3, 3)."""
        held = self.projector
        return held_covariance(held) if held.any() else held


def has_turned(R_world_imu: FloatArray, axis: FloatArray) -> bool:
    """Whether an axis of the imu (3,) left its direction in a stretch of attitudes (n, 3, 3)."""
    mean = R_world_imu.mean(axis=0) @ axis
    return bool(1.0 - mean @ mean > STILL_RAD**2)


def held_covariance(projector: FloatArray) -> FloatArray:
    """What holding a lever arm along some axes leaves unknown of it, m^2, shape (3, 3).

    Args:
        projector: Onto the axes, imu frame, shape (3, 3).
    """
    out: FloatArray = UNKNOWN_M**2 * projector + BENT_M**2 * (np.eye(3) - projector)
    return out
