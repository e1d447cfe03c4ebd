"""Reads a calibration as ROS has it: a CameraInfo for the lens, static transforms for the mounting.

A transform of tf2 is the pose of the child in its parent, so `T_imu_cam` is found along the chain of
transforms from the imu's frame to that of the camera (z forward, x right [REP 103, optical frames]). ROS has
no time shift: images and readings are taken to have the same clock, unless the file has `timeshift_cam_imu`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vical_daemon.bus.messages import CameraInfoMessage, Transform
from vical_daemon.bus.messages.image import of_the_image
from vical_daemon.config.strict_yaml import ConfigError, parse
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.results.export.rig import ExportError, Rig, RigCamera

_HINT = "`ros2 topic echo --once --full-length` of /tf_static and of camera_info, in one file"
_OPTICAL = "_optical_frame"  # what REP 103 appends to the name of a camera


def looks_like_ros(text: str) -> bool:
    """Whether a YAML file holds messages of ROS or a file of camera_info_manager."""
    marks = ("transforms:", "camera_matrix:", "k:", "K:", "imu_frame:")
    return any(line.startswith(marks) for line in text.splitlines())


def read_ros_yaml(text: str, path: Path) -> Rig:
    """Read messages as `ros2 topic echo` prints them, and files of camera_info_manager, divided by `---`.

    Args:
        text: Of the file. Its documents, in any order: TFMessage, CameraInfo, a file of camera_info_manager,
            and `imu_frame: NAME` and `timeshift_cam_imu: SECONDS` where they are needed.
        path: For messages.

    Raises:
        ExportError: Something is missing or wrong; one line.
    """
    lenses: dict[str, CameraInfoMessage] = {}
    transforms: list[Transform] = []
    loose: dict[str, Any] = {}
    for document in _documents(text, path):
        try:
            if "transforms" in document:
                transforms += [_transform(entry) for entry in document["transforms"]]
            elif "camera_matrix" in document:
                info = _of_camera_info_manager(document)
                lenses[info.frame_id] = info
            elif "k" in document or "K" in document:
                info = _of_camera_info(document)
                lenses[info.frame_id] = info
            else:
                loose |= document
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            what = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
            raise ExportError(f"{path}: not as ROS prints it: {what}; expected {_HINT}") from None
    shift_s = loose.get("timeshift_cam_imu", 0.0)
    if not isinstance(shift_s, int | float):
        raise ExportError(f"{path}: timeshift_cam_imu must be a number of seconds")
    return rig_from_ros(lenses, transforms, [str(loose.get("imu_frame", ""))], str(path), float(shift_s))


def rig_from_ros(
    lenses: Mapping[str, CameraInfoMessage],
    transforms: Sequence[Transform],
    imu_frames: Sequence[str],
    source: str,
    timeshift_s: float = 0.0,
) -> Rig:
    """Put a rig together.

    Args:
        lenses: By the name of the camera.
        transforms: Static ones, of any frames.
        imu_frames: Which may be that of the imu; none, or empty ones: that with `imu` in its name.
        source: For messages.
        timeshift_s: t_imu = t_cam + timeshift, s.

    Raises:
        ExportError: Something is missing or wrong; one line.
    """
    if not lenses:
        raise ExportError(f"{source}: no CameraInfo in it; expected {_HINT}")
    if not transforms:
        raise ExportError(f"{source}: no transforms in it; expected {_HINT}")
    poses = _neighbours(transforms)
    imu = _imu_frame(poses, imu_frames, source)
    from_imu = _from(imu, poses)
    cameras = {}
    for name, info in lenses.items():
        T = from_imu.get(frame := _camera_frame(name, info, imu, poses, source))
        if T is None:
            raise ExportError(f"{source}: no chain of static transforms from {imu} to {frame}")
        model, distortion = _lens(info, name, source)
        cameras[name] = RigCamera(
            name=name,
            R_imu_cam=T[:3, :3],
            p_imu_cam=T[:3, 3],
            timeshift_cam_imu_s=timeshift_s,
            intrinsics=info.intrinsics,
            distortion_model=model,
            distortion=distortion,
            resolution=(info.width, info.height),
        )
    return Rig(cameras, imu_frame=imu, note=f"from {Path(source).name} (ROS)")


def _neighbours(transforms: Sequence[Transform]) -> dict[str, dict[str, FloatArray]]:
    """By frame, the poses (4, 4) of its children and of its parent in it."""
    poses: dict[str, dict[str, FloatArray]] = {}
    for one in transforms:
        parent, child = (frame.strip("/") for frame in (one.frame_id, one.child_frame_id))
        T = np.eye(4)
        q = np.array(one.q_wxyz)
        norm = float(np.linalg.norm(q))
        if not (norm > 0.0 and np.isfinite([*q, *one.p_m]).all()):
            raise ExportError(f"the transform of {child} in {parent} has no valid rotation or translation")
        T[:3, :3], T[:3, 3] = so3.matrix_from_quat(q / norm), one.p_m
        poses.setdefault(parent, {})[child] = T
        poses.setdefault(child, {})[parent] = np.asarray(np.linalg.inv(T))
    return poses


def _from(frame: str, poses: Mapping[str, Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """Poses (4, 4) in a frame of all frames that transforms connect with it."""
    found, waiting = {frame: np.eye(4)}, [frame]
    while waiting:
        here = waiting.pop()
        for neighbour, T in poses[here].items():
            if neighbour not in found:
                found[neighbour] = found[here] @ T
                waiting.append(neighbour)
    return found


def _imu_frame(poses: Mapping[str, Any], given: Sequence[str], source: str) -> str:
    named = sorted({frame.strip("/") for frame in given if frame.strip("/")})
    known = [frame for frame in named if frame in poses]
    if named and not known:
        raise ExportError(f"{source}: no transform of the IMU's frame {named[0]!r}; {_frames(poses)}")
    candidates = known or [frame for frame in poses if "imu" in frame.lower()]
    if len(candidates) != 1:
        several = f"frames that may be the IMU's: {', '.join(candidates)}" if candidates else _frames(poses)
        raise ExportError(
            f"{source}: which frame is the IMU's? ({several}) Add a line `---`, then `imu_frame: NAME`"
        )
    return candidates[0]


def _camera_frame(name: str, info: CameraInfoMessage, imu: str, poses: Mapping[str, Any], source: str) -> str:
    wanted = info.frame_id.strip("/")
    for frame in (wanted, wanted + _OPTICAL, name, name + _OPTICAL):
        if frame in poses:
            return frame
    if len(poses) == 2:
        return next(frame for frame in poses if frame != imu)
    raise ExportError(f"{source}: no transform of the camera's frame {wanted!r}; {_frames(poses)}")


def _frames(poses: Mapping[str, Any]) -> str:
    return f"there are {', '.join(poses)}"


def _lens(info: CameraInfoMessage, name: str, source: str) -> tuple[str, tuple[float, ...]]:
    """Model and coefficients in our terms."""
    model, distortion = info.distortion_model, info.distortion
    if not (info.intrinsics[0] > 0.0 and info.intrinsics[1] > 0.0 and info.width > 0 and info.height > 0):
        raise ExportError(
            f"{source}: the CameraInfo of {name} is not calibrated (focal length or image size is 0)"
        )
    if not any(distortion):
        model, distortion = model if model in COEFFICIENTS else "radtan", ()
    elif model in ("plumb_bob", "radtan", "rational_polynomial") and not any(distortion[5:]):
        model = "plumb_bob" if any(distortion[4:]) else "radtan"
    if model not in COEFFICIENTS:
        raise ExportError(
            f"{source}: distortion model {model!r} of {name} is none of {', '.join(COEFFICIENTS)}"
        )
    count = len(COEFFICIENTS[model])
    if distortion and (len(distortion) < count or any(distortion[count:])):
        raise ExportError(
            f"{source}: {len(distortion)} distortion coefficients of {name}, {model} has {count}"
        )
    return model, tuple(distortion[:count]) if distortion else (0.0,) * count


def _documents(text: str, path: Path) -> list[dict[str, Any]]:
    parts: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.rstrip() == "---":
            parts.append([])
        elif not line.startswith("%YAML"):
            parts[-1].append(line)
    try:
        found = [parse("\n".join(part), path.name).root for part in parts]
    except ConfigError as error:
        raise ExportError(str(error)) from None
    return [document for document in found if document]


def _transform(entry: dict[str, Any]) -> Transform:
    p, q = entry["transform"]["translation"], entry["transform"]["rotation"]
    return Transform(
        0,
        str(entry["header"]["frame_id"]),
        str(entry["child_frame_id"]),
        (float(p["x"]), float(p["y"]), float(p["z"])),
        (float(q["w"]), float(q["x"]), float(q["y"]), float(q["z"])),
    )


def _of_camera_info(document: dict[str, Any]) -> CameraInfoMessage:
    k, d = ([float(x) for x in document[key if key in document else key.upper()]] for key in ("k", "d"))
    size = int(document["width"]), int(document["height"])
    info = _info(str(document["header"]["frame_id"]), size, k, str(document["distortion_model"]), d)
    roi = document.get("roi") or {}
    binning = int(document.get("binning_x") or 0), int(document.get("binning_y") or 0)
    x, y, width, height = (int(roi.get(key) or 0) for key in ("x_offset", "y_offset", "width", "height"))
    (width, height), intrinsics = of_the_image(size, info.intrinsics, binning, (x, y, width, height))
    return replace(info, width=width, height=height, intrinsics=intrinsics)


def _of_camera_info_manager(document: dict[str, Any]) -> CameraInfoMessage:
    k, d = ([float(x) for x in document[key]["data"]] for key in ("camera_matrix", "distortion_coefficients"))
    size = int(document["image_width"]), int(document["image_height"])
    return _info(str(document["camera_name"]), size, k, str(document["distortion_model"]), d)


def _info(frame: str, size: tuple[int, int], k: list[float], model: str, d: list[float]) -> CameraInfoMessage:
    if len(k) != 9:
        raise ValueError(f"the camera matrix has {len(k)} numbers, not 9")
    model = {"fisheye": "equidistant"}.get(model, model)
    return CameraInfoMessage(0, frame, *size, (k[0], k[4], k[2], k[5]), model, tuple(d))
