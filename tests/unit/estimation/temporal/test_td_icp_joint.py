"""Several sensors at once: delays of all pairs agree with the truth and with each other."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.temporal.td_icp import _thinned, joint_of_orientations, joint_with_gyro
from vical_daemon.estimation.temporal.td_icp_input import OrientationStream, clean_stream

DEG = np.pi / 180
F = np.random.default_rng(1).uniform(0.25, 0.9, (3, 3))
PHASE = np.random.default_rng(2).uniform(0, 6, (3, 3))
AMPLITUDE = np.random.default_rng(3).uniform(0.1, 0.3, (3, 3))


def _vector(t):
    return np.sum(AMPLITUDE * np.sin(2 * np.pi * F * t[:, None, None] + PHASE), axis=2)


def _rate(t, h=1e-5):
    return (Rotation.from_rotvec(_vector(t - h)).inv() * Rotation.from_rotvec(_vector(t + h))).as_rotvec() / (
        2 * h
    )


def _stream(name, hz, shift, sigma, seed, seconds=8.0):
    rng = np.random.default_rng(seed)
    t = np.arange(0.4, seconds, 1 / hz)
    mounting, world = Rotation.random(2, random_state=seed)
    noise = Rotation.from_rotvec(rng.normal(0, sigma, (len(t), 3)))
    R = world * Rotation.from_rotvec(_vector(t)) * mounting * noise
    return OrientationStream(name, t - shift, R.as_matrix(), sigma), mounting


def test_two_cameras_and_a_tracker_against_a_gyro():
    rng = np.random.default_rng(4)
    t_imu = np.arange(0.0, 9.0, 0.01)
    gyro = _rate(t_imu) + rng.normal(0, 5.2e-3, (len(t_imu), 3)) + 0.01
    shifts = {"cam0": 0.012, "cam1": -0.031, "tracker": 0.4}
    made = {n: _stream(n, hz, s, sigma, i) for i, (n, s, hz, sigma) in enumerate(
        [("cam0", shifts["cam0"], 10, 0.1 * DEG), ("cam1", shifts["cam1"], 12, 0.1 * DEG),
         ("tracker", shifts["tracker"], 15, 0.2 * DEG)])}  # fmt: skip
    result = joint_with_gyro("imu0", t_imu, gyro, [m[0] for m in made.values()])
    assert result.status == "ok", result.reason
    assert len(result.pairs) == 6 and result.covariance.shape == (12, 12)
    truth = {"imu0": 0.0, **shifts}
    for pair in result.pairs:
        error = pair.timeshift_s - (truth[pair.a] - truth[pair.b])
        assert abs(error) < 4.5 * pair.timeshift_sigma_s, pair
        assert pair.timeshift_sigma_s < 1e-3
    for name, (_, mounting) in made.items():
        found = Rotation.from_matrix(result.sensors[name].R_imu_cam)
        assert (found.inv() * mounting).magnitude() < 0.3 * DEG
    assert set(result.to_json()["sensors"]) == set(shifts)


def test_streams_without_any_gyro():
    fast, slow = _stream("mocap", 100, 0.0, 0.05 * DEG, 7)[0], _stream("cam0", 20, 0.25, 0.1 * DEG, 8)[0]
    result = joint_of_orientations([slow, fast])
    assert result.status == "ok", result.reason
    assert result.reference == "mocap"
    delay = result.sensors["cam0"]
    assert abs(delay.timeshift_cam_imu_s - 0.25) < 4.5 * delay.timeshift_sigma_s
    assert delay.timeshift_sigma_s < 0.5e-3
    assert delay.camera_noise_rad == pytest.approx(0.11 * DEG, rel=0.2)


def test_a_stream_that_does_not_belong_is_named_and_left_out():
    fast, slow = _stream("mocap", 50, 0.0, 0.05 * DEG, 9)[0], _stream("cam0", 20, 0.1, 0.1 * DEG, 10)[0]
    still = OrientationStream("shelf", slow.t_s, np.tile(np.eye(3), (len(slow.t_s), 1, 1)))
    result = joint_of_orientations([fast, slow, still])
    assert result.status == "degenerate" and "shelf" in result.reason
    assert list(result.sensors) == ["cam0"]
    assert joint_of_orientations([fast]).status == "refused"


def test_inverted_and_stretched_streams_are_named_without_a_gyro_too():
    fast, slow = _stream("mocap", 50, 0.0, 0.05 * DEG, 11)[0], _stream("cam0", 15, 0.1, 0.1 * DEG, 12)[0]
    inverted = OrientationStream("cam1", slow.t_s, np.swapaxes(slow.R_world_sensor, 1, 2))
    stretched = OrientationStream("cam2", 1.05 * slow.t_s, slow.R_world_sensor)
    uneven = OrientationStream("cam3", 1.003 * slow.t_s, slow.R_world_sensor, 0.1 * DEG)
    result = joint_of_orientations([fast, inverted, stretched, uneven])
    assert result.status == "degenerate" and "cam1" not in result.sensors
    reasons = dict(part.split(": ", 1) for part in re.split("; (?=cam)", result.reason))
    assert "inverted" in reasons["cam1"]
    assert "the stamps of sensor and reference" in reasons["cam2"] and " too fast" in reasons["cam2"]
    assert "the stamps of sensor and reference" in reasons["cam3"]


def test_long_streams_are_thinned_the_largest_first():
    def stream(name, n):
        R = np.tile(np.eye(3), (n, 1, 1))
        return clean_stream(OrientationStream(name, np.arange(n) * 1.0, R, np.full(n, 0.1)))

    thin = _thinned([stream("mocap", 8000), stream("cam0", 900)], most=3000)
    assert [len(s.t_s) for s in thin] == [2000, 900]
    assert len(thin[0].R_world_sensor) == len(thin[0].covariance) == thin[0].n_given == 2000
    assert thin[0].t_s[1] == 4.0
