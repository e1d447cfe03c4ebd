"""OpenVINS, VINS-Fusion, ORB-SLAM3: files read by OpenCV's FileStorage; and OpenCV's own."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.results.export.rig import Rig, RigCamera
from vical_daemon.results.export.text import comment, matrix_rows, number, opencv_matrix, row

HEAD = "%YAML:1.0\n---\n"


def write_openvins_cameras(rig: Rig) -> str:
    """Write kalibr_imucam_chain.yaml of OpenVINS.

    Kalibr's layout, but `T_imu_cam` (camera to imu, ours). `timeshift_cam_imu` is its
    calib_camimu_dt: t_imu = t_cam + dt, read from cam0 alone.
    """
    parts = ["%YAML:1.0\n\n", comment(rig.header)]
    names = list(rig.cameras)
    for index, camera in enumerate(rig.cameras.values()):
        overlaps = [i for i in range(len(names)) if i != index]
        parts.append(
            f"cam{index}:\n"
            f"  T_imu_cam: # R_CtoI and p_CinI\n{matrix_rows(camera.T_imu_cam, 4)}\n"
            f"  cam_overlaps: {overlaps}\n"
            "  camera_model: pinhole\n"
            f"  distortion_coeffs: {row(camera.distortion)}\n"
            f"  distortion_model: {camera.distortion_model}\n"
            f"  intrinsics: {row(camera.intrinsics)} # fu, fv, cu, cv\n"
            f"  resolution: [{camera.size[0]}, {camera.size[1]}]\n"
            f"  rostopic: {camera.topic or f'/cam{index}/image_raw'}\n"
            f"  timeshift_cam_imu: {number(camera.timeshift_cam_imu_s)}\n"
        )
    return "".join(parts)


def write_openvins_imu(rig: Rig) -> str:
    """Write kalibr_imu_chain.yaml of OpenVINS.

    Its model `kalibr`: a_true = D_a (a_m - b), w_true = R_GYROtoIMU D_w (w_m - b) with lower-triangular
    D = T^-1. Our lower-triangular M_a is D_a; our full M_g is split by QR into rotation and triangle.
    """
    R_gyro_to_imu, D_w = _rotation_times_lower(rig.gyro_matrix)
    noise, eye = rig.noise, np.eye(3)
    blocks = {
        "Tw": _inverse(D_w),
        "R_IMUtoGYRO": R_gyro_to_imu.T,
        "Ta": _inverse(rig.accel_matrix),
        "R_IMUtoACC": eye,
        "Tg": np.zeros((3, 3)),
    }
    return (
        "%YAML:1.0\n\n" + comment(rig.header) + "imu0:\n"
        f"  T_i_b:\n{matrix_rows(np.eye(4), 4)}\n"
        f"  accelerometer_noise_density: {number(noise.accel_density)}  # m/s^2/sqrt(Hz)\n"
        f"  accelerometer_random_walk: {number(noise.accel_walk)}  # m/s^3/sqrt(Hz)\n"
        f"  gyroscope_noise_density: {number(noise.gyro_density)}  # rad/s/sqrt(Hz)\n"
        f"  gyroscope_random_walk: {number(noise.gyro_walk)}  # rad/s^2/sqrt(Hz)\n"
        f"  rostopic: {rig.imu_topic}\n  time_offset: 0.0\n  update_rate: {number(noise.rate_hz)}\n"
        '  model: "kalibr"\n' + "".join(f"  {k}:\n{matrix_rows(v, 4)}\n" for k, v in blocks.items())
    )


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _rotation_times_lower(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Factor M = Q L with Q a rotation and L lower triangular with positive diagonal (reversed QR)."""
    flip = np.eye(3)[::-1]
    q, r = np.linalg.qr(matrix @ flip)
    signs = np.diag(np.sign(np.diag(r)))
    # M F = q r  =>  M = (q s F) (F s r F), and F r F is lower triangular.
    return q @ signs @ flip, flip @ signs @ r @ flip


def write_vins(rig: Rig) -> str:
    """Write VINS-Fusion's config.

    `body_T_camN` is our T_imu_cam; `td`: image clock + td = imu clock, our sign. Its noises are standard
    deviations of one sample: density * sqrt(rate) and walk * sqrt(rate).
    """
    first = next(iter(rig.cameras.values()))
    root_rate = float(np.sqrt(rig.noise.rate_hz))
    cameras = list(rig.cameras.values())
    topics = "".join(f'image{i}_topic: "{c.topic or f"/cam{i}/image_raw"}"\n' for i, c in enumerate(cameras))
    calibs = "".join(f'cam{i}_calib: "cam{i}.yaml"\n' for i in range(len(cameras)))
    poses = "".join(
        f"body_T_cam{i}: !!opencv-matrix\n{opencv_matrix(c.T_imu_cam)}\n\n" for i, c in enumerate(cameras)
    )
    return (
        "%YAML:1.0\n\n" + comment(rig.header) + f"imu: 1\nnum_of_cam: {len(cameras)}\n\n"
        f'imu_topic: "{rig.imu_topic}"\n{topics}output_path: "~/output/"\n\n'
        f"{calibs}image_width: {first.size[0]}\nimage_height: {first.size[1]}\n\n"
        f"estimate_extrinsic: 0   # these are calibrated\n\n{poses}"
        "multiple_thread: 1\nmax_cnt: 150\nmin_dist: 30\nfreq: 10\nF_threshold: 1.0\nshow_track: 1\n"
        "flow_back: 1\nmax_solver_time: 0.04\nmax_num_iterations: 8\nkeyframe_parallax: 10.0\n\n"
        "# standard deviations of one sample: continuous density * sqrt(rate), walk * sqrt(rate)\n"
        f"acc_n: {number(rig.noise.accel_density * root_rate)}\n"
        f"gyr_n: {number(rig.noise.gyro_density * root_rate)}\n"
        f"acc_w: {number(rig.noise.accel_walk * root_rate)}\n"
        f"gyr_w: {number(rig.noise.gyro_walk * root_rate)}\n"
        f"g_norm: {number(rig.gravity_mps2)}\n\n"
        f"estimate_td: 0\ntd: {number(first.timeshift_cam_imu_s)}   # image clock + td = imu clock, s\n\n"
        'load_previous_pose_graph: 0\npose_graph_save_path: "~/output/pose_graph/"\nsave_image: 0\n'
    )


def write_vins_camera(camera: RigCamera, rig: Rig) -> str:
    """Write a camera file of VINS-Fusion (camodocal): PINHOLE for radtan, KANNALA_BRANDT for equidistant."""
    fx, fy, cx, cy = (number(v) for v in camera.intrinsics)
    d = [number(v) for v in camera.distortion]
    width, height = camera.size
    head = f"camera_name: {camera.name}\nimage_width: {width}\nimage_height: {height}\n"
    if camera.distortion_model == "equidistant":
        # Camodocal counts the coefficient of theta itself, so its k2 is our k1.
        return (
            f"{HEAD}{comment(rig.header)}model_type: KANNALA_BRANDT\n{head}projection_parameters:\n"
            f"   k2: {d[0]}\n   k3: {d[1]}\n   k4: {d[2]}\n   k5: {d[3]}\n"
            f"   mu: {fx}\n   mv: {fy}\n   u0: {cx}\n   v0: {cy}\n"
        )
    return (
        f"{HEAD}{comment(rig.header)}model_type: PINHOLE\n{head}distortion_parameters:\n"
        f"   k1: {d[0]}\n   k2: {d[1]}\n   p1: {d[2]}\n   p2: {d[3]}\n"
        f"projection_parameters:\n   fx: {fx}\n   fy: {fy}\n   cx: {cx}\n   cy: {cy}\n"
    )


def write_orbslam3(rig: Rig) -> str:
    """Write ORB-SLAM3's settings (File.version 1.0, monocular-inertial).

    `IMU.T_b_c1` takes camera coordinates to the body (imu): our T_imu_cam, whatever the comment in its
    examples says. It knows no time shift: the stamps of the images must be moved before it sees them.
    Noises are continuous-time densities (it multiplies by sqrt(rate) itself).
    """
    camera = rig.only_camera("orbslam3")
    names = COEFFICIENTS[camera.distortion_model]
    kind = "KannalaBrandt8" if camera.distortion_model == "equidistant" else "PinHole"
    keys = dict(zip(("fx", "fy", "cx", "cy"), camera.intrinsics, strict=True))
    keys |= dict(zip(names, camera.distortion, strict=True))
    noise = rig.noise
    return (
        "%YAML:1.0\n\n" + comment(rig.header) + f'File.version: "1.0"\n\nCamera.type: "{kind}"\n'
        + "".join(f"Camera1.{key}: {number(value)}\n" for key, value in keys.items())
        + f"\nCamera.width: {camera.size[0]}\nCamera.height: {camera.size[1]}\n"
        f"Camera.fps: {round(camera.rate_hz or 20)}\nCamera.RGB: 0\n\n"
        f"# t_imu = t_cam + {number(camera.timeshift_cam_imu_s)} s: ORB-SLAM3 has no key for it;\n"
        "# add it to the stamps of the images.\n"
        f"IMU.T_b_c1: !!opencv-matrix\n{opencv_matrix(camera.T_imu_cam, kind='f')}\n\n"
        f"IMU.NoiseGyro: {number(noise.gyro_density)} # rad/s/sqrt(Hz)\n"
        f"IMU.NoiseAcc: {number(noise.accel_density)} # m/s^2/sqrt(Hz)\n"
        f"IMU.GyroWalk: {number(noise.gyro_walk)} # rad/s^2/sqrt(Hz)\n"
        f"IMU.AccWalk: {number(noise.accel_walk)} # m/s^3/sqrt(Hz)\n"
        f"IMU.Frequency: {number(noise.rate_hz)}\n\n{_ORBSLAM3_DEFAULTS}"
    )  # fmt: skip


_ORBSLAM3_DEFAULTS = """\
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7

Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -3.5
Viewer.ViewpointF: 500.0
"""


def write_opencv(rig: Rig) -> str:
    """Write an OpenCV FileStorage file of one camera; T_imu_cam and the time shift as in our own words."""
    camera = rig.only_camera("opencv")
    fx, fy, cx, cy = camera.intrinsics
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    width, height = camera.size
    fisheye = int(camera.distortion_model == "equidistant")
    return (
        f"{HEAD}{comment(rig.header)}image_width: {width}\nimage_height: {height}\n"
        f"fisheye_model: {fisheye}\n"
        f"camera_matrix: !!opencv-matrix\n{opencv_matrix(K)}\n"
        f"distortion_coefficients: !!opencv-matrix\n{opencv_matrix(np.array([camera.distortion]))}\n"
        f"T_imu_cam: !!opencv-matrix\n{opencv_matrix(camera.T_imu_cam)}\n"
        f"# t_imu = t_cam + timeshift_cam_imu_s\n"
        f"timeshift_cam_imu_s: {number(camera.timeshift_cam_imu_s)}\n"
    )
