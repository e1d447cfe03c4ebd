"""Kalibr: camchain-imucam.yaml and imu.yaml, written and read.

Kalibr's conventions: `T_cam_imu` takes imu coordinates to camera coordinates (the inverse of our
`T_imu_cam`); `timeshift_cam_imu` has our sign, t_imu = t_cam + shift; `T_cn_cnm1` takes coordinates of the
camera before to this one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from vical_drivers.user_files import read_text

from vical_daemon.config.strict_yaml import MAX_BYTES, ConfigError, refuse_hostile
from vical_daemon.estimation.measurements import FloatArray, ImuNoise
from vical_daemon.results.export.rig import ExportError, Rig, RigCamera
from vical_daemon.results.export.text import comment, matrix_rows, number, row


def write_camchain(rig: Rig) -> str:
    """Write camchain-imucam.yaml: cam0, cam1, … in the order of the rig (Kalibr knows no other names)."""
    parts = [comment(rig.header)]
    before: RigCamera | None = None
    for index, camera in enumerate(rig.cameras.values()):
        parts.append(f"cam{index}:" + ("" if camera.name == f"cam{index}" else f"  # {camera.name}") + "\n")
        if before is not None:
            T_cn_cnm1 = camera.T_cam_imu @ before.T_imu_cam
            parts.append(f"  T_cn_cnm1:\n{matrix_rows(T_cn_cnm1, 4)}\n")
        parts.append(_camera(camera, index))
        before = camera
    return "".join(parts)


def _camera(camera: RigCamera, index: int) -> str:
    return (
        f"  T_cam_imu:\n{matrix_rows(camera.T_cam_imu, 4)}\n"
        "  cam_overlaps: []\n"
        "  camera_model: pinhole\n"
        f"  distortion_coeffs: {row(camera.distortion)}\n"
        f"  distortion_model: {camera.distortion_model}\n"
        f"  intrinsics: {row(camera.intrinsics)}\n"
        f"  resolution: [{camera.size[0]}, {camera.size[1]}]\n"
        f"  rostopic: {camera.topic or f'/cam{index}/image_raw'}\n"
        f"  timeshift_cam_imu: {number(camera.timeshift_cam_imu_s)}\n"
    )


def write_imu(noise: ImuNoise, topic: str = "/imu0", note: str = "") -> str:
    """Write Kalibr's imu.yaml: continuous-time densities, SI units."""
    return (
        comment(note) + f"rostopic: {topic}\n"
        f"update_rate: {number(noise.rate_hz)}  # Hz\n"
        f"accelerometer_noise_density: {number(noise.accel_density)}  # m/s^2/sqrt(Hz)\n"
        f"accelerometer_random_walk: {number(noise.accel_walk)}  # m/s^3/sqrt(Hz)\n"
        f"gyroscope_noise_density: {number(noise.gyro_density)}  # rad/s/sqrt(Hz)\n"
        f"gyroscope_random_walk: {number(noise.gyro_walk)}  # rad/s^2/sqrt(Hz)\n"
    )


def read_camchain(path: Path) -> Rig:
    """Read camchain-imucam.yaml (every camera needs its own T_cam_imu, or a chain to one), or OpenVINS's.

    Raises:
        ExportError: Not such a file; the message says which key is missing or wrong.
    """
    blocks, imu = _mapping(path), None
    if isinstance(named := blocks.get("relative_config_imucam"), str):  # OpenVINS's estimator_config.yaml
        if isinstance(blocks.get("relative_config_imu"), str):
            imu = _mapping(_named_by(path, blocks["relative_config_imu"]))
        path = _named_by(path, named)
        blocks = _mapping(path)
    names = sorted(k for k in blocks if isinstance(k, str) and k.startswith("cam"))
    if not names:
        raise ExportError(f"{path}: no camera (cam0: …) in it; is it a Kalibr camchain?")
    cameras: dict[str, RigCamera] = {}
    before: FloatArray | None = None
    for name in names:
        camera = _read_camera(name, blocks[name], before, path)
        cameras[name] = camera
        before = camera.T_cam_imu
    return Rig(cameras, noise=_noise_in(imu or blocks), note=f"from {path.name} (Kalibr)")


def _mapping(path: Path) -> dict[str, Any]:
    try:
        text = read_text(path, MAX_BYTES).removeprefix("%YAML:1.0")  # OpenCV's first line, in OpenVINS's file
        refuse_hostile(text, path.name)
        document = yaml.safe_load(text)
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror or error}") from None
    except (ConfigError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ExportError(f"{path}: cannot be read as YAML: {' '.join(str(error).split())}") from error
    return document if isinstance(document, dict) else {}


def _named_by(path: Path, name: str) -> Path:
    named = path.parent / name
    if not named.is_file():
        raise ExportError(f"{path}: it names {name}, which is not next to it")
    return named


def _read_camera(name: str, block: Any, T_before_imu: FloatArray | None, path: Path) -> RigCamera:
    if not isinstance(block, dict):
        raise ExportError(f"{path}: {name} must be a section")
    if block.get("camera_model", "pinhole") != "pinhole":
        raise ExportError(
            f"{path}: {name}.camera_model {block['camera_model']!r} is not known here, only pinhole"
        )
    model = str(block.get("distortion_model", "radtan"))
    if model not in ("radtan", "equidistant"):
        raise ExportError(f"{path}: {name}.distortion_model {model!r} is neither radtan nor equidistant")
    if "T_cam_imu" in block:
        T_cam_imu = _matrix(block["T_cam_imu"], f"{name}.T_cam_imu", path)
    elif "T_imu_cam" in block:  # OpenVINS
        T_cam_imu = np.asarray(np.linalg.inv(_matrix(block["T_imu_cam"], f"{name}.T_imu_cam", path)))
    elif "T_cn_cnm1" in block and T_before_imu is not None:
        T_cam_imu = _matrix(block["T_cn_cnm1"], f"{name}.T_cn_cnm1", path) @ T_before_imu
    else:
        raise ExportError(f"{path}: {name} has no T_cam_imu; run the camera-imu step of Kalibr first")
    fx, fy, cx, cy = _numbers(block, "intrinsics", 4, name, path)
    distortion = tuple(_numbers(block, "distortion_coeffs", 4, name, path))
    width, height = _numbers(block, "resolution", 2, name, path)
    return RigCamera(
        name=name,
        R_imu_cam=T_cam_imu[:3, :3].T,
        p_imu_cam=-T_cam_imu[:3, :3].T @ T_cam_imu[:3, 3],
        timeshift_cam_imu_s=_number(block, "timeshift_cam_imu", name, path),
        intrinsics=(fx, fy, cx, cy),
        distortion_model=model,
        distortion=distortion,
        resolution=(int(width), int(height)),
        topic=str(block.get("rostopic", "")),
    )


def _matrix(value: Any, what: str, path: Path) -> FloatArray:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4):
        raise ExportError(f"{path}: {what} must be a 4x4 matrix of numbers")
    if not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-4):
        raise ExportError(f"{path}: the rotation in {what} is not orthonormal")
    return matrix


def _numbers(block: dict[str, Any], key: str, count: int, name: str, path: Path) -> list[float]:
    values = block.get(key)
    try:
        numbers = [float(v) for v in values] if isinstance(values, list) else []
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != count:
        raise ExportError(f"{path}: {name}.{key} must be a list of {count} numbers")
    return numbers


def _number(block: dict[str, Any], key: str, name: str, path: Path) -> float:
    value = block.get(key, 0.0)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ExportError(f"{path}: {name}.{key} must be a number") from None


def _noise_in(blocks: dict[str, Any]) -> ImuNoise:
    """Read imu0 where the file has it (some tools join both files)."""
    imu = blocks.get("imu0")
    if not isinstance(imu, dict):
        return ImuNoise()
    names = {
        "gyroscope_noise_density": "gyro_density",
        "gyroscope_random_walk": "gyro_walk",
        "accelerometer_noise_density": "accel_density",
        "accelerometer_random_walk": "accel_walk",
        "update_rate": "rate_hz",
        "rate_hz": "rate_hz",
    }
    try:
        return ImuNoise(**{ours: float(imu[key]) for key, ours in names.items() if key in imu})
    except (TypeError, ValueError):
        raise ExportError("imu0: noise densities and rates must be numbers") from None
