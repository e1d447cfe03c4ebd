"""Multi-position calibration of an IMU against a simulated truth (scipy rotations, not ours)."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation import imu_static

RATE = 100.0
M_A = np.array([[1.004, 0, 0], [0.003, 0.997, 0], [-0.002, 0.001, 1.002]])
M_G = np.array([[1.006, 0.004, -0.003], [-0.002, 0.995, 0.005], [0.001, -0.006, 1.003]])
B_A = np.array([0.05, -0.03, 0.08])
B_G = np.array([0.004, -0.002, 0.001])


def simulate(rng, positions=24, axes=None):
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
            R = R * Rotation.from_rotvec(axis * w / RATE)
            force.append(R.inv().apply(up) + rng.standard_normal(3) * 0.3)
    gyro, force = np.array(gyro), np.array(force)
    gyro_m = gyro @ np.linalg.inv(M_G).T + B_G + 5e-4 * np.sqrt(RATE) * rng.standard_normal(gyro.shape)
    force_m = force @ np.linalg.inv(M_A).T + B_A + 8e-4 * np.sqrt(RATE) * rng.standard_normal(force.shape)
    return gyro_m, force_m


def test_rests_are_found():
    gyro, force = simulate(np.random.default_rng(1))
    rests = imu_static.find_rests(gyro, force, RATE)
    assert len(rests) == 24
    assert all(2.0 < (r.stop - r.start) / RATE < 3.2 for r in rests)


def test_truth_lies_within_the_stated_sigmas():
    scores = []
    for seed in range(4):
        found = imu_static.calibrate_imu(*simulate(np.random.default_rng(seed)), RATE)
        assert found.gyro_matrix_found
        lower = np.tril_indices(3)
        scores.append(
            np.concatenate(
                [
                    ((found.accel.matrix - M_A)[lower] / found.accel.matrix_sigma[lower]),
                    (found.accel.bias - B_A) / found.accel.bias_sigma,
                    ((found.gyro.matrix - M_G) / found.gyro.matrix_sigma).ravel(),
                    (found.gyro.bias - B_G) / found.gyro.bias_sigma,
                ]
            )
        )
        assert found.accel.matrix == pytest.approx(M_A, abs=1e-3)
        assert found.gyro.matrix == pytest.approx(M_G, abs=2e-3)
    scores = np.array(scores)
    assert np.abs(scores).max() < 4.5
    assert 0.3 < (scores**2).mean() < 2.0


def test_matrices_correct_what_they_say_they_correct():
    gyro, force = simulate(np.random.default_rng(7))
    found = imu_static.calibrate_imu(gyro, force, RATE)
    rest = imu_static.find_rests(gyro, force, RATE)[3]
    corrected = found.accel.matrix @ (rest.accel_mps2 - found.accel.bias)
    assert np.linalg.norm(corrected) == pytest.approx(9.80665, abs=0.003)


def test_too_few_positions_are_refused():
    gyro, force = simulate(np.random.default_rng(2), positions=4)
    with pytest.raises(imu_static.PoorMotionError, match="six faces"):
        imu_static.calibrate_imu(gyro, force, RATE)


def test_one_axis_of_rotation_is_refused():
    gyro, force = simulate(np.random.default_rng(3), positions=14, axes=(0, 0, 1))
    with pytest.raises(imu_static.PoorMotionError, match="too much alike"):
        imu_static.calibrate_imu(gyro, force, RATE)


def test_few_turns_leave_the_gyro_matrix_alone():
    gyro, force = simulate(np.random.default_rng(4))
    rests = imu_static.find_rests(gyro, force, RATE)
    accel = imu_static.calibrate_accelerometer(rests)
    calibration, found, motions = imu_static.calibrate_gyro(gyro, rests[:4], accel, RATE)
    assert not found
    assert motions <= 3
    assert calibration.matrix == pytest.approx(np.eye(3))
