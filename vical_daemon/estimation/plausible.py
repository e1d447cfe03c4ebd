"""Plausibility bounds on everything that enters an estimator, whoever sent it.

The bounds are those of the devices, wide enough for every rig: a value outside of them is junk or a fault,
never data. Values inside may still be wrong; that is for the estimator's own gates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vical_daemon.estimation.measurements import (
    STANDARD_GRAVITY_MPS2,
    BoolArray,
    FloatArray,
    IntArray,
    PointsFrame,
)
from vical_daemon.estimation.result import CameraEstimate

MOST_RPS = math.radians(4000.0)
"""Angular rate about each axis, rad/s: the widest full scale of MEMS gyros for robots (TDK ICM-45686); a
3DM-GX3-25 has 300 deg/s, as an option 1200."""
MOST_MPS2 = 50.0 * STANDARD_GRAVITY_MPS2
"""Specific force along each axis, m/s^2: the widest full scale of the 3DM-GX3-25 (options of 1.7 to 50 g)."""
MOST_PX = 16384
"""Width and height of an image, px: the widest sensors of machine vision have 14192 columns (151 MP)."""
OUTSIDE_PX = 16.0
"""How far outside of its image a point may be said to be, px: detectors refine at the border, and a corner is
searched in a window of at most so many pixels."""
LEAST_SIGMA_PX, MOST_SIGMA_PX = 1e-3, 1e3
"""Stated sigma of a point, px: the best detectors reach 0.01 px; beyond the upper bound it says nothing."""
MOST_POINTS = 10_000
"""Points in one image: the largest printed boards have some 2000."""
MOST_STAMP_SIGMA_S = 1.0
"""How badly a driver may know its device's clock and still say so, s; a USB stall is shorter."""
_UNIT = 1e-3  # of a quaternion: 32-bit floats round by 1e-7, our own messages by less


def imu_problem(gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]) -> str:
    """Say why this cannot be an inertial reading (rad/s, m/s^2); empty: it can."""
    x, y, z = gyro_rps  # written out: for each reading, and a loop takes three times as long
    if not (abs(x) <= MOST_RPS and abs(y) <= MOST_RPS and abs(z) <= MOST_RPS):  # false for NaN, too
        worst = _worst(gyro_rps)
        return f"a rate of {worst:.3g} rad/s where no gyro reads more than {MOST_RPS:.0f}; is it in deg/s?"
    x, y, z = specific_force_mps2
    if not (abs(x) <= MOST_MPS2 and abs(y) <= MOST_MPS2 and abs(z) <= MOST_MPS2):
        worst = _worst(specific_force_mps2)
        most = f"{MOST_MPS2:.0f}; is it in mg?"
        return f"a force of {worst:.3g} m/s^2 where no accelerometer reads more than {most}"
    return ""


def points_problem(
    ids: IntArray, uv_px: FloatArray, sigma_px: FloatArray | None, image_size: tuple[int, int] = (0, 0)
) -> str:
    """Say why these cannot be the points of one image; empty: they can.

    Args:
        ids: Shape (n,).
        uv_px: Raw pixel coordinates, shape (n, 2).
        sigma_px: One-sigma per axis, shape (n,), or None.
        image_size: width, height, px; (0, 0): not known.
    """
    if len(ids) > MOST_POINTS:
        return f"{len(ids)} points in one image; at most {MOST_POINTS} are taken"
    problem = image_size_problem(image_size) if any(image_size) else ""
    if problem or not len(ids):
        return problem
    width, height = image_size if any(image_size) else (MOST_PX, MOST_PX)
    low, high = -OUTSIDE_PX, np.array([width, height]) + OUTSIDE_PX
    inside = (uv_px >= low) & (uv_px <= high)
    if not inside.all():
        u, v = uv_px[~inside.all(axis=1)][0]
        return f"a point at {u:.5g}, {v:.5g} px in an image of {width} x {height}"
    if int(ids.min()) < 0 or not (_ascending(ids) or len(np.unique(ids)) == len(ids)):
        return "an id below 0, or one point seen twice"
    if sigma_px is not None and not ((sigma_px >= LEAST_SIGMA_PX) & (sigma_px <= MOST_SIGMA_PX)).all():
        return f"a sigma outside of {LEAST_SIGMA_PX:g} to {MOST_SIGMA_PX:g} px"
    return ""


def usable_points(frame: PointsFrame) -> BoolArray:
    """Which points of a frame an estimator may take: possible values, each point once; shape (n,)."""
    ok = (np.abs(frame.uv_px) <= MOST_PX + OUTSIDE_PX).all(axis=1) & (frame.ids >= 0)  # NaN is not, either
    if frame.sigma_px is not None:
        ok &= (frame.sigma_px >= LEAST_SIGMA_PX) & (frame.sigma_px <= MOST_SIGMA_PX)
    if len(ok) <= MOST_POINTS and _ascending(frame.ids):
        return np.asarray(ok)
    _, first = np.unique(frame.ids, return_index=True)
    once = np.zeros(len(frame.ids), dtype=bool)
    once[first[:MOST_POINTS]] = True
    return np.asarray(ok & once)


def _ascending(ids: IntArray) -> bool:
    """Whether each id is above the one before, as detectors give them; sorting takes longer."""
    return bool((ids[1:] > ids[:-1]).all())


def image_size_problem(size: tuple[int, int]) -> str:
    """Say why no image has this width and height, px; empty: one may."""
    if all(0 < side <= MOST_PX for side in size):
        return ""
    return f"an image of {size[0]} x {size[1]} pixels where sides of 1 to {MOST_PX} are possible"


def stamp_sigma_problem(sigma_s: float) -> str:
    """Say why a driver cannot mean this as the sigma of its stamps, s; empty: it can."""
    if 0.0 <= sigma_s <= MOST_STAMP_SIGMA_S:
        return ""
    return f"stamps known to {sigma_s:.3g} s where 0 to {MOST_STAMP_SIGMA_S:g} s is possible"


def camera_problem(camera: CameraEstimate) -> str:
    """Say why this cannot be what is known about a camera; empty: it can. Sigmas may be infinite."""
    pose = camera.T_imu_cam
    numbers = [*pose.p_m, *pose.q_wxyz, camera.timeshift_cam_imu_s, *camera.intrinsics, *camera.distortion]
    if not all(map(math.isfinite, numbers)):
        return "a calibration with a value that is not finite"
    if not abs(math.hypot(*pose.q_wxyz) - 1.0) < _UNIT:
        return "a calibration with a rotation that is none"
    if camera.intrinsics and not (len(camera.intrinsics) == 4 and min(camera.intrinsics[:2]) > 0.0):
        return "a calibration without a focal length"
    return ""


def _worst(values: Sequence[float]) -> float:
    return max(values, key=lambda value: math.inf if math.isnan(value) else abs(value))
