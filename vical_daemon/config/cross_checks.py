"""Checks of a config across values: contradictions between values, or with the hardware."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vical_daemon.estimation.geometry.camera_model import coefficients_error

if TYPE_CHECKING:
    from vical_daemon.config.model import BusConfig, CameraConfig, Config

NAMESPACE_LENGTH = 128
"""ROS 2 ends topics at 247 characters (RMW_TOPIC_MAX_NAME_LENGTH); our longest name takes 85 of them."""


def contradictions(config: Config) -> Iterator[tuple[str, str]]:
    """Yield (path, text) of each contradiction."""
    for name, imu in config.imus.items():
        if not imu.port.startswith("log:"):  # the rate of a recording is fixed
            yield from _check_gx3_rate(f"imus.{name}.rate_hz", imu.rate_hz)
    for name, camera in config.cameras.items():
        yield from _check_lens(f"cameras.{name}.lens", camera, config.calibration.fix)
    yield from _check_bus(config.bus)
    if config.ros2 is not None and len(config.ros2_namespace) > NAMESPACE_LENGTH:
        yield "ros2.namespace", f"longer than {NAMESPACE_LENGTH} characters"
    calibration = config.calibration
    if calibration.imu is not None and calibration.imu not in config.imus:
        yield (
            "calibration.imu",
            f"there is no IMU {calibration.imu} (known: {', '.join(config.imus) or 'none'})",
        )
    if calibration.imu is None and len(config.imus) > 1:
        yield "calibration", f"several IMUs; choose one with imu: {' or '.join(config.imus)}"
    for i, name in enumerate(calibration.cameras):
        if name not in config.cameras:
            known = ", ".join(config.cameras) or "none"
            yield f"calibration.cameras.{i}", f"there is no camera {name} (known: {known})"
    if calibration.mode == "target" and config.target is None and config.cameras:
        yield (
            "calibration.mode",
            "target needs `target: FILE` (`vical target` makes one), or mode: target_free",
        )
    if config.verify.recalibrate and config.verify.against != "store":
        yield "verify.recalibrate", "a new calibration goes to the store, so it needs `against: store`"


def _check_bus(bus: BusConfig) -> Iterator[tuple[str, str]]:
    """Check that the names of commanders and publishers are authenticated."""
    proven = bus.password_file or (bus.tls_ca and bus.tls_certificate)
    for key in ("commanders", "publishers"):
        if getattr(bus, key) and not proven:
            yield (
                f"bus.{key}",
                "clients cannot prove such a name; set password_file, or tls_ca and tls_certificate",
            )


def _check_gx3_rate(path: str, rate_hz: float) -> Iterator[tuple[str, str]]:
    """The GX3 divides 1000 Hz by a whole number."""
    divisor = max(1, round(1000 / rate_hz))
    if abs(1000 / divisor - rate_hz) > 0.01 * rate_hz:
        near = sorted({round(1000 / d, 2) for d in (int(1000 / rate_hz), int(1000 / rate_hz) + 1) if d > 0})
        yield path, f"{rate_hz:g} is not 1000/n; the device can do {' or '.join(f'{r:g}' for r in near)}"


def _check_lens(path: str, camera: CameraConfig, fix: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    lens = camera.lens
    if lens.intrinsics is not None:
        for i, (centre, size) in enumerate(zip(lens.intrinsics[2:], camera.size, strict=True)):
            if not 0 <= centre <= size:
                yield (
                    f"{path}.intrinsics",
                    f"the principal point {'xy'[i]} = {centre:g} lies outside 0..{size}",
                )
    if lens.T_cam_imu is not None and (text := rigid_error(lens.T_cam_imu)):
        yield f"{path}.T_cam_imu", text
    model = lens.distortion_model
    if lens.distortion_coeffs is not None and (text := coefficients_error(model, lens.distortion_coeffs)):
        yield f"{path}.distortion_coeffs", text
    if lens.distortion_sigma is not None and (text := coefficients_error(model, lens.distortion_sigma)):
        yield f"{path}.distortion_sigma", text
    needed = {
        "intrinsics": ("intrinsics", lens.intrinsics),
        "extrinsics": ("T_cam_imu", lens.T_cam_imu),
        "timeshift": ("timeshift_cam_imu", lens.timeshift_cam_imu),
    }
    for what in fix:
        key, value = needed[what]
        if value is None:
            yield path, f"calibration.fix holds {what}, so {key} must be given here"


def rigid_error(matrix: Sequence[Sequence[float]]) -> str:
    """Return the problem with a 4x4 rigid transform, "" if none."""
    T = np.asarray(matrix)
    R = T[:3, :3]
    if not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
        return "the last row must be 0 0 0 1"
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        return "the upper left 3x3 block is not a rotation"
    if np.abs(T[:3, 3]).max() > 10:
        return "the camera lies more than 10 m from the IMU; the unit is m"
    return ""
