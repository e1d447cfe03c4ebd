"""Pixels of world points and their derivatives by everything: derived apart from the daemon's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vical_mocks.lens import Lens
from vical_mocks.rotations import skew

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """Where a camera is and how it moves at the instant of a frame (or of each point: leading axis n).

    Attributes:
        R_world_imu: (3, 3).
        p_world_imu: m.
        v_world_imu: m/s.
        omega_imu_rps: rad/s.
        R_imu_cam: (3, 3).
        p_imu_cam: m.
        lens: Intrinsics.
        share_read: By pixels (..., 2): when they are read, as a share of the readout; None: by rows.
    """

    R_world_imu: FloatArray
    p_world_imu: FloatArray
    v_world_imu: FloatArray
    omega_imu_rps: FloatArray
    R_imu_cam: FloatArray
    p_imu_cam: FloatArray
    lens: Lens
    share_read: Callable[[FloatArray], FloatArray] | None = None

    def points_in_imu(self, points_m: FloatArray) -> FloatArray:
        """World points (n, 3) in the imu frame, m."""
        return _turn(np.swapaxes(self.R_world_imu, -1, -2), points_m - self.p_world_imu)

    def points_in_cam(self, points_m: FloatArray) -> FloatArray:
        """World points (n, 3) in the camera frame, m."""
        return _turn(np.swapaxes(self.R_imu_cam, -1, -2), self.points_in_imu(points_m) - self.p_imu_cam)


def _turn(R: FloatArray, v: FloatArray) -> FloatArray:
    """Rotate n vectors, by one rotation or by n."""
    return np.asarray((R @ v[..., None])[..., 0])


def jacobians(view: View, points_m: FloatArray) -> dict[str, FloatArray]:
    """Derivatives of the pixels, 2n rows (u, v of each point in turn).

    Rotation errors are local: R = R_nominal exp(error). Keys: attitude, position (of the imu), p_imu_cam,
    r_imu_cam, timeshift, readout, intrinsics, distortion, target_scale, and points (2n, 3: each row by its
    own point).
    """
    in_imu, in_cam = view.points_in_imu(points_m), view.points_in_cam(points_m)
    by_cam, by_lens = lens_derivatives(view.lens, in_cam)
    by_imu = by_cam @ np.swapaxes(view.R_imu_cam, -1, -2)
    by_world = by_imu @ np.swapaxes(view.R_world_imu, -1, -2)
    # d z / d t_d = A ([P_imu] x omega - R^T v): the camera a moment later
    resting = _turn(np.swapaxes(view.R_world_imu, -1, -2), np.broadcast_to(view.v_world_imu, in_imu.shape))
    moving = np.cross(in_imu, view.omega_imu_rps) - resting
    by_time = np.einsum("nij,nj->ni", by_imu, moving)
    uv, _ = view.lens.project(in_cam)
    share = view.share_read(uv) if view.share_read else uv[:, 1] / view.lens.resolution[1] - 0.5
    blocks = {
        "attitude": by_imu @ skew(in_imu),
        "position": -by_world,
        "points": by_world,
        "p_imu_cam": -by_imu,
        "r_imu_cam": by_cam @ skew(in_cam),
        "timeshift": by_time[..., None],
        "readout": (by_time * share[:, None])[..., None],
        "intrinsics": by_lens[..., :4],
        "distortion": by_lens[..., 4:],
        "target_scale": np.einsum("nij,nj->ni", by_world, points_m)[..., None],
    }
    return {name: block.reshape(-1, block.shape[-1]) for name, block in blocks.items()}


def lens_derivatives(lens: Lens, in_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels by the point (n, 2, 3) and by intrinsics and distortion (n, 2, 8): central differences."""
    by_point = np.empty((len(in_cam), 2, 3))
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        by_point[:, :, axis] = (lens.project(in_cam + step)[0] - lens.project(in_cam - step)[0]) / 2e-6
    uv, _ = lens.project(in_cam)
    normal = (uv - np.array(lens.intrinsics[2:])) / np.array(lens.intrinsics[:2])
    by_lens = np.zeros((len(in_cam), 2, 8))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = normal[:, 0], normal[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    for k in range(4):
        step = np.zeros(4)
        step[k] = 1e-5
        above, below = (
            _with_distortion(lens, np.array(lens.distortion) + s).project(in_cam)[0] for s in (step, -step)
        )
        by_lens[:, :, 4 + k] = (above - below) / 2e-5
    return by_point, by_lens


def _with_distortion(lens: Lens, distortion: FloatArray) -> Lens:
    k = [float(x) for x in distortion]
    return replace(lens, distortion=(k[0], k[1], k[2], k[3]))
