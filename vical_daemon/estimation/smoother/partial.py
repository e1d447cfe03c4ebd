"""The start of a rig that turns about one axis only, without a target: a cart on a floor, a joint of an arm.

Rotations then show the delay and two of the mounting's three angles. The third shows in how the rig moves:
the accelerometer feels the direction in which the images see it go. Structure, speed and lever arm are solved
for linearly with mountings turned all the way round about the axis (`free.start`), and the rays of the
features meet for one of them only. A lever arm along the axis does not show at all; it is held.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.init.linear_start import still_axes
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.smoother.track_start import ROUNDS, ArmPrior, NoStartError, TrackStart
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve

_STEP_RAD = float(np.deg2rad(15.0))  # between the angles tried first
_FINE_RAD = float(np.deg2rad(4.0))  # likewise about the best: the window converges from there
_ROUGH_ROUNDS = 4  # of reweighting at each angle tried first
_APART_RAD = float(np.deg2rad(45.0))  # from here on it is another mounting
_CONTRAST = 3.0  # so much worse must mountings fit that are turned far from the best


def still_axis(t_s: FloatArray, gyro_rps: FloatArray, bias_rps: FloatArray) -> FloatArray | None:
    """Return the one axis of the imu that kept its direction, unit, shape (3,); None: none, or all did.

    Args:
        t_s: Instants, s, shape (m,).
        gyro_rps: Rates, rad/s, shape (m, 3).
        bias_rps: Of the gyro, rad/s, shape (3,).
    """
    curve = GyroCurve.integrate(t_s, gyro_rps, bias_rps)
    axes = still_axes(curve.R_ref_imu.mean(axis=0))
    return axes[0] if len(axes) == 1 else None


def mounting_about(start: TrackStart, axis: FloatArray, R_imu_cam: FloatArray, arm: ArmPrior) -> FloatArray:
    """Find the mounting among those turned about an axis.

    Args:
        start: The stretch.
        axis: Of the imu, unit, shape (3,).
        R_imu_cam: Mounting, right but for a turn about that axis, shape (3, 3).
        arm: What is known of the lever arm.

    Returns:
        The mounting, shape (3, 3), good to a degree or so.

    Raises:
        NoStartError: Others fit nearly as well.
    """
    angles = np.arange(-np.pi, np.pi - 1e-9, _STEP_RAD)

    def misfit(angle: float, rounds: int = ROUNDS) -> float:
        return start.misfit(so3.exp(angle * axis) @ R_imu_cam, arm, rounds)

    found = np.array([misfit(a, _ROUGH_ROUNDS) for a in angles])
    best = float(angles[np.argmin(found)])
    away = np.abs((angles - best + np.pi) % (2.0 * np.pi) - np.pi) > _APART_RAD
    if not found.min() * _CONTRAST < found[away].min():
        raise NoStartError(
            "the mounting about the one axis that the rig turns about does not show yet: speed up and brake,"
            " or turn the rig about a second axis"
        )
    for step in (_STEP_RAD / 2.0, _FINE_RAD):
        best += _vertex(step, *(misfit(best + x) ** 2 for x in (-step, 0.0, step)))
    return np.asarray(so3.exp(best * axis) @ R_imu_cam)


def _vertex(step: float, low: float, middle: float, high: float) -> float:
    """Where a parabola through three points has its least value; at most a step away."""
    bend = low - 2.0 * middle + high
    if not np.isfinite(bend) or bend <= 0.0:
        return 0.0 if middle <= min(low, high) else step * float(np.sign(low - high))
    return step * float(np.clip(0.5 * (low - high) / bend, -1.0, 1.0))
