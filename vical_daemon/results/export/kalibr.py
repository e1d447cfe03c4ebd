"""Kalibr: camchain-imucam.yaml and imu.yaml, written and read.

Kalibr's conventions: `T_cam_imu` takes imu coordinates to camera coordinates (the inverse of our
`T_imu_cam`); `timeshift_cam_imu` has our sign, t_imu = t_cam + shift; `T_cn_cnm1` takes coordinates of the
camera before to this one.
"""

from __future__ import annotations

from pathlib import Path

from vical_daemon.config.priors import Initial, is_camera, priors_in
from vical_daemon.config.strict_yaml import ConfigError, Document, Value, read
from vical_daemon.estimation.measurements import CameraPrior, ImuNoise
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

    The sections of cameras and IMUs are checked as those of `--initial`; other keys of the file are left out.

    Raises:
        ExportError: Not such a file; the message says which key is missing or wrong.
    """
    document, imu = _document(path), None
    if isinstance(named := document.root.get("relative_config_imucam"), str):  # OpenVINS's estimator_config
        if isinstance(of_imu := document.root.get("relative_config_imu"), str):
            imu = _document(_named_by(path, of_imu))
        path = _named_by(path, named)
        document = _document(path)
    names = [name for name, section in document.root.items() if is_camera(name, section)]
    if not names:
        raise ExportError(f"{path}: no camera (cam0: …) in it; is it a Kalibr camchain?")
    priors = _priors(document)
    cameras = {name: _rig_camera(name, priors.cameras[name], document.root[name], path) for name in names}
    noise = (priors if imu is None else _priors(imu)).imu_noise or ImuNoise()
    return Rig(cameras, noise=noise, note=f"from {path.name} (Kalibr)")


def _document(path: Path) -> Document:
    """Parse a file, and keep the sections of cameras and IMUs and what names other files."""
    try:
        document = read(path)
    except ConfigError as error:
        raise ExportError(str(error)) from None
    document.root = {
        key: value
        for key, value in document.root.items()
        if (isinstance(value, dict) and (key.startswith("imu") or is_camera(key, value)))
        or key.startswith("relative_config")
    }
    return document


def _priors(document: Document) -> Initial:
    document.root = {key: value for key, value in document.root.items() if isinstance(value, dict)}
    try:
        return priors_in(document)
    except ConfigError as error:
        raise ExportError(str(error)) from None


def _named_by(path: Path, name: str) -> Path:
    named = path.parent / name
    if not named.is_file():
        raise ExportError(f"{path}: it names {name}, which is not next to it")
    return named


def _rig_camera(name: str, prior: CameraPrior, section: Value, path: Path) -> RigCamera:
    """Make a camera of a prior that has everything but, perhaps, the time shift."""
    assert isinstance(section, dict)
    if prior.T_imu_cam is None:
        raise ExportError(f"{path}: {name} has no T_cam_imu; run the camera-imu step of Kalibr first")
    needed = {"intrinsics", "resolution"}
    if section.get("distortion_model") != "none":
        needed.add("distortion_coeffs")
    for key in sorted(needed):
        if section.get(key) is None:
            raise ExportError(f"{path}: {name} has no {key}")
    assert prior.intrinsics is not None
    return RigCamera(
        name=name,
        R_imu_cam=prior.T_imu_cam[0],
        p_imu_cam=prior.T_imu_cam[1],
        timeshift_cam_imu_s=prior.timeshift_cam_imu_s or 0.0,
        intrinsics=prior.intrinsics,
        distortion_model=prior.distortion_model,
        distortion=tuple(prior.coefficients()),
        resolution=prior.resolution,
        readout_s=prior.readout_s,
        readout_axis=prior.readout_axis,
        topic=str(section.get("rostopic") or ""),
    )
