"""Fixtures that several packages share: a small recording, a rig with two cameras, and an IMU turned by hand.

Rotations are made with scipy, not with ours.
"""

from __future__ import annotations

import gzip
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.measurements import ImuNoise
from vical_daemon.results.export import Rig, RigCamera

SHARED = Path(__file__).parents[3] / "shared" / "data" / "euroc_imu_april"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)


def a_motion(rate_hz: float = 200.0, seconds: float = 12.0):
    """Stamps, rates and specific forces of an imu that is turned about all axes in gravity."""
    t_ns, gyro, force = _a_motion(rate_hz, seconds)
    return t_ns.copy(), gyro.copy(), force.copy()


@cache
def _a_motion(rate_hz: float, seconds: float):
    t_s = np.arange(0, seconds, 1 / rate_hz)
    gyro = np.stack([1.1 * np.sin(1.3 * t_s), 0.9 * np.cos(1.7 * t_s), 0.6 * np.sin(0.9 * t_s + 1)], axis=1)
    R = np.eye(3)
    force = np.empty_like(gyro)
    for i, turn in enumerate(Rotation.from_rotvec(gyro / rate_hz).as_matrix()):
        force[i] = R.T @ np.array([0.0, 0.0, 9.81])
        R = R @ turn
    t_ns = 1_600_000_000_000_000_000 + np.round(t_s * 1e9).astype(np.int64)
    return t_ns, gyro, force


def write_asl(folder, *, imu=None, corners=True, camera_scale=1.0):
    """Write an ASL folder with made-up but plausible contents; returns the folder."""
    t_ns, gyro, force = imu if imu is not None else a_motion()
    (folder / "mav0/imu0").mkdir(parents=True)
    (folder / "mav0/cam0").mkdir(parents=True)
    lines = ["#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z"]
    lines += [
        ",".join([str(t), *map(repr, [*w, *f])])
        for t, w, f in zip(t_ns.tolist(), gyro.tolist(), force.tolist(), strict=True)
    ]
    (folder / "mav0/imu0/data.csv").write_text("\n".join(lines) + "\n")
    if corners:
        rng = np.random.default_rng(5)
        rows = ["#timestamp [ns],point_id,u [px],v [px]"]
        begin = int(t_ns[0])
        for k in range(200):
            stamp = begin + round(k * 5e7 * camera_scale)
            rows += [
                f"{stamp},{i},{u!r},{v!r}" for i, (u, v) in enumerate(rng.uniform(0, 700, (20, 2)).tolist())
            ]
        (folder / "mav0/cam0/corners.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.fixture(scope="session")
def asl_folder(tmp_path_factory):
    return write_asl(tmp_path_factory.mktemp("asl"))


@pytest.fixture(scope="session", name="a_motion")
def a_motion_fixture():
    return a_motion


@pytest.fixture(scope="session", name="write_asl")
def write_asl_fixture():
    return write_asl


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
        status="converging",
        reason='turn about "x": -- <more>\nthan #5',
        t_ns=1_400_000_000_000_000_000,
        devices={"imu/imu0": "6223-00042", "camera/cam0": "SN: 7"},
    )


IMU_RATE_HZ = 100.0
IMU_TRUTH = {
    "M_A": np.array([[1.004, 0, 0], [0.003, 0.997, 0], [-0.002, 0.001, 1.002]]),
    "M_G": np.array([[1.006, 0.004, -0.003], [-0.002, 0.995, 0.005], [0.001, -0.006, 1.003]]),
    "B_A": np.array([0.05, -0.03, 0.08]),
    "B_G": np.array([0.004, -0.002, 0.001]),
}


@pytest.fixture
def imu_truth():
    return IMU_TRUTH


@pytest.fixture
def simulate_turns():
    return _simulate


@pytest.fixture
def simulated_turns():
    return _simulate(np.random.default_rng(5), positions=20)


def _simulate(rng, positions=24, axes=None):
    """Rest 3 s, turn 1.5 s about a random axis by 60 to 150 degrees, and so on."""
    R, gyro, force = Rotation.random(random_state=int(rng.integers(1 << 30))), [], []
    up = np.array([0.0, 0.0, 9.80665])
    for _ in range(positions):
        rest = R.inv().apply(up)
        gyro += [np.zeros(3)] * 300
        force += [rest] * 300
        axis = rng.standard_normal(3) if axes is None else np.asarray(axes, dtype=float)
        axis /= np.linalg.norm(axis)
        # Raised-cosine rate: starts and ends at rest.
        angle, t = rng.uniform(1.0, 2.6), (np.arange(150) + 0.5) / 150
        rate = angle / 1.5 * (1 - np.cos(2 * np.pi * t))
        for w in rate:
            gyro.append(axis * w)
            R = R * Rotation.from_rotvec(axis * w / IMU_RATE_HZ)
            force.append(R.inv().apply(up) + rng.standard_normal(3) * 0.3)
    gyro, force = np.array(gyro), np.array(force)
    gyro_m = (
        gyro @ np.linalg.inv(IMU_TRUTH["M_G"]).T
        + IMU_TRUTH["B_G"]
        + 5e-4 * np.sqrt(IMU_RATE_HZ) * rng.standard_normal(gyro.shape)
    )
    force_m = (
        force @ np.linalg.inv(IMU_TRUTH["M_A"]).T
        + IMU_TRUTH["B_A"]
        + 8e-4 * np.sqrt(IMU_RATE_HZ) * rng.standard_normal(force.shape)
    )
    return gyro_m, force_m


@pytest.fixture(scope="session")
def euroc() -> Path:
    if not SHARED.is_dir():
        pytest.skip(f"shared data absent: {SHARED}")
    return SHARED


def _first_seconds(euroc: Path, folder: Path, seconds: int) -> Path:
    """Copy the first seconds of the recording, with its target and initial values."""
    for name in ("target.yaml", "initial.yaml"):
        shutil.copyfile(euroc / name, folder / name)  # not its mode: the original may be read-only
    lines = (euroc / "mav0/imu0/data.csv").read_text().splitlines()[: 200 * seconds]
    end_ns = int(lines[-1].split(",")[0])
    (folder / "mav0/imu0").mkdir(parents=True)
    (folder / "mav0/imu0/data.csv").write_text("\n".join(lines) + "\n")
    (folder / "mav0/cam0").mkdir()
    with gzip.open(euroc / "mav0/cam0/corners.csv.gz", "rt") as file:
        kept = [row for row in file if row[0] == "#" or int(row.split(",")[0]) < end_ns]
    (folder / "mav0/cam0/corners.csv").write_text("".join(kept))
    return folder


@pytest.fixture(scope="session")
def short(euroc: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _first_seconds(euroc, tmp_path_factory.mktemp("short"), 9)


@pytest.fixture(scope="session")
def shortest(euroc: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Just long enough for a first solution."""
    return _first_seconds(euroc, tmp_path_factory.mktemp("shortest"), 5)
