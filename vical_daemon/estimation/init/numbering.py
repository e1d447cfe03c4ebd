"""Do all cameras number the points of the target alike?

The target of a camera that numbers them another way is turned: the attitude of the rig by this camera differs
by one rotation from that by another. Rotations between images do not show it, so that each camera alone fits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from vical_daemon.estimation.geometry.so3 import nearest_rotation
from vical_daemon.estimation.init.velocity_gravity_init import RotationsKnown
from vical_daemon.estimation.measurements import FloatArray

_TURNED_RAD = math.pi / 4
"""Half of the smallest turn, a quarter, that brings the points of a square target onto others."""
_TOGETHER_S = 0.05
"""Images that are no further apart show the rig in the same attitude: to 6 deg at 2 rad/s."""


def numbered_differently(known: Mapping[str, RotationsKnown]) -> str:
    """Return in words which camera numbers the points unlike the first one; empty: none is seen to.

    Args:
        known: By camera: poses of the target, mounting and time shift by rotations.
    """
    first, *others = known
    for name in others:
        turn = _turn(known[first], known[name])
        angle = 0.0 if turn is None else math.acos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))
        if angle > _TURNED_RAD:
            return (
                f"{first} and {name} number the points of the target differently: by {name} it is turned by "
                f"{math.degrees(angle):.0f} deg; give the same point the same id in all cameras"
            )
    return ""


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
