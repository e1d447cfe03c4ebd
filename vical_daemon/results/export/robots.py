"""ROS camera_info and URDF, Basalt's JSON, and our own JSON."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.results.export.rig import Rig, RigCamera
from vical_daemon.results.export.text import comment, number, row


def write_camera_info(camera: RigCamera, rig: Rig) -> str:
    """Write a camera_info YAML as camera_calibration_parsers reads it (intrinsics alone)."""
    width, height = camera.size
    fx, fy, cx, cy = camera.intrinsics
    fisheye = camera.distortion_model == "equidistant"
    coefficients = list(camera.distortion) + ([0.0] if camera.distortion_model == "radtan" else [])
    model = "equidistant" if fisheye else "plumb_bob"
    x, y, z = camera.p_imu_cam
    qw, qx, qy, qz = so3.quat_from_matrix(camera.R_imu_cam)
    transform = " ".join(
        f"--{k} {number(v)}"
        for k, v in zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (x, y, z, qx, qy, qz, qw), strict=True)
    )
    return (
        comment(rig.header)
        + f"# t_imu = t_cam + {number(camera.timeshift_cam_imu_s)} s\n"
        + f"# ros2 run tf2_ros static_transform_publisher {transform} "
        + f"--frame-id {rig.imu_frame} --child-frame-id {camera.name}\n"
        + f"image_width: {width}\nimage_height: {height}\ncamera_name: {camera.name}\n"
        + _ros_matrix("camera_matrix", 3, 3, [fx, 0, cx, 0, fy, cy, 0, 0, 1])
        + f"distortion_model: {model}\n"
        + _ros_matrix("distortion_coefficients", 1, len(coefficients), coefficients)
        + _ros_matrix("rectification_matrix", 3, 3, [1, 0, 0, 0, 1, 0, 0, 0, 1])
        + _ros_matrix("projection_matrix", 3, 4, [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0])
    )


def _ros_matrix(name: str, rows: int, cols: int, values: list[float]) -> str:
    return f"{name}:\n  rows: {rows}\n  cols: {cols}\n  data: {row(values)}\n"


def write_urdf(rig: Rig) -> str:
    """Write fixed joints from the imu to every camera.

    The frames are named as on the bus: a camera's frame is the `frame_id` of its images; it is what ROS
    calls an optical frame (z forward, x right). The joint's origin is the child in the parent: our
    T_imu_cam. URDF's rpy is R = Rz(y) Ry(p) Rx(r). URDF has no place for a time shift.
    """
    from scipy.spatial.transform import Rotation  # takes 0.3 s to load, also where nothing is exported

    lines = ['<?xml version="1.0"?>', '<robot name="vical_rig">']
    lines += [f"  <!-- {_xml_comment(line)} -->" for line in rig.header.splitlines()]
    lines.append(f'  <link name="{rig.imu_frame}"/>')
    for camera in rig.cameras.values():
        frame = camera.name
        rpy = Rotation.from_matrix(camera.R_imu_cam).as_euler("xyz")
        lines += [
            f"  <!-- {frame}: optical frame (z forward, x right); "
            f"t_imu = t_cam + {number(camera.timeshift_cam_imu_s)} s -->",
            f'  <link name="{frame}"/>',
            f'  <joint name="{rig.imu_frame}_to_{frame}" type="fixed">',
            f'    <parent link="{rig.imu_frame}"/>',
            f'    <child link="{frame}"/>',
            f'    <origin xyz="{_triple(camera.p_imu_cam)}" rpy="{_triple(rpy)}"/>',
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>", ""])


def _triple(values: Any) -> str:
    return " ".join(number(v) for v in values)


def _xml_comment(text: str) -> str:
    return text.replace("--", "- -").replace("<", "(").replace(">", ")").strip("-")


def write_basalt(rig: Rig) -> str:
    """Write Basalt's calibration.json.

    `T_imu_cam` is ours; `cam_time_offset_ns` is added to the image stamps (t_imu = t_cam + offset, our
    sign; one for all cameras, so the first one's). Noises are continuous-time densities. Its biases act as
    a = (I + S) a_m - b, so S = M_a - I and b = M_a b_a. radtan and plumb_bob become pinhole-radtan8 with
    the other coefficients 0, known to Basalt since its Monado fork; rpmax 0: no limit. Its reader takes
    `value0` by name, so a second key holds what is a comment in other formats.
    """
    cameras = list(rig.cameras.values())
    noise = rig.noise
    S = rig.accel_matrix - np.eye(3)
    G = rig.gyro_matrix - np.eye(3)
    accel = [*(rig.accel_matrix @ rig.accel_bias_mps2), *S[:, 0], *S[1:, 1], S[2, 2]]
    gyro = [*(rig.gyro_matrix @ rig.gyro_bias_rps), *G.T.ravel()]  # column by column
    value = {
        "T_imu_cam": [_basalt_pose(c) for c in cameras],
        "intrinsics": [_basalt_camera(c) for c in cameras],
        "resolution": [list(c.size) for c in cameras],
        "calib_accel_bias": [float(v) for v in accel],
        "calib_gyro_bias": [float(v) for v in gyro],
        "imu_update_rate": noise.rate_hz,
        "accel_noise_std": [noise.accel_density] * 3,
        "gyro_noise_std": [noise.gyro_density] * 3,
        "accel_bias_std": [noise.accel_walk] * 3,
        "gyro_bias_std": [noise.gyro_walk] * 3,
        "cam_time_offset_ns": round(cameras[0].timeshift_cam_imu_s * 1e9),
        "vignette": [],
    }
    return json.dumps({"value0": value, "comment": rig.header.splitlines()}, indent=2) + "\n"


def _basalt_pose(camera: RigCamera) -> dict[str, float]:
    qw, qx, qy, qz = (float(v) for v in so3.quat_from_matrix(camera.R_imu_cam))
    px, py, pz = (float(v) for v in camera.p_imu_cam)
    return {"px": px, "py": py, "pz": pz, "qx": qx, "qy": qy, "qz": qz, "qw": qw}


def _basalt_camera(camera: RigCamera) -> dict[str, Any]:
    values = dict(zip(("fx", "fy", "cx", "cy"), camera.intrinsics, strict=True))
    if camera.distortion_model == "equidistant":
        values |= dict(zip(("k1", "k2", "k3", "k4"), camera.distortion, strict=True))
        return {"camera_type": "kb4", "intrinsics": values}
    if not any(camera.distortion):
        return {"camera_type": "pinhole", "intrinsics": values}
    values |= dict.fromkeys(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "rpmax"), 0.0)
    values |= dict(zip(COEFFICIENTS[camera.distortion_model], camera.distortion, strict=True))
    return {"camera_type": "pinhole-radtan8", "intrinsics": values}


def write_json(rig: Rig) -> str:
    """Write our own JSON: the same keys as `vical calibrate --json`, with both directions as matrices."""
    cameras = {}
    for camera in rig.cameras.values():
        cameras[camera.name] = {
            "T_imu_cam": {
                "p_m": [float(v) for v in camera.p_imu_cam],
                "q_wxyz": [float(v) for v in so3.quat_from_matrix(camera.R_imu_cam)],
                "covariance": None if camera.covariance is None else camera.covariance.tolist(),
                "matrix": camera.T_imu_cam.tolist(),
            },
            "T_cam_imu_matrix": camera.T_cam_imu.tolist(),
            "timeshift_cam_imu_s": camera.timeshift_cam_imu_s,
            "timeshift_sigma_s": camera.timeshift_sigma_s,
            "intrinsics": list(camera.intrinsics),
            "distortion_model": camera.distortion_model,
            "distortion": list(camera.distortion),
            "resolution": None if camera.resolution is None else list(camera.resolution),
            "readout_s": camera.readout_s,
            "readout_axis": camera.readout_axis,
            "unobservable": list(camera.unobservable),
        }
    noise = rig.noise
    imu = {
        "name": rig.imu_frame,
        "gyro_bias_rps": rig.gyro_bias_rps.tolist(),
        "accel_bias_mps2": rig.accel_bias_mps2.tolist(),
        "gyro_matrix": rig.gyro_matrix.tolist(),
        "accel_matrix": rig.accel_matrix.tolist(),
        "noise": {
            "gyro_density": noise.gyro_density,
            "gyro_walk": noise.gyro_walk,
            "accel_density": noise.accel_density,
            "accel_walk": noise.accel_walk,
            "rate_hz": noise.rate_hz,
        },
    }
    about = {key: getattr(rig, key) for key in ("note", "status", "reason", "t_ns", "devices")}
    document = about | {"cameras": cameras, "imu": imu, "gravity_mps2": rig.gravity_mps2}
    return json.dumps(document, indent=2) + "\n"
