"""What the 3-D view shows (`scene.js` draws it): imu and camera with their sigmas, board, path of the camera.

The view lies in this folder so that report and live page draw with the same code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.results.report.board_views import BoardView

SCRIPT = Path(__file__).with_name("scene.js")


def rig(pose: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rig as the view draws it.

    Args:
        pose: T_imu_cam of a result: `p_m`, `q_wxyz`, `covariance`.

    Returns:
        `p` (m) and `R` of T_imu_cam, covariances `p_cov` (m^2, imu frame) and `r_cov` (rad^2, cam frame).
    """
    covariance = np.array(pose["covariance"], dtype=np.float64).reshape(6, 6)
    R = so3.matrix_from_quat(np.array(pose["q_wxyz"], dtype=np.float64))
    return {
        "p": [float(v) for v in pose["p_m"]],
        "R": np.round(R, 9).tolist(),
        "p_cov": covariance[:3, :3].tolist(),
        "r_cov": covariance[3:, 3:].tolist(),
    }


def board(points_m: FloatArray) -> list[list[float]]:
    """Return the corners of the rectangle round all points of a board, in the target frame, m."""
    (x0, y0), (x1, y1) = points_m[:, :2].min(axis=0).tolist(), points_m[:, :2].max(axis=0).tolist()
    return [[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]]


def camera_pose(view: BoardView) -> dict[str, Any]:
    """Return the pose of the camera in the target frame: `p`, m, and `R`."""
    return {"p": np.round(view.p_target_cam, 5).tolist(), "R": np.round(view.R_cam_target.T, 5).tolist()}


def scene(pose: Mapping[str, Any], points_m: FloatArray | None, views: Sequence[BoardView]) -> dict[str, Any]:
    """Return all that the view of the report shows."""
    document: dict[str, Any] = {"rig": rig(pose)}
    if points_m is not None and views:
        document |= {"board": board(points_m), "path": [camera_pose(view) for view in views]}
    return document
