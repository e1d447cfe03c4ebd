"""Do all cameras number the points of the target alike?

The target of a camera that numbers them another way is turned: the attitude of the rig by this camera differs
by one rotation from that by another. Rotations between images do not show it, so that each camera alone fits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry.so3 import nearest_rotation
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.motion_restart import ahead
from vical_daemon.estimation.init.velocity_gravity_init import RotationsKnown
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import State

_TURNED_RAD = math.pi / 4
"""Half of the smallest turn, a quarter, that brings the points of a square target onto others."""
_TOGETHER_S = 0.05
"""Images that are no further apart show the rig in the same attitude: to 6 deg at 2 rad/s."""


class Turned(NamedTuple):
    """By one camera the target is turned against what it is by another.

    Attributes:
        first: A camera.
        other: The one by which the target is turned.
        angle_rad: By how much.
    """

    first: str
    other: str
    angle_rad: float

    @property
    def half(self) -> bool:
        """Whether it is about half a turn: some targets look the same then."""
        return self.angle_rad > math.pi - _TURNED_RAD

    def __str__(self) -> str:
        """Say what is wrong, and what to do."""
        return (
            f"{self.first} and {self.other} number the points of the target differently: by {self.other} "
            f"it is turned by {math.degrees(self.angle_rad):.0f} deg; "
            "give the same point the same id in all cameras"
        )


def numbered_differently(known: Mapping[str, RotationsKnown]) -> Turned | None:
    """Return a camera that numbers the points unlike the first one; None: none is seen to.

    Args:
        known: By camera: poses of the target, mounting and time shift by rotations.
    """
    first, *others = known
    for name in others:
        turn = _turn(known[first], known[name])
        angle = 0.0 if turn is None else _angle(turn)
        if angle > _TURNED_RAD:
            return Turned(first, name, angle)
    return None


def late_numbered_differently(
    known: CalibrationFilter, name: str, state: State, buffer: ImuBuffer
) -> Turned | None:
    """Likewise for a camera that joins others later, by their attitude and the gyro since then.

    Args:
        known: The filter at an instant before.
        name: The camera.
        state: With the attitude by its images, not before the filter's.
        buffer: Inertial readings; where some are missing in between, nobody knows: None.
    """
    there = None if buffer.gap_within(known.state.t_s, state.t_s) else ahead(known, buffer, state.t_s)
    if there is None:
        return None
    angle_rad = _angle(there.state.R_world_imu.T @ state.R_world_imu)
    first = next(other for other in known.state.cameras if other not in known.absent)
    return Turned(first, name, angle_rad) if angle_rad > _TURNED_RAD else None


def _angle(R: FloatArray) -> float:
    return math.acos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0))


def _turn(a: RotationsKnown, b: RotationsKnown) -> FloatArray | None:
    """Mean rotation of the target by one camera to that by the other; None: they never see it together."""
    t_a, R_a = _attitudes(a)
    t_b, R_b = _attitudes(b)
    nearest = np.abs(t_b[:, None] - t_a).argmin(axis=1)
    together = np.abs(t_b - t_a[nearest]) < _TOGETHER_S
    if not together.any():
        return None
    turns = R_b[together] @ np.swapaxes(R_a[nearest[together]], 1, 2)
    return nearest_rotation(turns.mean(axis=0))


def _attitudes(known: RotationsKnown) -> tuple[FloatArray, FloatArray]:
    """Instants, imu clock, s, shape (n,), and attitudes of the imu in the target's frame, shape (n, 3, 3)."""
    camera = known.camera
    t_s = np.array([p.t_cam_s for p in known.poses]) + camera.timeshift_s
    return t_s, np.array([p.R_target_cam @ camera.R_imu_cam.T for p in known.poses])
