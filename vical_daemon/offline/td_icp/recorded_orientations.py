"""Recorded orientations: topics of any log of ROS messages, and trajectory files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.temporal.td_icp_input import OrientationStream
from vical_daemon.logs.trajectory import read_trajectory
from vical_daemon.offline.errors import InputError, Warn, ignore
from vical_daemon.offline.td_icp.sources import seconds

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_POSE_SIGMA_RAD = 3e-3  # only a start: the fit measures it
_MIN_POSES = 12
# type -> path of the quaternion inside the message, path of its covariance ("": it has none)
_POSE_TYPES = {
    "nav_msgs/msg/Odometry": ("pose.pose.orientation", "pose.covariance"),
    "geometry_msgs/msg/PoseStamped": ("pose.orientation", ""),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose.pose.orientation", "pose.covariance"),
    "geometry_msgs/msg/TransformStamped": ("transform.rotation", ""),
    "geometry_msgs/msg/QuaternionStamped": ("quaternion", ""),
    "sensor_msgs/msg/Imu": ("orientation", "orientation_covariance"),
}


def pose_topic(path: Path, topic: str, base_ns: int | None) -> tuple[OrientationStream, int]:
    """Orientations of a topic with poses, odometry or an imu that computes its own attitude.

    Args:
        path: MCAP file, folder of them, ROS 1 bag, or ROS 2 bag folder.
        topic: As recorded; a leading slash that is not there does not matter.
        base_ns: Subtracted from stamps; None: the topic's first stamp.

    Returns:
        The stream, and the base that was used, ns.

    Raises:
        InputError: No such topic, of a type without an orientation, or nobody filled it in.
    """
    stamps: list[int] = []
    quaternions: list[tuple[float, ...]] = []
    variances: list[float] = []
    found: Counter[str] = Counter()
    for name, type_name, message in _messages(path):
        if name.removeprefix("/") != topic.removeprefix("/"):
            found[f"{name} ({type_name})"] += type_name in _POSE_TYPES
            continue
        if type_name not in _POSE_TYPES:
            known = ", ".join(_POSE_TYPES)
            raise InputError(f"{topic} is a {type_name}: it holds no orientation (known: {known})")
        quaternion, covariance = _POSE_TYPES[type_name]
        decoded = message()
        q = _member(decoded, quaternion)
        stamps.append(decoded.header.stamp.sec * 1_000_000_000 + decoded.header.stamp.nanosec)
        quaternions.append((q.w, q.x, q.y, q.z))
        variances.append(_variance(_member(decoded, covariance)) if covariance else 0.0)
    if not stamps:
        others = ", ".join(sorted(name for name, n in found.items() if n))
        raise InputError(f"{path} holds no topic {topic}; with orientations: {others or 'none'}")
    if min(variances) < 0.0:
        raise InputError(f"{topic}: its sender says that it holds no orientation (covariance[0] is -1)")
    if max(stamps) == 0:
        raise InputError(f"{topic}: all stamps are zero (not filled in by the sender)")
    t_ns = np.array(stamps, dtype=np.int64)
    base = int(t_ns.min()) if base_ns is None else base_ns
    sigma = np.sqrt(np.array(variances))
    return _from_quaternions(topic, t_ns, np.array(quaternions), base, sigma), base


def _member(message: Any, path: str) -> Any:
    for part in path.split("."):
        message = getattr(message, part)
    return message


def _variance(covariance: Any) -> float:
    """Mean variance of the three angles, rad^2; 0: not given; -1: the sender has no orientation."""
    values = np.asarray(covariance, dtype=np.float64)
    if values[0] == -1.0:
        return -1.0
    angles = np.diagonal(values.reshape((6, 6) if len(values) == 36 else (3, 3)))[-3:]
    mean = float(angles.mean())
    return mean if np.isfinite(mean) and mean > 0.0 else 0.0


def _messages(path: Path) -> Iterator[tuple[str, str, Any]]:
    """Yield (topic, type, function that decodes) of all messages of any log of ROS messages."""
    from vical_daemon.bus.messages.schemas import typestore
    from vical_daemon.logs import mcap_files
    from vical_daemon.logs.bags import bag_messages, is_bag
    from vical_daemon.logs.mcap import LogError, LogReader
    from vical_daemon.logs.recorded_logs import as_cdr

    store, files = typestore(), mcap_files(path)
    if not files and not is_bag(path):
        raise InputError(f"{path} is no log of messages: topics need an MCAP or a bag")
    logged = (as_cdr(m, _POSE_TYPES) for file in files for m in LogReader(file).messages())
    try:
        for raw in logged if files else bag_messages(path, _POSE_TYPES):
            if raw is not None:
                yield raw.topic, raw.type_name, lambda r=raw: store.deserialize_cdr(r.payload, r.type_name)
    except LogError as error:
        raise InputError(str(error)) from None


def trajectory_file(path: Path, base_ns: int | None, warn: Warn = ignore) -> tuple[OrientationStream, int]:
    """Read a trajectory file (see `logs.trajectory`).

    Args:
        path: The file.
        base_ns: Subtracted from stamps; None: the file's first stamp.
        warn: Takes what is unusual about it.

    Returns:
        The stream, and the base that was used, ns.

    Raises:
        InputError: Too few poses, or no orientations.
        RecordingError: The file is no trajectory, or its columns can be read in two ways.
    """
    found = read_trajectory(path)
    for warning in found.warnings:
        warn(warning)
    if len(found.t_ns) < _MIN_POSES:
        raise InputError(f"{path}: {len(found.t_ns)} poses, at least {_MIN_POSES} are needed")
    base = int(found.t_ns[0]) if base_ns is None else base_ns
    return _from_quaternions(path.name, found.t_ns, found.q_wxyz, base), base


def _from_quaternions(
    name: str, t_ns: IntArray, q: FloatArray, base_ns: int, sigma: FloatArray | None = None
) -> OrientationStream:
    """A stream of quaternions w x y z; those that are no rotation are left out."""
    length = np.linalg.norm(q, axis=1)
    good = np.abs(length - 1.0) < 0.05
    if np.count_nonzero(good) < _MIN_POSES:
        raise InputError(f"{name}: its orientations are no unit quaternions (not filled in by the sender?)")
    if np.ptp(q[good], axis=0).max() == 0.0:
        raise InputError(f"{name}: its orientation never changes (not filled in by the sender?)")
    R = so3.matrix_from_quat(so3.quat_normalise(q[good]))
    sigma_rad: float | FloatArray = _POSE_SIGMA_RAD
    if sigma is not None and sigma[good].min() > 0.0:
        sigma_rad = np.clip(sigma[good], 1e-5, 3.0)
    return OrientationStream(name, seconds(t_ns[good], base_ns), R, sigma_rad)
