"""A rig with two different cameras, made with scipy (not with our rotations)."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.measurements import ImuNoise
from vical_daemon.export import Rig, RigCamera


@pytest.fixture
def pinhole_camera():
    return RigCamera(
        name="cam0",
        R_imu_cam=Rotation.from_euler("zyx", [89.0, 1.5, 0.3], degrees=True).as_matrix(),
        p_imu_cam=np.array([-0.021, -0.064, 0.0098]),
        timeshift_cam_imu_s=-0.00512,
        intrinsics=(458.0, 457.296, 367.215, 248.375),
        distortion_model="radtan",
        distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
        resolution=(752, 480),
        covariance=np.diag([1e-6] * 3 + [1e-7] * 3),
        timeshift_sigma_s=2e-5,
        topic="/cam0/image_raw",
    )


@pytest.fixture
def fisheye_camera():
    return RigCamera(
        name="left",
        R_imu_cam=Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(),
        p_imu_cam=np.array([0.11, 0.02, -0.04]),
        timeshift_cam_imu_s=0.0125,
        intrinsics=(190.97, 190.98, 254.9, 256.8),
        distortion_model="equidistant",
        distortion=(0.0035, 0.0007, -0.002, 0.0002),
        resolution=(512, 512),
    )


@pytest.fixture
def rig(pinhole_camera, fisheye_camera):
    return Rig(
        cameras={"cam0": pinhole_camera, "left": fisheye_camera},
        noise=ImuNoise(1.7e-4, 1.9e-5, 2.0e-3, 3.0e-3, 200.0),
        gyro_bias_rps=np.array([-0.002, 0.021, 0.077]),
        accel_bias_mps2=np.array([-0.003, 0.12, 0.067]),
        gyro_matrix=np.array([[1.006, 0.004, -0.003], [-0.002, 0.995, 0.005], [0.001, -0.006, 1.003]]),
        accel_matrix=np.array([[1.004, 0, 0], [0.003, 0.997, 0], [-0.002, 0.001, 1.002]]),
        note="made by a test",
    )
