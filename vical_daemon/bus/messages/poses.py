"""geometry_msgs/PoseWithCovarianceStamped and tf2_msgs/TFMessage, for plain ROS tools."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vical_daemon.bus.messages.cdr import CdrReader, CdrWriter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.result import PoseEstimate

POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF_TYPE = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True, slots=True)
class PoseMessage:
    """A pose with covariance: `p_m` and `q_wxyz` in `frame_id`; covariance (6, 6) in ROS' convention.

    ROS turns about the *fixed* axes of `frame_id`; our own estimates turn about the axes of the camera.
    """

    stamp_ns: int
    frame_id: str
    p_m: tuple[float, float, float]
    q_wxyz: tuple[float, float, float, float]
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Transform:
    """Pose of `child_frame_id` in `frame_id`."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    p_m: tuple[float, float, float]
    q_wxyz: tuple[float, float, float, float]


def rotation_matrix(q_wxyz: Sequence[float]) -> FloatArray:
    """Return the rotation matrix (3, 3) of a Hamilton unit quaternion w x y z."""
    w, x, y, z = q_wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def covariance_for_ros(pose: PoseEstimate) -> FloatArray:
    """Return the 6x6 covariance of a pose with the rotation about the fixed axes of the parent frame.

    R_a_b exp(d) = exp(R_a_b d) R_a_b: an error d about the axes of b is R_a_b d about those of a.
    """
    turn = np.eye(6)
    turn[3:, 3:] = rotation_matrix(pose.q_wxyz)
    turned: FloatArray = turn @ np.asarray(pose.covariance, dtype=np.float64) @ turn.T
    return turned


def encode_pose(stamp_ns: int, frame_id: str, pose: PoseEstimate) -> bytes:
    """Build a PoseWithCovarianceStamped from an estimate; `frame_id` is the parent (the imu)."""
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    write_pose(writer, pose.p_m, pose.q_wxyz)
    writer.fixed(covariance_for_ros(pose))
    return writer.finish()


def decode_pose(data: bytes) -> PoseMessage:
    """Read a PoseWithCovarianceStamped.

    Raises:
        MessageError: These bytes are no such message.
    """
    reader = CdrReader(data)
    stamp_ns, frame_id = reader.header()
    p_m, q_wxyz = read_pose(reader)
    covariance = reader.fixed(36).reshape(6, 6)
    reader.end()
    return PoseMessage(stamp_ns, frame_id, p_m, q_wxyz, covariance)


def encode_transforms(transforms: list[Transform]) -> bytes:
    """Build a tf2_msgs/TFMessage."""
    writer = CdrWriter()
    writer.scalar("I", len(transforms))
    for transform in transforms:
        writer.header(transform.stamp_ns, transform.frame_id)
        writer.string(transform.child_frame_id)
        write_pose(writer, transform.p_m, transform.q_wxyz)
    return writer.finish()


def decode_transforms(data: bytes) -> list[Transform]:
    """Read a tf2_msgs/TFMessage.

    Raises:
        MessageError: These bytes are no such message.
    """
    reader = CdrReader(data)
    transforms = []
    for _ in range(reader.count(72)):
        stamp_ns, frame_id = reader.header()
        child = reader.string()
        transforms.append(Transform(stamp_ns, frame_id, child, *read_pose(reader)))
    reader.end()
    return transforms


def write_pose(writer: CdrWriter, p_m: Sequence[float], q_wxyz: Sequence[float]) -> None:
    """Append a geometry_msgs/Pose or Transform (position, then quaternion x y z w)."""
    w, x, y, z = q_wxyz
    writer.fixed([*p_m, x, y, z, w])


def read_pose(
    reader: CdrReader,
) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Read a geometry_msgs/Pose or Transform as (p_m, q_wxyz)."""
    px, py, pz, x, y, z, w = reader.fixed(7).tolist()
    return (px, py, pz), (w, x, y, z)
