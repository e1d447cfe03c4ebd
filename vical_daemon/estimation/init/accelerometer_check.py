"""Does the accelerometer belong to this motion? Signs and axes are tried out against the camera's path.

The rotations of gyro and camera give the mounting. The camera's path before a board gives its acceleration,
which is compared with the specific force as in `accel_alignment`, for each way in which the accelerometer's
axes may be permuted and signed; the one that fits is named.

Mirrored images of a board (u -> -u) give the poses D R D', D p with two reflections. The rotations then fit a
mounting that is turned by half a turn, and the accelerations are those of a negated accelerometer. Only the
side from which the board is seen distinguishes the two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.accel_alignment import CameraPath, force_misfits
from vical_daemon.estimation.init.attempts import LONG_S
from vical_daemon.estimation.init.target_poses import TargetPose
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import CameraState

_LONGEST_S = 60.0  # of the poses that are looked at: the cost grows with the square
_POSE_SIGMA = 1e-3  # m and rad, of a board that fills the image: weighs the priors of lever arm and bias
_BETTER = 0.5  # residual over that of the axes as they are: a wrong sign or swap changes it several times
_AXES = "xyz"


def mistaken_axes(poses: Sequence[TargetPose], cameras: Mapping[str, CameraState], buffer: ImuBuffer) -> str:
    """Name the mistake that explains why no start fits; as `explain_accelerometer`.

    Args:
        poses: By the rotations, in order for each camera.
        cameras: Mounting and time shift, by the rotations.
        buffer: Inertial readings.
    """
    first = poses[0].frame.camera
    of_it = [pose for pose in poses if pose.frame.camera == first]
    t_cam_s = np.array([pose.t_cam_s for pose in of_it])
    if t_cam_s[-1] - t_cam_s[0] < LONG_S:
        return ""  # more data may be all that is missing
    return explain_accelerometer(
        buffer.rows[:, 0],
        buffer.rows[:, 4:7],
        t_cam_s + cameras[first].timeshift_s,
        np.array([pose.R_target_cam for pose in of_it]),
        np.array([pose.p_target_cam for pose in of_it]),
        cameras[first].R_imu_cam,
    )


def explain_accelerometer(
    t_imu_s: FloatArray,
    force_mps2: FloatArray,
    t_cam_s: FloatArray,
    R_world_cam: FloatArray,
    p_world_cam: FloatArray,
    R_imu_cam: FloatArray,
    *,
    front_is_up: bool | None = None,
) -> str:
    """Name the mistake in signs or axes that, undone, makes the specific force fit the camera's path.

    Args:
        t_imu_s: Stamps of the accelerometer, s, shape (m,).
        force_mps2: Specific force, m/s^2, shape (m, 3).
        t_cam_s: Instants of the images in the same clock, increasing, s, shape (n,).
        R_world_cam: Orientations of the camera, shape (n, 3, 3); the world is the board.
        p_world_cam: Its positions, m, shape (n, 3).
        R_imu_cam: Mounting of the camera, shape (3, 3).
        front_is_up: Whether the board is printed on the side to which its z axis points; None: not known.

    Returns:
        In words; empty where no mistake explains it.
    """
    covered = (t_cam_s > t_imu_s[0]) & (t_cam_s < min(t_imu_s[-1], t_cam_s.min(initial=np.inf) + _LONGEST_S))
    t_s, alike = t_cam_s[covered], np.full(np.count_nonzero(covered), _POSE_SIGMA)
    if len(t_s) < 2:
        return ""
    path = CameraPath(t_s, R_world_cam[covered], p_world_cam[covered], alike, alike)
    mappings = so3.signed_permutations()
    rows = np.column_stack([t_imu_s, np.zeros_like(force_mps2), force_mps2])
    scores = force_misfits(path, rows, R_imu_cam.T @ np.concatenate([np.eye(3)[None], mappings]))
    if scores is None:
        return ""
    as_is, scores = scores[0], scores[1:]
    best = int(np.argmin(scores))
    if not scores[best] < _BETTER * as_is:
        return ""
    if np.array_equal(mappings[best], -np.eye(3)):
        seen_from_above = float(np.median(p_world_cam[:, 2])) > 0.0
        return _negated(None if front_is_up is None else seen_from_above == front_is_up)
    return _axes(mappings[best])


def _negated(seen_from_front: bool | None) -> str:
    negated = (
        "the accelerometer reports gravity instead of specific force (at rest it must read +9.8 upwards): "
        "negate all three of its axes"
    )
    mirrored = "the images are mirrored: the camera sees the board from behind"
    if seen_from_front is None:
        return f"either {negated}, or the images are mirrored; these data cannot tell which"
    return negated if seen_from_front else mirrored


def _axes(A: FloatArray) -> str:
    names = []
    for row in A:
        axis = int(np.flatnonzero(row)[0])
        names.append(("-" if row[axis] < 0.0 else "") + _AXES[axis])
    return (
        "the axes of accelerometer and gyro are not the same: with the accelerometer's axes taken as "
        f"({', '.join(names)}) it fits"
    )
