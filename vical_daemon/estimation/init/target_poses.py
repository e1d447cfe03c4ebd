"""Poses of a camera from images of the target, one image at a time: what a start is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.geometry.planar_pose import PlanarPose, inliers, planar_pose
from vical_daemon.estimation.measurements import BoolArray, CameraPrior, FloatArray, PointsFrame
from vical_daemon.estimation.model.camera_rays import unproject

_MIN_POINTS = 8
_MOST_POSES = 160
_CLEANINGS = 3  # a gross outlier may hide lesser ones


@dataclass(slots=True)
class Lens:
    """Intrinsics in use while starting: given, guessed, or estimated from the first frames."""

    intrinsics: FloatArray
    distortion: FloatArray
    model: str
    resolution: tuple[int, int]
    readout_s: float = 0.0
    readout_axis: str = ""

    @classmethod
    def from_prior(cls, prior: CameraPrior) -> Lens:
        """Take what is given; a lens of 60 degrees across where nothing is."""
        return cls(
            prior.start_intrinsics(),
            prior.coefficients(),
            prior.distortion_model,
            prior.resolution,
            prior.readout_s,
            prior.readout_axis,
        )


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


def pose_of(frame: PointsFrame, t_cam_s: float, lens: Lens, target: FloatArray) -> TargetPose | None:
    """Planar pose of one frame; None where too few points are seen or the two-fold ambiguity is open."""
    if len(frame.ids) < _MIN_POINTS:
        return None
    rays, ok = unproject(frame.uv_px, lens.intrinsics, lens.distortion, lens.model)
    points, xy = target[frame.ids[ok]], rays[ok, :2] / rays[ok, 2:]
    found = planar_pose(points, xy)
    for _ in range(_CLEANINGS):
        if not found.candidates:
            return None
        good = _fitting(found.candidates[0], points, xy)
        if good.all() or good.sum() < _MIN_POINTS:
            break
        points, xy = points[good], xy[good]
        found = planar_pose(points, xy)
    if not found.candidates or found.ambiguous:
        return None
    return TargetPose(t_cam_s, found.candidates[0], frame)


def _fitting(pose: PlanarPose, points: FloatArray, xy: FloatArray) -> BoolArray:
    """Which corners are where the pose has them."""
    seen = points @ pose.R_cam_target.T + pose.p_cam_target
    with np.errstate(all="ignore"):
        far = np.linalg.norm(seen[:, :2] / seen[:, 2:] - xy, axis=1)
    return inliers(far)


class PoseCache:
    """Poses already found, so that repeated attempts cost little; a new lens empties it."""

    def __init__(self) -> None:
        self._lens: tuple[float | str, ...] = ()
        self._poses: dict[int, TargetPose | None] = {}

    def poses(
        self,
        frames: list[tuple[float, PointsFrame]],
        lens: Lens,
        target: FloatArray,
        since_s: float = -np.inf,
    ) -> list[TargetPose]:
        """Poses of at most 160 of the frames since a stamp, evenly thinned, in order of time.

        Args:
            frames: All there are: what is found of others is forgotten.
            lens: In use; with the readout that the frames were freed from.
            target: Points of the target, m, shape (n, 3).
            since_s: Older frames are left out, s.
        """
        key = (*lens.intrinsics.tolist(), *lens.distortion.tolist(), lens.readout_s, lens.readout_axis)
        if key != self._lens:
            self._lens, self._poses = key, {}
        known = {f.t_cam_ns: self._poses[f.t_cam_ns] for _, f in frames if f.t_cam_ns in self._poses}
        recent = [item for item in frames if item[0] > since_s]
        step = max(1, -(-len(recent) // _MOST_POSES))
        chosen = recent[::-1][::step][::-1]
        for t, f in chosen:
            if f.t_cam_ns not in known:
                known[f.t_cam_ns] = pose_of(f, t, lens, target)
        self._poses = known
        return [p for _, f in chosen if (p := known[f.t_cam_ns]) is not None]
