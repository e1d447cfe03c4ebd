"""Multi-position calibration of an IMU against a simulated truth (scipy rotations, not ours)."""

import numpy as np
import pytest

from vical_daemon.estimation.tools import imu_static

RATE = 100.0


def test_rests_are_found(simulate_turns):
    gyro, force = simulate_turns(np.random.default_rng(1))
    rests = imu_static.find_rests(gyro, force, RATE)
    assert len(rests) == 24
    assert all(2.0 < (r.stop - r.start) / RATE < 3.2 for r in rests)


def test_truth_lies_within_the_stated_sigmas(simulate_turns, imu_truth):
    M_A, M_G, B_A, B_G = (imu_truth[k] for k in ("M_A", "M_G", "B_A", "B_G"))
    scores = []
    for seed in range(2):
        found = imu_static.calibrate_imu(*simulate_turns(np.random.default_rng(seed)), RATE)
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


def test_matrices_correct_what_they_say_they_correct(simulate_turns):
    gyro, force = simulate_turns(np.random.default_rng(7))
    found = imu_static.calibrate_imu(gyro, force, RATE)
    rest = imu_static.find_rests(gyro, force, RATE)[3]
    corrected = found.accel.matrix @ (rest.accel_mps2 - found.accel.bias)
    assert np.linalg.norm(corrected) == pytest.approx(9.80665, abs=0.003)


def test_what_is_not_known_of_gravity_is_in_the_sigma_of_the_scale_alone(simulate_turns):
    turns, wrong = simulate_turns(np.random.default_rng(3)), 9.80665 + 0.02
    exact, off = (imu_static.calibrate_imu(*turns, RATE, g) for g in (9.80665, wrong))
    known = imu_static.calibrate_imu(*turns, RATE, wrong, gravity_sigma_mps2=0.015)
    scale = np.diag(off.accel.matrix - exact.accel.matrix)
    assert np.abs(scale / np.diag(off.accel.matrix_sigma)).min() > 5.0
    assert np.abs(scale / np.diag(known.accel.matrix_sigma)).max() < 1.5
    np.testing.assert_allclose(known.accel.bias_sigma, off.accel.bias_sigma)
    np.testing.assert_array_equal(known.gyro.matrix_sigma, off.gyro.matrix_sigma)


def test_too_few_positions_are_refused(simulate_turns):
    gyro, force = simulate_turns(np.random.default_rng(2), positions=4)
    with pytest.raises(imu_static.PoorMotionError, match="six faces"):
        imu_static.calibrate_imu(gyro, force, RATE)


def test_one_axis_of_rotation_is_refused(simulate_turns):
    gyro, force = simulate_turns(np.random.default_rng(3), positions=14, axes=(0, 0, 1))
    with pytest.raises(imu_static.PoorMotionError, match="too similar"):
        imu_static.calibrate_imu(gyro, force, RATE)


def test_few_turns_leave_the_gyro_matrix_alone(simulate_turns):
    gyro, force = simulate_turns(np.random.default_rng(4))
    rests = imu_static.find_rests(gyro, force, RATE)
    accel = imu_static.calibrate_accelerometer(rests)
    calibration, found, motions = imu_static.calibrate_gyro(gyro, rests[:4], accel, RATE)
    assert not found
    assert motions <= 3
    assert calibration.matrix == pytest.approx(np.eye(3))
