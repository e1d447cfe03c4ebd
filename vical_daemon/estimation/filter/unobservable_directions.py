"""Unobservable directions: held in the filter, reported at prior sigma.

If an axis `a` of the imu keeps its direction R a in the world, a lever arm longer by `a` and an imu moved
back by `R a` give the same images. The lever arm along `a` is unobservable, and its assumed value changes
nothing else. A filter that leaves it free sees `R a` in slightly different directions at each image and
takes that for information (as SLAM filters do; Huang et al. 2010): its sigma collapses while the estimate
drifts off. So it is held, its variance is added to what is reported, and the first real turn of the axis ends
the filter: a lever arm that is held at a wrong value then moves all else.

If the rig turns at one rate about one axis all the time, another delay is equivalent to another angle about
that axis, with another direction of gravity, and a longer lever arm to another bias of the accelerometer. So
all of these are held until another motion allows a complete start.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import WINDOW_START
from vical_daemon.estimation.model.state import CameraSlices

if TYPE_CHECKING:
    from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter

STILL_RAD = 0.05
"""RMS turn of an axis below which it has shown nothing of a lever arm along it."""
HELD_M = 1e-3
"""Sigma with which a lever arm is held at zero along such an axis, m."""
UNKNOWN_M = WINDOW_START.lever_arm_m
"""Sigma of an unknown lever arm, m."""
BENT_M = 1e-3
"""By how much holding one axis bends the others, m: the axis is known to a milliradian, what is held along it
is wrong by centimetres, and the filter's own sigmas come out below the bound (errors of 1 to 1.5 mm seen)."""
UNKNOWN_S = 0.3
"""Sigma of an unknown delay, s."""
UNKNOWN_RAD = float(np.pi / np.sqrt(3.0))
"""Sigma of an unknown angle: all are equally likely."""
_RECENT_S = 0.3  # of images by which an axis is seen to turn: 17 deg/s
_HELD = 1e-6  # sigma, s, s/s or rad, of what motion does not show yet: as good as known


@dataclass(slots=True)
class UnobservableDirections:
    """Follows the attitude of a filter from its partial start on.

    Attributes:
        axes: Of the imu, along which lever arms are held, unit length, shape (k, 3).
        turn_axis_cam: Of a rig that turns about it at one rate all the time, camera frame, unit length,
            shape (3,): the delay and the mounting about it are held, with all lever arms; None: they are not.
    """

    axes: FloatArray
    turn_axis_cam: FloatArray | None = None
    _mean: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    _count: int = 0
    _recent: deque[tuple[float, FloatArray]] = field(default_factory=deque)

    def hold(self, root: FloatArray, where: CameraSlices) -> None:
        """Make the sigmas of a filter that begins small where the motion shows nothing.

        Args:
            root: Its square root of the covariance, diagonal; changed in place.
            where: Of the camera.
        """
        if where.position is not None:
            held = self.projector
            root[where.position, where.position] = UNKNOWN_M * (np.eye(3) - held) + HELD_M * held
        if self.turn_axis_cam is None:
            return
        if where.rotation is not None:
            held = np.outer(self.turn_axis_cam, self.turn_axis_cam)
            free = root[where.rotation, where.rotation]
            root[where.rotation, where.rotation] = free @ (np.eye(3) - held) + _HELD * held
        if where.timeshift is not None and where.skew is not None:
            root[where.timeshift, where.timeshift] = _HELD
            root[where.skew, where.skew] = _HELD

    def turned(self, f: CalibrationFilter) -> bool:
        """Look at the filter after an image: whether what is held turns now, so that it must not be held."""
        R = f.state.R_world_imu
        self._count += 1
        self._mean += (R - self._mean) / self._count
        self._recent.append((f.state.t_s, R))
        while self._recent[0][0] < f.state.t_s - _RECENT_S:
            self._recent.popleft()
        if self.turn_axis_cam is not None:
            return False
        usual = self._mean @ self.axes.T
        usual = usual / np.linalg.norm(usual, axis=0)
        now = sum(R for _, R in self._recent) / len(self._recent) @ self.axes.T
        return bool((2.0 - 2.0 * (usual * now).sum(axis=0) > STILL_RAD**2).any())

    @property
    def projector(self) -> FloatArray:
        """Onto the axes, shape (3, 3)."""
        out: FloatArray = self.axes.T @ self.axes
        return out

    def covariance(self) -> FloatArray:
        """What is not known of a T_imu_cam beyond the filter's covariance, [p r], m, rad, shape (6, 6)."""
        out, held = np.zeros((6, 6)), self.projector
        if held.any():
            out[:3, :3] = held_covariance(held)
        if self.turn_axis_cam is not None:
            out[3:, 3:] = UNKNOWN_RAD**2 * np.outer(self.turn_axis_cam, self.turn_axis_cam)
        return out

    @property
    def timeshift_sigma_s(self) -> float:
        """What is not known of a delay beyond the filter's own sigma, s."""
        return 0.0 if self.turn_axis_cam is None else UNKNOWN_S


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
