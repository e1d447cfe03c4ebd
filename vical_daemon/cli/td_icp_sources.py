"""Where `vical td-icp` gets orientations from: cameras of a recording, pose topics, trajectory files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.estimation import so3
from vical_daemon.estimation.camera_orientations import Orientations, target_orientations
from vical_daemon.estimation.intrinsics_start import estimate_intrinsics
from vical_daemon.estimation.lens_refinement import LensFit, refine_lens
from vical_daemon.estimation.measurements import CameraPrior, PointsFrame
from vical_daemon.estimation.start import Lens
from vical_daemon.estimation.td_icp_joint import OrientationStream
from vical_daemon.estimation.track_orientations import track_orientations
from vical_daemon.recording import Recording, Stream

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_POSE_SIGMA_RAD = 3e-3  # only a start: the fit measures it
# type -> path of the quaternion inside the message
_POSE_TYPES = {
    "nav_msgs/msg/Odometry": "pose.pose.orientation",
    "geometry_msgs/msg/PoseStamped": "pose.orientation",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose.orientation",
    "geometry_msgs/msg/TransformStamped": "transform.rotation",
    "geometry_msgs/msg/QuaternionStamped": "quaternion",
    "sensor_msgs/msg/Imu": "orientation",
}


def seconds(t_ns: IntArray, base_ns: int) -> FloatArray:
    """Stamps in seconds since a base: what is small enough for a float to keep every nanosecond."""
    return np.asarray((t_ns - base_ns) * 1e-9, dtype=np.float64)


def camera_stream(
    recording: Recording, stream: Stream, prior: CameraPrior | None, target: str | None, base_ns: int
) -> OrientationStream:
    """Orientations of one camera of a recording.

    Args:
        recording: The data.
        stream: The camera.
        prior: What is known about its lens; None: nothing.
        target: Target file, needed unless the stream holds tracks.
        base_ns: Subtracted from stamps.

    Raises:
        CliError: Something needed is not there.
    """
    lens = lens_of(stream, prior)
    if stream.kind == "tracks":
        if prior is None or prior.intrinsics is None:
            raise CliError(
                f"{stream.name}: tracks need the lens: give --initial with its intrinsics", EXIT_USAGE
            )
        chains = track_orientations(
            recording.points_frames(stream.name), lens.intrinsics, lens.distortion, lens.model
        )
        if not chains:
            raise CliError(f"{stream.name}: too few features carry over from frame to frame")
        found = max(chains, key=lambda chain: len(chain.t_cam_ns))
        return _stream(stream.name, found, base_ns)
    found, _ = board_poses(recording, stream, lens, prior is None or prior.intrinsics is None, target)
    return _stream(stream.name, found, base_ns)


def board_poses(
    recording: Recording, stream: Stream, lens: Lens, guess: bool, target: str | None
) -> tuple[Orientations, LensFit]:
    """Find the board in a camera's frames, improve the lens by them, and return the camera's poses.

    Args:
        recording: The data.
        stream: The camera, images or points.
        lens: Start.
        guess: The lens is only guessed from the image size.
        target: Target file.

    Raises:
        CliError: No target, or it does not fit the data.
    """
    if target is None:
        raise CliError(f"{stream.name}: give the board with --target", EXIT_USAGE)
    from vical_daemon.vision.target import load_target

    points_m = load_target(Path(target)).points_m
    frames = _frames(recording, stream, target)
    if not any(len(f.ids) for f in frames):
        raise CliError(f"{stream.name}: the target was found in no image; is it the right target file?")
    if max(int(f.ids.max()) for f in frames if len(f.ids)) >= len(points_m):
        raise CliError(
            f"{stream.name}: point ids go beyond the target's {len(points_m)} points; wrong target file?"
        )
    if guess:
        estimate_intrinsics(lens, frames, points_m)
    fit = refine_lens(frames, points_m, lens.intrinsics, lens.distortion, lens.model)
    return target_orientations(frames, points_m, fit.intrinsics, fit.distortion, lens.model), fit


def lens_of(stream: Stream, prior: CameraPrior | None) -> Lens:
    """Return what is known about a camera's lens, or a guess from the image size.

    Raises:
        CliError: Not even the image size is known.
    """
    if prior is None:
        if stream.resolution is None:
            raise CliError(
                f"{stream.name}: the image size is not in the recording; give --initial with "
                f"`{stream.name}: {{resolution: [width, height]}}`",
                EXIT_USAGE,
            )
        prior = CameraPrior(resolution=stream.resolution)
    elif prior.resolution == (0, 0) and prior.intrinsics is None:
        if stream.resolution is None:
            raise CliError(f"{stream.name}: --initial gives neither resolution nor intrinsics", EXIT_USAGE)
        prior = CameraPrior(resolution=stream.resolution, distortion_model=prior.distortion_model)
    return Lens.from_prior(prior)


def _stream(name: str, found: Orientations, base_ns: int) -> OrientationStream:
    return OrientationStream(name, seconds(found.t_cam_ns, base_ns), found.R_world_cam, found.covariance)


def _frames(recording: Recording, stream: Stream, target: str) -> list[PointsFrame]:
    if stream.kind == "points":
        return [f for f in recording.points_frames(stream.name) if len(f.ids)]
    from vical_daemon.vision.detector import BoardDetector
    from vical_daemon.vision.target import load_target

    detect = BoardDetector(load_target(Path(target))).detect
    frames = []
    for _, payload in recording.messages([stream]):
        stamp_ns, image = _image(payload, stream.kind)
        found = detect(image, stamp_ns)
        if found is not None and len(found.ids):
            frames.append(PointsFrame(stream.name, stamp_ns, found.ids, found.uv_px, found.sigma_px))
    return frames


def _image(payload: bytes, kind: str) -> tuple[int, Any]:
    from vical_daemon.messages import decode_compressed_image, decode_image

    if kind == "image":
        raw = decode_image(payload)
        return raw.stamp_ns, raw.pixels()
    from vical_daemon.vision import image_codec

    packed = decode_compressed_image(payload)
    return packed.stamp_ns, image_codec.decode_image(np.frombuffer(packed.data, np.uint8))


def pose_topic(recording: Recording, topic: str, base_ns: int) -> OrientationStream:
    """Orientations of a topic with poses, odometry or an imu that computes its own attitude.

    Raises:
        CliError: No such topic, or of a type without an orientation.
    """
    stamps, quaternions, seen = [], [], ""
    for type_name, message in _messages(recording, topic):
        seen = type_name
        if type_name not in _POSE_TYPES:
            break
        q: Any = message
        for part in _POSE_TYPES[type_name].split("."):
            q = getattr(q, part)
        stamps.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        quaternions.append((q.w, q.x, q.y, q.z))
    if not seen:
        raise CliError(f"{recording.path} holds no topic {topic}")
    if seen not in _POSE_TYPES:
        raise CliError(f"{topic} is a {seen}: it holds no orientation (known: {', '.join(_POSE_TYPES)})")
    return _from_quaternions(topic, np.array(stamps), np.array(quaternions), base_ns)


def _messages(recording: Recording, topic: str) -> Iterator[tuple[str, Any]]:
    """Yield (type, message) of one topic of any log of ROS messages."""
    from rosbags.highlevel import AnyReader

    from vical_daemon.messages.schemas import typestore
    from vical_daemon.recording.bags import BagRecording
    from vical_daemon.recording.logs import LogRecording

    store = typestore()
    if isinstance(recording, BagRecording):
        with AnyReader([recording.path], default_typestore=store) as reader:
            wanted = [c for c in reader.connections if c.topic == topic]
            for connection, _, data in reader.messages(connections=wanted) if wanted else ():
                yield connection.msgtype, reader.deserialize(data, connection.msgtype)
    elif isinstance(recording, LogRecording):
        for raw in recording._raw():
            if raw.topic == topic or raw.topic == topic.removeprefix("/"):
                known = raw.type_name in store.fielddefs
                yield raw.type_name, store.deserialize_cdr(raw.payload, raw.type_name) if known else None


def trajectory_file(path: Path, base_ns: int | None) -> tuple[OrientationStream, int]:
    """Read a trajectory: TUM (`t x y z qx qy qz qw`, seconds) or EuRoC (`t, x, y, z, qw, qx, qy, qz`, ns).

    Args:
        path: The file.
        base_ns: Subtracted from stamps; None: the file's first stamp.

    Returns:
        The stream, and the base that was used, ns.

    Raises:
        CliError: The file is neither.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        text = line.strip()
        if not text or text.startswith("#") or (not rows and not (text[0].isdigit() or text[0] in "-+.")):
            continue
        words = text.replace(",", " ").split()
        try:
            values = [float(word) for word in words[1:8]]
            stamp_ns = int(words[0]) if words[0].lstrip("+-").isdigit() else round(float(words[0]) * 1e9)
        except ValueError:
            raise CliError(f"{path} line {number}: not a number in '{text[:60]}'") from None
        if len(values) < 7:
            raise CliError(
                f"{path} line {number}: expected `t x y z qx qy qz qw` (TUM) or "
                "`t, x, y, z, qw, qx, qy, qz` (EuRoC)"
            )
        stamps.append(stamp_ns)
        rows.append(values[3:7])
    if len(rows) < 12:
        raise CliError(f"{path}: {len(rows)} poses, at least 12 are needed")
    t_ns = np.array(stamps, dtype=np.int64)
    if np.median(np.diff(t_ns)) < 1000:  # whole seconds or milliseconds would be no trajectory: bare seconds
        t_ns = t_ns * 1_000_000_000
    q = np.array(rows)
    comma = "," in next(line for line in path.read_text(encoding="utf-8").splitlines() if line[:1].isdigit())
    q = q if comma else q[:, [3, 0, 1, 2]]
    base = int(t_ns[0]) if base_ns is None else base_ns
    return _from_quaternions(path.name, t_ns, q, base), base


def _from_quaternions(name: str, t_ns: IntArray, q: FloatArray, base_ns: int) -> OrientationStream:
    length = np.linalg.norm(q, axis=1)
    good = np.abs(length - 1.0) < 0.05
    if np.count_nonzero(good) < 12:
        raise CliError(f"{name}: its orientations are no unit quaternions (not filled in by the sender?)")
    R = so3.matrix_from_quat(so3.quat_normalise(q[good]))
    return OrientationStream(name, seconds(t_ns[good], base_ns), R, _POSE_SIGMA_RAD)
