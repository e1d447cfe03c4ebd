"""td_icp on motion as real recordings have it: mostly at rest, noisy orientations, delays that wander."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.temporal.rotation_turns import (
    camera_turns,
    orientation_noise,
    without_long_rest,
)
from vical_daemon.estimation.temporal.stretch_agreement import scatter_factor
from vical_daemon.estimation.temporal.td_icp import joint_of_orientations, td_icp
from vical_daemon.estimation.temporal.td_icp_input import OrientationStream

DEG = np.pi / 180
R_IMU_CAM = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()


def turning(t, rate_dps=40.0):
    """Rotation vectors of a hand's motion."""
    f, phase = np.array([0.5, 0.7, 0.9]), np.array([0.3, 1.9, 4.0])
    return rate_dps * DEG / (2 * np.pi * f) * np.sin(2 * np.pi * f * t[:, None] + phase)


def stopping(t, begin, end):
    """The same, moving between two instants only, set off and stopped softly."""
    s = np.clip((t - begin) / (end - begin), 0.0, 1.0)
    warped = begin + (end - begin) * (s - np.sin(2 * np.pi * s) / (2 * np.pi))
    return turning(warped)


def record(vector, seconds, shift=0.12, noise=0.1 * DEG, hz=15.0, seed=3, correlated_s=0.0):
    rng = np.random.default_rng(seed)
    t_imu = np.arange(-1.0, seconds + 1.0, 0.01)
    h = 1e-4
    step = Rotation.from_rotvec(vector(t_imu - h)).inv() * Rotation.from_rotvec(vector(t_imu + h))
    gyro = step.as_rotvec() / (2 * h) + rng.normal(0, 5.2e-3, (len(t_imu), 3)) + 0.004
    t = np.arange(0.0, seconds, 1 / hz)
    error = rng.normal(0, noise, (len(t), 3))
    if correlated_s:
        keep = np.exp(-1 / (hz * correlated_s))
        for i in range(1, len(t)):
            error[i] = keep * error[i - 1] + np.sqrt(1 - keep**2) * error[i]
    R = Rotation.from_rotvec(vector(t)).as_matrix() @ R_IMU_CAM @ Rotation.from_rotvec(error).as_matrix()
    return t_imu, gyro, t - shift, R


def assert_found(result, shift=0.12):
    assert result.status == "ok", result.reason
    assert abs(result.timeshift_cam_imu_s - shift) < 4 * result.timeshift_sigma_s < 20e-3
    error = so3.log(result.R_imu_cam.T @ R_IMU_CAM)
    assert np.all(np.abs(error) < 4.5 * result.rotation_sigma_rad)


@pytest.mark.parametrize(("seconds", "begin", "end"), [(10.0, 5.0, 7.5), (60.0, 20.0, 26.0)])
@pytest.mark.parametrize("noise", [0.0001 * DEG, 0.1 * DEG])
def test_a_recording_that_mostly_rests_is_answered_from_what_moves(seconds, begin, end, noise):
    t_imu, gyro, t_cam, R = record(lambda t: stopping(t, begin, end), seconds, noise=noise, hz=30.0)
    result = td_icp(t_imu, gyro, t_cam, R)
    assert_found(result)
    assert result.at_rest > 0.3 * len(t_cam)
    assert result.rejected - result.at_rest < 0.1 * result.pairs


def test_rest_is_left_out_only_where_it_prevails():
    t = np.arange(0.0, 10.0, 1 / 30)
    rng = np.random.default_rng(0)

    def q(vector):
        noise = Rotation.from_rotvec(rng.normal(0, 1e-3, (len(t), 3)))
        return so3.quat_from_matrix((Rotation.from_rotvec(vector) * noise).as_matrix())

    assert without_long_rest(t, q(turning(t))).all()
    assert without_long_rest(t, q(stopping(t, 0.0, 7.0))).all()
    keep = without_long_rest(t, q(stopping(t, 4.0, 6.0)))
    moving = (t > 4.4) & (t < 5.6)
    assert keep[moving].all() and 0.2 < keep[~moving].mean() < 0.5
    assert without_long_rest(t, q(np.zeros((len(t), 3)))).all()  # no motion at all: that is refused elsewhere


@pytest.mark.parametrize(("noise_deg", "correlated_s"), [(1.2, 0.0), (0.4, 0.3)])
def test_noise_as_large_as_the_turns_of_a_fifth_of_a_second_is_averaged_out(noise_deg, correlated_s):
    motion = record(lambda t: turning(0.4 * t, 35.0), 60.0, noise=noise_deg * DEG, correlated_s=correlated_s)
    assert_found(td_icp(*motion))


def test_turns_are_taken_over_the_shortest_time_that_shows_them():
    t = np.arange(0.0, 30.0, 1 / 15)
    rng = np.random.default_rng(1)
    lengths = []
    for noise in (0.03, 0.3, 0.8):
        R = Rotation.from_rotvec(turning(t, 15.0)) * Rotation.from_rotvec(
            rng.normal(0, noise * DEG, (450, 3))
        )
        q = so3.quat_from_matrix(R.as_matrix())
        assert 0.6 * noise < orientation_noise(t, q) / DEG < 1.5 * noise + 0.05
        lengths.append(camera_turns(t, q).baseline_s)
    assert lengths[0] == 0.2 < lengths[1] <= lengths[2]


def test_a_delay_that_wanders_widens_its_sigma():
    t_imu, gyro, t_cam, R = record(turning, 60.0)
    steady = td_icp(t_imu, gyro, t_cam, R)
    wander = 3e-3 * np.sin(2 * np.pi * t_cam / 25.0)
    result = td_icp(t_imu, gyro, t_cam + wander, R)
    assert steady.widened == 1.0
    assert result.widened > 3.0
    assert result.timeshift_sigma_s > 3.0 * steady.timeshift_sigma_s
    assert result.to_json()["widened"] == result.widened
    assert_found(result)


def test_scatter_is_judged_against_chance():
    rng = np.random.default_rng(4)
    C = np.diag([1.0, 4.0])
    draws = [[rng.multivariate_normal(np.ones(2), C) for _ in range(6)] for _ in range(300)]
    factors = np.array([scatter_factor(values, [C] * 6) for values in draws])
    assert np.mean(factors > 1.0) < 0.03
    wide = np.array([scatter_factor([3.0 * v for v in values], [C] * 6) for values in draws])
    assert np.sqrt(np.mean(wide**2)) == pytest.approx(3.0, rel=0.1)
    assert scatter_factor([np.ones(2)], [C]) == 1.0


def test_the_fastest_stream_is_the_reference_however_long_the_recording():
    _, _, t, R = record(turning, 40.0, hz=30.0)
    fast = np.arange(0.0, 40.0, 0.005)
    R_fast = Rotation.from_rotvec(turning(fast)).as_matrix()
    result = joint_of_orientations(
        [OrientationStream("camera", t, R), OrientationStream("mocap", fast, R_fast)]
    )
    assert result.reference == "mocap" and result.status == "ok", result.reason
    found = result.sensors["camera"]
    assert abs(found.timeshift_cam_imu_s - 0.12) < 4 * found.timeshift_sigma_s < 4e-3


def test_a_gyro_below_10_hz_is_refused_as_calibrate_does():
    t_imu, gyro, t_cam, R = record(turning, 30.0)
    result = td_icp(t_imu[::12], gyro[::12], t_cam, R)
    assert result.status == "refused"
    assert "8.33 samples a second" in result.reason and "at least 10" in result.reason
