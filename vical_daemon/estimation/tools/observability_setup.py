"""What observability is asked about: a motion, what looks at what, and which unknowns there are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.measurements import ROWS, FloatArray

# What counts as one step of each parameter: makes metres, radians and seconds comparable
UNITS = {
    "attitude": 0.01,
    "position": 0.01,
    "velocity": 0.05,
    "gyro_bias": 0.01,
    "accel_bias": 0.1,
    "gravity": 0.1,
    "rotation": 0.01,
    "lever_arm": 0.01,
    "timeshift": 0.001,
    "intrinsics": 5.0,
    "distortion": 0.02,
    "gyro_matrix": 0.01,
    "accel_matrix": 0.01,
    "target_scale": 0.01,
    "readout": 0.002,
    "landmark": 0.05,
}


@dataclass(frozen=True)
class Motion:
    """A motion, sampled like an imu does.

    Attributes:
        t_s: Instants, increasing, s, shape (m,).
        R_world_imu: Attitude, shape (m, 3, 3).
        p_world_imu: Position, m, shape (m, 3).
        v_world_imu: Velocity, m/s, shape (m, 3).
        rate_rps: Angular rate in the imu frame, shape (m, 3).
        specific_force_mps2: In the imu frame, shape (m, 3).
    """

    t_s: FloatArray
    R_world_imu: FloatArray
    p_world_imu: FloatArray
    v_world_imu: FloatArray
    rate_rps: FloatArray
    specific_force_mps2: FloatArray


@dataclass(frozen=True)
class Setup:
    """What looks at what.

    Attributes:
        R_imu_cam: Mounting, shape (3, 3).
        p_imu_cam: Lever arm, m, shape (3,).
        intrinsics: fx fy cx cy, px, shape (4,).
        distortion: Four coefficients, shape (4,).
        model: radtan or equidistant.
        resolution: width, height, px; points outside are not seen.
        landmarks_m: Points in the world, m, shape (n, 3).
        target_free: The points' places are unknown too.
        seen: Without a board, in a world with z up: rows of `landmarks_m` that each image shows. Their places
            are unknown, and eliminated. None: the points inside of the image are seen.
        readout_axis: What a rolling shutter reads one after the other.
        estimate: Of {"intrinsics", "imu_matrix", "target_scale", "readout"}: further unknowns.
        corner_sigma_px: Noise of a point per axis, px.
    """

    R_imu_cam: FloatArray
    p_imu_cam: FloatArray
    intrinsics: FloatArray
    distortion: FloatArray
    landmarks_m: FloatArray
    model: str = "radtan"
    resolution: tuple[int, int] = (640, 480)
    target_free: bool = False
    estimate: frozenset[str] = frozenset()
    corner_sigma_px: float = 0.5
    seen: tuple[npt.NDArray[np.intp], ...] | None = None
    readout_axis: str = ROWS


def block_layout(setup: Setup) -> dict[str, slice]:
    """Return the columns of each block of unknowns."""
    sizes = [(name, 3) for name in ("attitude", "position", "velocity", "gyro_bias", "accel_bias", "gravity")]
    sizes += [("rotation", 3), ("lever_arm", 3), ("timeshift", 1)]
    if "intrinsics" in setup.estimate:
        sizes += [("intrinsics", 4), ("distortion", 4)]
    if "imu_matrix" in setup.estimate:
        sizes += [("gyro_matrix", 9), ("accel_matrix", 6)]
    if "target_scale" in setup.estimate:
        sizes += [("target_scale", 1)]
    if "readout" in setup.estimate:
        sizes += [("readout", 1)]
    if setup.target_free:
        sizes += [("landmark", 3 * len(setup.landmarks_m))]
    layout, start = {}, 0
    for name, size in sizes:
        layout[name] = slice(start, start + size)
        start += size
    return layout
