"""Makes a rig from a result: from JSON, or from an estimate."""

from __future__ import annotations

from typing import Any

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS, RADTAN
from vical_daemon.estimation.measurements import FloatArray, ImuNoise
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.results.export.rig import ExportError, Rig, RigCamera


def rig_from_estimate(
    estimate: CalibrationEstimate,
    resolutions: dict[str, tuple[int, int]] | None = None,
    note: str = "",
) -> Rig:
    """Make a rig from an estimate.

    Args:
        estimate: The estimate.
        resolutions: Image sizes by camera name (an estimate that came over the bus does not hold them).
        note: Comment for the files.

    Raises:
        ExportError: See `rig_from_json`.
    """
    document = estimate.to_json()
    for name, size in (resolutions or {}).items():
        if name in document["cameras"]:
            document["cameras"][name]["resolution"] = list(size)
    return rig_from_json(document, note)


def rig_from_json(document: dict[str, Any], note: str = "") -> Rig:
    """Make a rig from a result as `vical calibrate --json` prints it (or as `vical export --format json`).

    Raises:
        ExportError: Not a result, or one without a solution; the message says which key is wrong.
    """
    cameras = document.get("cameras")
    if not isinstance(cameras, dict):
        raise ExportError('no key "cameras": this is not a result of `vical calibrate --json`')
    rig_cameras = {name: _camera(name, entry) for name, entry in cameras.items()}
    imu = document.get("imu") or {}
    gravity = document.get("gravity_world_mps2") or []
    magnitude = (
        float(np.linalg.norm(gravity)) if len(gravity) == 3 else float(document.get("gravity_mps2", 9.80665))
    )
    return Rig(
        cameras=rig_cameras,
        noise=_noise(imu.get("noise")),
        gyro_bias_rps=_array(imu, "gyro_bias_rps", (3,), np.zeros(3)),
        accel_bias_mps2=_array(imu, "accel_bias_mps2", (3,), np.zeros(3)),
        gyro_matrix=_array(imu, "gyro_matrix", (3, 3), np.eye(3)),
        accel_matrix=_array(imu, "accel_matrix", (3, 3), np.eye(3)),
        gravity_mps2=magnitude,
        imu_frame=str(imu.get("name") or "imu"),
        note=note or str(document.get("note", "")),
        status=str(document.get("status") or ""),
        reason=str(document.get("reason") or document.get("guidance") or ""),
        t_ns=int(document.get("t_ns") or 0),
        devices={str(k): str(v) for k, v in (document.get("devices") or {}).items()},
        duration_s=float(document.get("duration_s") or 0.0),
        reading_hashes=tuple(int(value) for value in document.get("reading_hashes") or ()),
        fixed=tuple(str(what) for what in document.get("fixed") or ()),
        bias_sigmas=_bias_sigmas(imu),
    )


def _bias_sigmas(imu: dict[str, Any]) -> FloatArray | None:
    sigmas = [*(imu.get("gyro_bias_sigma_rps") or ()), *(imu.get("accel_bias_sigma_mps2") or ())]
    return np.array(sigmas, dtype=np.float64) if len(sigmas) == 6 else None


def _camera(name: str, entry: Any) -> RigCamera:
    try:
        pose = entry["T_imu_cam"]
        q = np.array(pose["q_wxyz"], dtype=np.float64)
        p = np.array(pose["p_m"], dtype=np.float64)
        covariance = pose.get("covariance")
        fx, fy, cx, cy = (float(v) for v in entry["intrinsics"])
        model = str(entry.get("distortion_model") or RADTAN)
        distortion = tuple(float(v) for v in entry["distortion"])
        if len(distortion) != len(COEFFICIENTS.get(model, ())):
            raise ValueError(f"{len(distortion)} distortion coefficients for {model!r}")
        size = entry.get("resolution")
        sigma = entry.get("timeshift_sigma_s")
        lens_sigma = [*(entry.get("intrinsics_sigma") or ()), *(entry.get("distortion_sigma") or ())]
        joint, n = entry.get("calibration_covariance"), 11 + len(distortion)
        camera = RigCamera(
            name=name,
            R_imu_cam=so3.matrix_from_quat(q / np.linalg.norm(q)),
            p_imu_cam=p,
            timeshift_cam_imu_s=float(entry["timeshift_cam_imu_s"]),
            intrinsics=(fx, fy, cx, cy),
            distortion_model=model,
            distortion=distortion,
            resolution=None if not size else (int(size[0]), int(size[1])),
            covariance=None if not covariance else np.array(covariance, dtype=np.float64).reshape(6, 6),
            timeshift_sigma_s=None if sigma is None else float(sigma),
            readout_s=float(entry.get("readout_s") or 0.0),
            readout_axis=str(entry.get("readout_axis") or ""),
            topic=str(entry.get("topic") or ""),
            unobservable=tuple(entry.get("unobservable") or ()),
            lens_sigma=tuple(float(v) for v in lens_sigma) if len(lens_sigma) == n - 7 else (),
            calibration_covariance=None if not joint else np.array(joint, dtype=np.float64).reshape(n, n),
            model_fits=entry.get("model_fits"),
        )
    except KeyError as error:
        raise ExportError(f"cameras.{name}: no key {error}") from error
    except (TypeError, ValueError, IndexError) as error:
        raise ExportError(f"cameras.{name}: a value is not of the expected form ({error})") from error
    if p.shape != (3,) or q.shape != (4,) or not np.all(np.isfinite([*p, *q])):
        raise ExportError(f"cameras.{name}.T_imu_cam needs 3 + 4 finite numbers")
    return camera


def _array(entry: dict[str, Any], key: str, shape: tuple[int, ...], default: FloatArray) -> FloatArray:
    value = entry.get(key)
    if not value:
        return default
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ExportError(f"imu.{key} must have the shape {shape}, found {array.shape}")
    return array


def _noise(entry: Any) -> ImuNoise:
    if not isinstance(entry, dict):
        return ImuNoise()
    known = {k: float(v) for k, v in entry.items() if k in ImuNoise.__dataclass_fields__}
    return ImuNoise(**known)
