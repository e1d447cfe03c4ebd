"""Where the board was in each image: distance, tilt and pose, from its corners and the lens."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.geometry.planar_pose import PlanarPose, planar_poses
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.camera_rays import undistort
from vical_daemon.results.report.residuals import FrameResiduals

LEAST = 6
"""Corners from which a pose is computed: four determine it, the rest guard against one bad corner."""
MOST = 240
"""Images for which it is computed, evenly over the recording: about 0.3 ms each."""


@dataclass(frozen=True, slots=True)
class BoardView:
    """The board as one image shows it.

    Attributes:
        t_ns: Stamp of the image, ns.
        R_cam_target: Attitude of the board in the camera frame, shape (3, 3).
        p_cam_target: Its origin in the camera frame, m, shape (3,).
        distance_m: From the camera to the middle of the board, m.
        normal_cam: Normal of the board on the side of the camera, unit length, shape (3,).
        tilt_rad: Angle between that normal and the line from the board to the camera: 0 is head-on.
    """

    t_ns: int
    R_cam_target: FloatArray
    p_cam_target: FloatArray
    distance_m: float
    normal_cam: FloatArray
    tilt_rad: float

    @property
    def p_target_cam(self) -> FloatArray:
        """Position of the camera in the target frame, m, shape (3,)."""
        return np.asarray(-self.R_cam_target.T @ self.p_cam_target)


def view_of(
    t_ns: int,
    points_m: FloatArray,
    uv_px: FloatArray,
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str,
) -> BoardView | None:
    """Return how one image shows the board; None where too few corners determine it.

    Args:
        t_ns: Stamp of the image, ns.
        points_m: Its points in the target frame (all z = 0), shape (n, 3).
        uv_px: The same in the image, shape (n, 2).
        intrinsics: fx fy cx cy, px, shape (4,).
        distortion: Coefficients of the model, shape (d,).
        model: radtan, plumb_bob or equidistant.
    """
    return views_of([(t_ns, points_m, uv_px)], intrinsics, distortion, model)[0]


def views_of(
    images: list[tuple[int, FloatArray, FloatArray]],
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str,
) -> list[BoardView | None]:
    """Return how images, each a stamp (ns), points and pixels, show the board, see `view_of`."""
    seen = []
    for _, points_m, uv_px in images:
        xy, ok = undistort(uv_px, intrinsics, distortion, model)
        ok &= ok.sum() >= LEAST
        seen.append((points_m[ok], xy[ok]))
    poses = planar_poses([points for points, _ in seen], [xy for _, xy in seen])
    return [
        _view(t_ns, points_m, found.candidates[0]) if found.candidates else None
        for (t_ns, points_m, _), found in zip(images, poses, strict=True)
    ]


def _view(t_ns: int, points_m: FloatArray, pose: PlanarPose) -> BoardView:
    R, p = pose.R_cam_target, pose.p_cam_target
    middle = R @ points_m.mean(axis=0) + p
    distance = float(np.linalg.norm(middle))
    normal = R[:, 2] if R[:, 2] @ middle < 0 else -R[:, 2]
    tilt = float(np.arccos(np.clip(-normal @ middle / distance, -1.0, 1.0)))
    return BoardView(t_ns, R, p, distance, normal, tilt)


def board_views(
    frames: Iterable[FrameResiduals],
    camera: str,
    target_m: FloatArray,
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str,
) -> list[BoardView]:
    """Return the views of one camera, oldest first, at most `MOST`.

    Args:
        frames: Of all cameras.
        camera: Which one.
        target_m: Points of the board by id, shape (n, 3).
        intrinsics: As in `view_of`.
        distortion: As in `view_of`.
        model: As in `view_of`.
    """
    own = [f for f in frames if f.camera == camera and int(np.count_nonzero(f.accepted)) >= LEAST]
    own = [own[i] for i in np.unique(np.linspace(0, len(own) - 1, min(MOST, len(own))).astype(int))]
    images = []
    for frame in own:
        good = np.asarray(frame.accepted, dtype=bool) & (np.asarray(frame.ids) < len(target_m))
        images.append((frame.t_ns, target_m[np.asarray(frame.ids)[good]], np.asarray(frame.uv_px)[good]))
    return [view for view in views_of(images, intrinsics, distortion, model) if view is not None]
