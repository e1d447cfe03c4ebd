"""Camera orientations for temporal calibration: from views of a planar target."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.planar_pose import PlanarPose, PlanarPoses, planar_poses
from vical_daemon.estimation.measurements import IMAGE_GAP_S, FloatArray, IntArray, PointsFrame
from vical_daemon.estimation.model.camera_rays import undistort

CORNER_PX = 0.2  # noise of a corner per axis, where its image does not say it
_MAX_RMS_PX = 8.0  # a pose that misses its corners by more is a wrong detection


@dataclass(frozen=True)
class Orientations:
    """A stream of orientations of one camera.

    Attributes:
        t_cam_ns: Stamps in the camera's clock, ns, shape (n,).
        R_world_cam: The world is the target (or the first camera frame), shape (n, 3, 3).
        covariance: Of the local (right) error, rad^2, shape (n, 3, 3).
        p_world_cam: Position of the camera in the world, m, shape (n, 3); empty where it is not known.
    """

    t_cam_ns: IntArray
    R_world_cam: FloatArray
    covariance: FloatArray
    p_world_cam: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))


def target_orientations(
    frames: Iterable[PointsFrame],
    points_m: FloatArray,
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str = "radtan",
) -> Orientations:
    """Turn views of a planar target into camera orientations.

    Of a frame's two planar poses the better one is taken; where the image cannot tell them apart, the one
    that continues the previous frames, and none if there is no previous frame nearby. Frames whose corners
    fit worse than usual (blur, the edge of the lens) get a covariance that grows with the fourth power of
    the misfit: what bends the corners out of line also turns the pose.

    Args:
        frames: Views in order of time; ids index `points_m`.
        points_m: Target points, z = 0, m, shape (k, 3).
        intrinsics: fx fy cx cy, px, shape (4,).
        distortion: Four coefficients, shape (4,).
        model: radtan or equidistant.

    Returns:
        The orientations with their covariances.
    """
    sigma = CORNER_PX / float(np.mean(intrinsics[:2]))
    stamps: list[int] = []
    poses: list[PlanarPose] = []
    frames = list(frames)
    for frame, found in zip(
        frames, _planar(frames, points_m, (intrinsics, distortion, model), sigma), strict=True
    ):
        near = bool(stamps) and frame.t_cam_ns - stamps[-1] < 1e9 * IMAGE_GAP_S
        pose = _choose(found, poses[-1] if near else None)
        if pose is None or pose.rms * float(intrinsics[0]) > _MAX_RMS_PX:
            continue
        stamps.append(frame.t_cam_ns)
        poses.append(pose)
    if not poses:
        return Orientations(np.zeros(0, np.int64), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    R = np.stack([pose.R_cam_target for pose in poses])
    covariance = np.stack([pose.covariance[3:, 3:] for pose in poses])
    rms = np.array([pose.rms for pose in poses])
    covariance *= np.maximum(1.0, rms / np.median(rms))[:, None, None] ** 2
    R_world_cam = np.swapaxes(R, 1, 2)
    p = -(R_world_cam @ np.stack([pose.p_cam_target for pose in poses])[..., None])[..., 0]
    return Orientations(np.array(stamps), R_world_cam, R @ covariance @ R_world_cam, p)


def _planar(
    frames: list[PointsFrame], points_m: FloatArray, lens: tuple[FloatArray, FloatArray, str], sigma: float
) -> list[PlanarPoses]:
    """Both poses of every frame; none where it shows too few points."""
    points, rays = [], []
    for frame in frames:
        known = (frame.ids >= 0) & (frame.ids < len(points_m))
        xy, ok = undistort(frame.uv_px[known], *lens)
        points.append(points_m[frame.ids[known][ok]])
        rays.append(xy[ok])
    return planar_poses(points, rays, sigma)


def _choose(found: PlanarPoses, previous: PlanarPose | None) -> PlanarPose | None:
    """The best candidate, or where the image is undecided the one nearest to the previous frame's."""
    if not found.candidates:
        return None
    if not found.ambiguous:
        return found.candidates[0]
    if previous is None:
        return None
    R = np.stack([candidate.R_cam_target for candidate in found.candidates])
    turn = np.linalg.norm(so3.log(np.swapaxes(R, 1, 2) @ previous.R_cam_target), axis=1)
    return found.candidates[int(np.argmin(turn))]
