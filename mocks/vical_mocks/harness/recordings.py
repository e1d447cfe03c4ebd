"""Recordings of others as an estimator takes them, and what their Kalibr files say of the camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vical_daemon.bus.messages import ImuMessage, decode_imu, decode_points
from vical_daemon.estimation.measurements import ImuNoise, PointsFrame
from vical_daemon.estimation.target_free import TargetFreeCalibrator
from vical_daemon.logs import open_recording

Items = list[tuple[int, ImuMessage | PointsFrame]]
Figures = tuple[float, float, float]
# OpenVINS's own RMS on such data, from its README in the data folder: deg, mm, ms
OPENVINS: dict[float, Figures] = {
    10.0: (0.060, 7.2, 0.050),
    30.0: (0.034, 4.6, 0.020),
    60.0: (0.031, 3.6, 0.020),
    120.0: (0.019, 2.1, 0.018),
}


def read(folder: Path) -> Items:
    """All messages by stamp; inertial ones first where stamps are equal."""
    items: list[tuple[int, int, ImuMessage | PointsFrame]] = []
    for key, payload in open_recording(folder).messages():
        if "/imu/" in key:
            imu = decode_imu(payload)
            items.append((imu.stamp_ns, 0, imu))
        elif key.endswith(("/points", "/tracks")):
            frame = decode_points(payload).to_frame()
            items.append((frame.t_cam_ns, 1, frame))
    items.sort(key=lambda item: item[:2])
    return [(t, item) for t, _, item in items]


def feed(calibrator: TargetFreeCalibrator, items: Items, begin_s: float, end_s: float) -> None:
    """Give a part of a recording, seconds from its first message on, to the calibrator of `cam0`."""
    for t_ns, item in items:
        if not begin_s <= (t_ns - items[0][0]) * 1e-9 <= end_s:
            continue
        if isinstance(item, PointsFrame):
            calibrator.add_points(replace(item, camera="cam0"))
            calibrator.process()
        else:
            calibrator.add_imu(item.stamp_ns, item.gyro_rps, item.specific_force_mps2)


def camera_of(path: Path) -> dict[str, Any]:
    """First camera of a Kalibr file, with T_imu_cam; the imu's densities under `noise`."""
    document = yaml.safe_load(path.read_text(encoding="utf-8"))
    camera: dict[str, Any] = dict(document["cam0"])
    if "T_cam_imu" in camera:
        T = np.array(camera["T_cam_imu"])
        camera["R"], camera["p"] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    imu = document.get("imu0")
    if imu:
        names = (
            "gyroscope_noise_density",
            "gyroscope_random_walk",
            "accelerometer_noise_density",
            "accelerometer_random_walk",
        )
        gyro, gyro_walk, accel, accel_walk = (float(imu[n]) for n in names)
        camera["noise"] = ImuNoise(gyro, gyro_walk, accel, accel_walk, float(imu["rate_hz"]))
    return camera
