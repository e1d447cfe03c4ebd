"""Poses of a camera from images of the target, one image at a time: what a start is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.geometry.planar_pose import (
    MIN_POINTS,
    PlanarPose,
    PlanarPoses,
    inliers,
    planar_poses,
)
from vical_daemon.estimation.measurements import FloatArray, PointsFrame
from vical_daemon.estimation.model.camera_rays import unproject
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.temporal.camera_orientations import CORNER_PX


@dataclass(slots=True)
class TargetPose:
    """Pose of the camera from one image: instant in the camera's clock and pose in the target frame."""

    t_cam_s: float
    pose: PlanarPose
    frame: PointsFrame

    @property
    def R_target_cam(self) -> FloatArray:
        """Attitude of the camera in the target frame."""
        return np.asarray(self.pose.R_cam_target.T)

    @property
    def p_target_cam(self) -> FloatArray:
        """Camera origin in the target frame, m."""
        return np.asarray(-self.pose.R_cam_target.T @ self.pose.p_cam_target)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the camera's position by axis, m; it follows the attitude's."""
        return float(np.sqrt(np.trace(self.pose.covariance[:3, :3]) / 3.0))

    @property
    def sigma_rad(self) -> float:
        """Standard deviation of its attitude by axis, rad."""
        return float(np.sqrt(np.trace(self.pose.covariance[3:, 3:]) / 3.0))


def pose_of(frame: PointsFrame, t_cam_s: float, lens: CameraState, target: FloatArray) -> TargetPose | None:
    """Planar pose of one frame; None where too few points are seen or the two-fold ambiguity is open."""
    return poses_of([(t_cam_s, frame)], lens, target)[0]


def poses_of(
    frames: Sequence[tuple[float, PointsFrame]], lens: CameraState, target: FloatArray
) -> list[TargetPose | None]:
    """Planar poses of frames with their stamps in s, see `pose_of`."""
    views = dict(enumerate(ideal_views([f for _, f in frames], lens, target)))
    left = list(views)
    found: dict[int, PlanarPoses] = {}
    while left:  # a gross outlier may hide lesser ones
        found.update(zip(left, planar_poses(*_columns([views[k] for k in left])), strict=True))
        left = [k for k in left if found[k].candidates and _cleaned(views, k, found[k].candidates[0])]
    return [
        TargetPose(t, found[k].candidates[0], f)
        if k in found and found[k].candidates and not found[k].ambiguous
        else None
        for k, (t, f) in enumerate(frames)
    ]


def attitude_sigmas(poses: Sequence[TargetPose], camera: CameraState) -> FloatArray:
    """Of the poses as reported, but at least of corners that are a fifth of a pixel off, rad, shape (n,)."""
    return np.maximum([p.sigma_rad for p in poses], CORNER_PX / float(camera.intrinsics[0]))


def ideal_views(
    frames: Sequence[PointsFrame], lens: CameraState, target: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """What the lens has not bent: points of the target, m (n, 3), and where they are, X/Z and Y/Z (n, 2)."""
    if not frames:
        return []
    uv, ids = np.concatenate([f.uv_px for f in frames]), np.concatenate([f.ids for f in frames])
    rays, ok = unproject(uv, lens.intrinsics, lens.distortion, lens.distortion_model)
    ends = np.cumsum([len(f.ids) for f in frames])[:-1]
    each = zip(np.split(target[ids], ends), np.split(rays, ends), np.split(ok, ends), strict=True)
    return [(points[good], ray[good, :2] / ray[good, 2:]) for points, ray, good in each]


def _columns(views: list[tuple[FloatArray, FloatArray]]) -> tuple[list[FloatArray], list[FloatArray]]:
    return [points for points, _ in views], [xy for _, xy in views]


def _cleaned(views: dict[int, tuple[FloatArray, FloatArray]], k: int, pose: PlanarPose) -> bool:
    """Leave out corners that are not where the pose has them; False: there are none, or too few others."""
    points, xy = views[k]
    seen = points @ pose.R_cam_target.T + pose.p_cam_target
    with np.errstate(all="ignore"):
        far = np.linalg.norm(seen[:, :2] / seen[:, 2:] - xy, axis=1)
    good = inliers(far)
    if good.all() or good.sum() < MIN_POINTS:
        return False
    views[k] = points[good], xy[good]
    return True


def usable_poses(
    frames: Sequence[tuple[float, PointsFrame]], lens: CameraState, target: FloatArray
) -> list[TargetPose]:
    """Poses of those of the frames (stamp in s, points) that show one, in order of time."""
    return [p for p in poses_of(frames, lens, target) if p is not None]
