"""Priors of the estimator, from the config or from Kalibr's files.

Kalibr's camchain.yaml (`cam0: intrinsics, T_cam_imu, timeshift_cam_imu, ...`) and imu.yaml keys, at the top
level or under `imu0`, and OpenVINS's variants of both; every key is optional. A camera with `T_cn_cnm1` alone
is placed by the camera before it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from vical_daemon.config import validation as schema
from vical_daemon.config.cross_checks import rigid_error
from vical_daemon.config.foreign_files import foreign_file
from vical_daemon.config.model import Config, Focal, LensConfig, Matrix4, Sigma
from vical_daemon.config.strict_yaml import MAX_BYTES, ConfigError, Document, Value, read
from vical_daemon.config.validation import Bound
from vical_daemon.estimation.geometry.camera_model import RADTAN, coefficients_error
from vical_daemon.estimation.measurements import (
    CalibrationOptions,
    CameraPrior,
    ConvergenceTargets,
    FloatArray,
    ImuNoise,
    gravity_sigma_mps2,
)

Density = Annotated[float, Bound(above=0, high=10.0)]


@dataclass(frozen=True, slots=True)
class _KalibrCamera:
    """Keys of one camera in a Kalibr camchain, and ours; those below `resolution` are ignored."""

    camera_model: Literal["pinhole"] = "pinhole"
    distortion_model: Literal["radtan", "plumb_bob", "equidistant", "none"] = "radtan"
    intrinsics: tuple[Focal, Focal, float, float] | None = None
    distortion_coeffs: tuple[float, ...] | None = None
    intrinsics_sigma: tuple[Sigma, Sigma, Sigma, Sigma] | None = None
    distortion_sigma: tuple[Sigma, ...] | None = None
    T_cam_imu: Matrix4 | None = None
    T_imu_cam: Matrix4 | None = None  # OpenVINS
    timeshift_cam_imu: Annotated[float, Bound(low=-5, high=5, hint="seconds")] | None = None
    line_delay: Annotated[float, Bound(low=0, high=1e-3, hint="seconds a line")] | None = None
    readout_s: Annotated[float, Bound(low=0, high=0.2)] | None = None
    readout_axis: Literal["rows", "columns"] | None = None
    resolution: tuple[Annotated[int, Bound(low=16)], Annotated[int, Bound(low=16)]] | None = None
    rostopic: str | None = None
    cam_overlaps: tuple[int, ...] | None = None
    T_cn_cnm1: Matrix4 | None = None


@dataclass(frozen=True, slots=True)
class _KalibrImu:
    """The keys of one IMU in Kalibr's imu.yaml; those below `rate_hz` are accepted and ignored."""

    gyroscope_noise_density: Density = ImuNoise().gyro_density
    gyroscope_random_walk: Density = ImuNoise().gyro_walk
    accelerometer_noise_density: Density = ImuNoise().accel_density
    accelerometer_random_walk: Density = ImuNoise().accel_walk
    update_rate: Annotated[float, Bound(low=1, high=10000)] | None = None
    rate_hz: Annotated[float, Bound(low=1, high=10000)] | None = None
    rostopic: str | None = None
    model: str | None = None
    T_i_b: Matrix4 | None = None
    time_offset: float | None = None


_CAMERA_KEYS = {f.name for f in fields(_KalibrCamera)} - {f.name for f in fields(_KalibrImu)}
_OTHER_LENSES = ("omni", "eucm", "ds")
"""Camera models of Kalibr that we lack."""
_RESULTS_OF_IMU = (
    *("Tw", "Ta", "Tg", "R_IMUtoGYRO", "R_IMUtoACC", "R_GYROtoIMU", "R_ACCtoIMU"),  # OpenVINS
    *("accelerometers", "gyroscopes"),  # Kalibr
)
"""Keys with matrices of the IMU: no prior, they are found from the data."""


@dataclass(frozen=True, slots=True)
class Initial:
    """Contents of an `--initial` file.

    Attributes:
        cameras: Prior by camera name; resolution (0, 0) if the file does not give it.
        imu_noise: None if the file has no IMU keys.
        imu_rate_hz: None if the file does not give it.
        topics: `rostopic` by camera name, where it is given.
    """

    cameras: dict[str, CameraPrior] = field(default_factory=dict)
    imu_noise: ImuNoise | None = None
    imu_rate_hz: float | None = None
    topics: dict[str, str] = field(default_factory=dict)


def is_camera(name: str, section: Value) -> bool:
    """Whether a section is a camera: cam0, or of any other name with keys that only cameras have."""
    return name.startswith("cam") or (
        not name.startswith("imu") and isinstance(section, dict) and not _CAMERA_KEYS.isdisjoint(section)
    )


def read_initial(path: Path | str) -> Initial:
    """Read a Kalibr camchain, imu.yaml, or both in one file.

    Raises:
        ConfigError: It cannot be used; one line.
    """
    try:
        return priors_in(read(Path(path)))
    except ConfigError as error:
        if text := foreign_file(Path(path), MAX_BYTES, as_prior=True):
            raise ConfigError(text) from None
        raise error


def priors_in(document: Document) -> Initial:
    """Return the priors of a parsed camchain, imu.yaml, or both in one document.

    Raises:
        ConfigError: It cannot be used; one line.
    """
    cameras: dict[str, CameraPrior] = {}
    steps: dict[str, Matrix4] = {}
    topics: dict[str, str] = {}
    imu: _KalibrImu | None = None
    sections = [document.root, *(value for value in document.root.values() if isinstance(value, dict))]
    for section in sections:
        for key in _RESULTS_OF_IMU:
            section.pop(key, None)
    loose: dict[str, Value] = {
        key: value for key, value in document.root.items() if not isinstance(value, dict)
    }
    if loose:  # Kalibr's own imu.yaml has its keys at the top level
        imu = schema.build(Document(document.name, loose, document.lines), _KalibrImu)
    for name, content in document.root.items():
        if name in loose:
            continue
        if is_camera(name, content):
            _refuse_other_lenses(document, name)
            camera = schema.build(document, _KalibrCamera, name)
            cameras[name] = _camera_prior(document, name, camera)
            if camera.rostopic:
                topics[name] = camera.rostopic
            if camera.T_cn_cnm1:
                steps[name] = camera.T_cn_cnm1
        elif name.startswith("imu"):
            imu = imu or schema.build(document, _KalibrImu, name)
        else:
            raise ConfigError(
                f"{name}: unknown section; expected cameras (cam0, cam1 ...) or imu0 ({document.where(name)})"
            )
    noise, rate_hz = _noise(imu) if imu is not None else (None, None)
    return Initial(_along_the_chain(cameras, steps), noise, rate_hz, topics)


def camera_prior(config: Config, name: str) -> CameraPrior:
    """Return the prior of one camera of a config."""
    camera = config.cameras[name]
    lens: LensConfig = camera.lens
    return CameraPrior(
        resolution=camera.size,
        intrinsics=lens.intrinsics,
        distortion_model=lens.distortion_model,
        distortion=lens.distortion_coeffs,
        T_imu_cam=_inverse(lens.T_cam_imu),
        timeshift_cam_imu_s=lens.timeshift_cam_imu,
        readout_s=lens.readout_s,
        readout_axis=lens.readout_axis or "",
        intrinsics_sigma=lens.intrinsics_sigma,
        distortion_sigma=lens.distortion_sigma,
    )


def calibration_options(config: Config) -> CalibrationOptions:
    """Return the estimator's options of a config."""
    calibration = config.calibration
    wanted = calibration.convergence
    imu = config.imus[config.calibration_imu] if config.imus else None
    noise = ImuNoise()
    if imu is not None:
        n = imu.noise
        noise = ImuNoise(n.gyro_density, n.gyro_walk, n.accel_density, n.accel_walk, imu.rate_hz)
    return CalibrationOptions(
        fix=frozenset(calibration.fix),
        estimate=frozenset(calibration.estimate),
        target_free=calibration.mode == "target_free",
        gravity_mps2=calibration.gravity_mps2,
        gravity_sigma_mps2=gravity_sigma_mps2(calibration.gravity_mps2),
        corner_sigma_px=calibration.corner_sigma_px,
        imu_noise=noise,
        targets=ConvergenceTargets(
            wanted.position_sigma_m, math.radians(wanted.rotation_sigma_deg), wanted.timeshift_sigma_s
        ),
    )


def _refuse_other_lenses(document: Document, name: str) -> None:
    section = document.root[name]
    model = section.get("camera_model") if isinstance(section, dict) else None
    if model in _OTHER_LENSES:
        text = (
            f"{model} lenses are not supported, only pinhole with radtan or equidistant distortion: "
            "calibrate as pinhole-equi, or for --initial leave camera_model, intrinsics and distortion out"
        )
        raise ConfigError(schema.mistake(document, f"{name}.camera_model", text))


def _camera_prior(document: Document, name: str, camera: _KalibrCamera) -> CameraPrior:
    model = RADTAN if camera.distortion_model == "none" else camera.distortion_model
    coefficients = None if camera.distortion_model == "none" else camera.distortion_coeffs
    if coefficients is not None and (text := coefficients_error(model, coefficients)):
        raise ConfigError(schema.mistake(document, f"{name}.distortion_coeffs", text))
    if camera.distortion_sigma is not None and (text := coefficients_error(model, camera.distortion_sigma)):
        raise ConfigError(schema.mistake(document, f"{name}.distortion_sigma", text))
    for key in ("T_cam_imu", "T_imu_cam", "T_cn_cnm1"):
        matrix: Matrix4 | None = getattr(camera, key)
        if matrix is not None and (text := rigid_error(matrix)):
            raise ConfigError(schema.mistake(document, f"{name}.{key}", text))
    if camera.T_cam_imu and camera.T_imu_cam:
        text = "T_cam_imu is given, too; one is the inverse of the other: remove one"
        raise ConfigError(schema.mistake(document, f"{name}.T_imu_cam", text))
    resolution = camera.resolution or (0, 0)
    readout_s = camera.readout_s or (camera.line_delay or 0.0) * resolution[camera.readout_axis != "columns"]
    return CameraPrior(
        resolution=resolution,
        intrinsics=camera.intrinsics,
        distortion_model=model,
        distortion=coefficients,
        T_imu_cam=_inverse(camera.T_cam_imu) or _pose(camera.T_imu_cam),
        timeshift_cam_imu_s=camera.timeshift_cam_imu,
        readout_s=readout_s,
        readout_axis=camera.readout_axis or "",
        intrinsics_sigma=camera.intrinsics_sigma,
        distortion_sigma=camera.distortion_sigma,
    )


def _along_the_chain(cameras: dict[str, CameraPrior], steps: Mapping[str, Matrix4]) -> dict[str, CameraPrior]:
    """Place cameras without a pose of their own: T_imu_cn = T_imu_cnm1 T_cn_cnm1^-1, cam9 before cam10."""
    before: CameraPrior | None = None
    for name in sorted(cameras, key=_number_in):
        step = _inverse(steps.get(name))
        if cameras[name].T_imu_cam is None and before is not None and before.T_imu_cam and step:
            (R_imu_before, p_imu_before), (R_before_cam, p_before_cam) = before.T_imu_cam, step
            pose = R_imu_before @ R_before_cam, p_imu_before + R_imu_before @ p_before_cam
            cameras[name] = replace(cameras[name], T_imu_cam=pose)
        before = cameras[name]
    return cameras


def _number_in(name: str) -> tuple[int, str]:
    digits = re.search(r"\d+", name)
    return (int(digits[0]) if digits else -1), name


def _noise(imu: _KalibrImu) -> tuple[ImuNoise, float | None]:
    rate_hz = imu.rate_hz or imu.update_rate
    noise = ImuNoise(
        imu.gyroscope_noise_density,
        imu.gyroscope_random_walk,
        imu.accelerometer_noise_density,
        imu.accelerometer_random_walk,
        rate_hz or ImuNoise().rate_hz,
    )
    return noise, rate_hz


def _pose(T_imu_cam: Matrix4 | None) -> tuple[FloatArray, FloatArray] | None:
    """Turn a matrix into (R_imu_cam, p_imu_cam); the rotation is made exactly orthonormal."""
    if T_imu_cam is None:
        return None
    T = np.asarray(T_imu_cam, dtype=np.float64)
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return U @ Vt, T[:3, 3]


def _inverse(T_cam_imu: Matrix4 | None) -> tuple[FloatArray, FloatArray] | None:
    """Turn Kalibr's T_cam_imu into (R_imu_cam, p_imu_cam), see `_pose`."""
    pose = _pose(T_cam_imu)
    if pose is None:
        return None
    R_cam_imu, p_cam_imu = pose
    return R_cam_imu.T, -R_cam_imu.T @ p_cam_imu
