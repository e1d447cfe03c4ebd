"""Fixtures of the bus tests."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def rng_bus() -> np.random.Generator:
    return np.random.default_rng(20261121)


def a_motion(rate_hz: float = 200.0, seconds: float = 12.0):
    """Stamps, rates and specific forces of an imu that is turned about all axes in gravity."""
    t_s = np.arange(0, seconds, 1 / rate_hz)
    gyro = np.stack([1.1 * np.sin(1.3 * t_s), 0.9 * np.cos(1.7 * t_s), 0.6 * np.sin(0.9 * t_s + 1)], axis=1)
    R = np.eye(3)
    force = np.empty_like(gyro)
    for i, rate in enumerate(gyro):
        force[i] = R.T @ np.array([0.0, 0.0, 9.81])
        angle = np.linalg.norm(rate) / rate_hz
        axis = rate / np.linalg.norm(rate)
        K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        R = R @ (np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)
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
