"""td_icp.py on simulated curves: captured from any start, honest, robust, and refusing in words."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.temporal.td_icp import td_icp

DEG = np.pi / 180


class Motion:
    """A rotation vector made of sinusoids, and what sensors on it see (scipy's rotations, not ours)."""

    def __init__(self, seed, rate_dps=60.0, axes=(1.0, 1.0, 1.0)):
        rng = np.random.default_rng(seed)
        self.f = rng.uniform(0.25, 1.0, (3, 3))
        self.phase = rng.uniform(0, 6.28, (3, 3))
        self.a = rng.uniform(0.5, 1, (3, 3)) * np.array(axes)[:, None]
        t = np.linspace(0, 15, 1500)
        for _ in range(5):
            self.a *= rate_dps * DEG / np.sqrt(np.mean(np.sum(self.rate(t) ** 2, axis=1)))

    def vector(self, t):
        return np.sum(self.a * np.sin(2 * np.pi * self.f * t[:, None, None] + self.phase), axis=2)

    def R(self, t):
        return Rotation.from_rotvec(self.vector(t)).as_matrix()

    def rate(self, t, h=1e-5):
        step = Rotation.from_rotvec(self.vector(t - h)).inv() * Rotation.from_rotvec(self.vector(t + h))
        return step.as_rotvec() / (2 * h)


def record(
    seed, shift=0.0, seconds=10.0, motion=None, sigma=0.1 * DEG, outliers=0.0, hole=None, bias=None, hz=15.0
):
    rng = np.random.default_rng([seed, 5])
    motion = motion or Motion(seed)
    t_imu = np.arange(-0.5, seconds + 2.5, 0.01)
    bias = rng.normal(0, 0.01, 3) if bias is None else bias
    gyro = motion.rate(t_imu) + bias + rng.normal(0, 5.2e-4 * 10, (len(t_imu), 3))
    t = np.arange(0.3, seconds + 0.3, 1 / hz)
    R_imu_cam = Rotation.random(random_state=seed).as_matrix()
    R = so3.exp(rng.normal(0, 1, 3)) @ motion.R(t) @ R_imu_cam
    R = R @ so3.exp(rng.normal(0, sigma, (len(t), 3)))
    bad = rng.random(len(t)) < outliers
    R[bad] = R[bad] @ so3.exp(rng.normal(0, 0.8, (bad.sum(), 3)))
    if hole:
        keep = (t < hole[0]) | (t > hole[1])
        t, R = t[keep], R[keep]
    return t_imu, gyro, t - shift, R, R_imu_cam, bias


@pytest.mark.parametrize(("seed", "shift"), [(1, 0.0), (2, 1.97), (3, -2.0), (4, 0.75), (5, -0.75)])
def test_any_delay_and_any_mounting_are_found_within_the_stated_sigma(seed, shift):
    t_imu, gyro, t_cam, R, R_imu_cam, bias = record(seed, shift)
    result = td_icp(t_imu, gyro, t_cam, R)
    assert result.status == "ok", result.reason
    assert abs(result.timeshift_cam_imu_s - shift) < 4 * result.timeshift_sigma_s
    assert 0.05e-3 < result.timeshift_sigma_s < 0.3e-3
    error = so3.log(result.R_imu_cam.T @ R_imu_cam)
    assert np.all(np.abs(error) < 4.5 * result.rotation_sigma_rad)
    full = np.concatenate((error, bias - result.gyro_bias_rps, [shift - result.timeshift_cam_imu_s]))
    assert full @ np.linalg.solve(result.covariance, full) < 24.3  # chi-square, 7 degrees of freedom, 99.9 %
    assert result.camera_noise_rad == pytest.approx(0.1 * DEG, rel=0.15)


def test_outliers_and_a_hole_are_survived_and_counted():
    t_imu, gyro, t_cam, R, R_imu_cam, _ = record(7, 1.2, outliers=0.3, hole=(4.0, 5.0))
    result = td_icp(t_imu, gyro, t_cam, R)
    assert result.status == "ok", result.reason
    assert abs(result.timeshift_cam_imu_s - 1.2) < 4 * result.timeshift_sigma_s
    assert 0.2 * len(t_cam) < result.rejected < 0.4 * len(t_cam)
    assert result.pairs + result.rejected == len(t_cam)
    assert np.count_nonzero(result.used) == result.pairs
    assert np.linalg.norm(so3.log(result.R_imu_cam.T @ R_imu_cam)) < 0.5 * DEG


def test_epoch_stamps_and_unsorted_input_give_the_same_answer():
    t_imu, gyro, t_cam, R, *_ = record(8, 0.02)
    plain = td_icp(t_imu, gyro, t_cam, R)
    order = np.random.default_rng(0).permutation(len(t_cam))
    other = td_icp(t_imu + 1.7e9, gyro, t_cam[order] + 1.7e9, R[order])
    assert other.timeshift_cam_imu_s == pytest.approx(plain.timeshift_cam_imu_s, abs=2e-6)
    np.testing.assert_allclose(other.R_imu_cam, plain.R_imu_cam, atol=1e-5)


def test_a_large_gyro_bias_on_slow_motion_does_not_hide_the_agreement():
    motion = Motion(9, rate_dps=20.0)
    bias = np.array([0.02, -0.08, 0.05])
    t_imu, gyro, t_cam, R, *_ = record(9, -0.4, motion=motion, bias=bias)
    result = td_icp(t_imu, gyro, t_cam, R)
    assert result.status == "ok", result.reason
    assert abs(result.timeshift_cam_imu_s + 0.4) < 4 * result.timeshift_sigma_s
    np.testing.assert_allclose(result.gyro_bias_rps, bias, atol=4e-3)


def test_noise_is_measured_where_the_caller_was_wrong_about_it():
    t_imu, gyro, t_cam, R, *_ = record(10, 0.1, sigma=0.4 * DEG)
    result = td_icp(t_imu, gyro, t_cam, R, 0.05 * DEG)
    assert result.camera_noise_rad == pytest.approx(0.4 * DEG, rel=0.15)
    stated = td_icp(t_imu, gyro, t_cam, R, 0.4 * DEG)
    assert stated.timeshift_sigma_s == pytest.approx(result.timeshift_sigma_s, rel=0.05)


def test_a_gyro_in_degrees_per_second_is_refused_with_the_reason():
    t_imu, gyro, t_cam, R, *_ = record(11)
    for wrong in (gyro / DEG, gyro * DEG):
        result = td_icp(t_imu, wrong, t_cam, R)
        assert result.status == "refused"
        assert "rad/s" in result.reason and "57" in result.reason
        assert np.isnan(result.timeshift_cam_imu_s)
        assert result.to_json()["timeshift_cam_imu_s"] is None


def test_standing_still_is_refused():
    motion = Motion(12, rate_dps=0.01)
    t_imu, gyro, t_cam, R, *_ = record(12, motion=motion)
    result = td_icp(t_imu, gyro, t_cam, R)
    assert result.status == "refused" and "no motion" in result.reason


def test_one_axis_keeps_the_delay_and_names_the_axis_that_is_lost():
    motion = Motion(13, axes=(0.0, 0.0, 1.0))
    t_imu, gyro, t_cam, R, *_ = record(13, 0.3, motion=motion)
    result = td_icp(t_imu, gyro, t_cam, R)
    assert result.status == "degenerate"
    axis = np.array(re.search(r"\((.*?)\) of the IMU", result.reason)[1].split(), dtype=float)
    np.testing.assert_allclose(axis, [0, 0, 1], atol=0.05)
    assert abs(result.timeshift_cam_imu_s - 0.3) < 4 * result.timeshift_sigma_s
    assert result.rotation_sigma_rad.max() > 0.1


def test_a_constant_rate_loses_the_delay():
    class Turning(Motion):
        def vector(self, t):
            return t[:, None] * np.array([0.3, -0.2, 0.25])

    t_imu, gyro, t_cam, R, *_ = record(14, 0.05, motion=Turning(14))
    result = td_icp(t_imu, gyro, t_cam, R)
    assert result.status != "ok"


def test_swapped_gyro_axes_and_inverted_orientations_are_refused():
    t_imu, gyro, t_cam, R, *_ = record(15)
    mirrored = td_icp(t_imu, gyro * np.array([1.0, 1.0, -1.0]), t_cam, R)
    assert mirrored.status == "refused" and "mirrored" in mirrored.reason
    inverted = td_icp(t_imu, gyro, t_cam, np.swapaxes(R, 1, 2))
    assert inverted.status == "refused" and inverted.reason


@pytest.mark.parametrize(("factor", "said"), [(1 / DEG, "degrees per second"), (DEG, "divided by 57.3")])
def test_a_gyro_in_another_unit_is_named(factor, said):
    t_imu, gyro, t_cam, R, *_ = record(15)
    result = td_icp(t_imu, gyro * factor, t_cam, R)
    assert result.status == "refused" and said in result.reason


def test_a_rig_that_turns_for_less_than_half_of_the_time_is_no_wrong_unit_of_the_gyro():
    """It moves along without turning in between; orientations from tracks then err by a degree."""

    class Halting(Motion):
        def vector(self, t):
            since = np.mod(t, 4.0)
            return super().vector(t) * np.exp(-(((since - 0.9) / 0.5) ** 4))[:, None]

    motion = Halting(15)
    t_imu, _, t_cam, R, *_ = record(15, 0.05, 20.0, motion)
    t = t_cam + 0.05
    R = R @ so3.exp(1.0 * DEG * np.stack([np.sin(4 * t), np.sin(5 * t), np.cos(4.4 * t)], axis=1))
    result = td_icp(t_imu, motion.rate(t_imu), t_cam, R)
    assert "57.3" not in result.reason


@pytest.mark.parametrize("dps", [12.0, 60.0])
@pytest.mark.parametrize("seconds", [4.0, 10.0])
def test_a_board_that_is_waved_before_a_rig_at_rest_is_named(dps, seconds):
    t_imu, gyro, t_cam, R, _, bias = record(4, seconds=seconds, motion=Motion(4, dps))
    still = bias + np.random.default_rng(4).normal(0, 5.2e-3, gyro.shape)
    result = td_icp(t_imu, still, t_cam, R)
    assert result.status == "refused"
    assert "move the rig, not the board" in result.reason


def test_another_recording_is_refused():
    t_imu, gyro, *_ = record(16)
    _, _, t_cam, R, *_ = record(17)
    result = td_icp(t_imu, gyro, t_cam, R)
    assert result.status == "refused" and result.reason


def test_too_little_data_is_refused():
    t_imu, gyro, t_cam, R, *_ = record(18)
    assert "at least 12" in td_icp(t_imu, gyro, t_cam[:5], R[:5]).reason
    assert "too few" in td_icp(t_imu[:5], gyro[:5], t_cam, R).reason
    set_by_ntp = t_imu + 1.4e9 * (np.arange(len(t_imu)) > 5)  # 1 TiB was asked for
    assert "jump by 16204 days: its clock was set" in td_icp(set_by_ntp, gyro, t_cam, R).reason
    assert "overlap" in td_icp(t_imu, gyro, t_cam + 1000.0, R).reason
    assert td_icp(t_imu, gyro, np.zeros(0), np.zeros((0, 3, 3))).status == "refused"


def test_stamp_jitter_widens_the_sigma():
    t_imu, gyro, t_cam, R, *_ = record(19)
    rng = np.random.default_rng(1)
    noisy = t_cam + rng.normal(0, 3e-3, len(t_cam))
    result = td_icp(t_imu, gyro, noisy, R)
    assert result.status == "ok"
    assert abs(result.timeshift_cam_imu_s) < 4 * result.timeshift_sigma_s
    assert result.timeshift_sigma_s > 1.1 * td_icp(t_imu, gyro, t_cam, R).timeshift_sigma_s


@pytest.mark.parametrize("factor", [1.05, 0.95])
def test_stretched_stamps_are_blamed_and_not_the_rotations(factor):
    t_imu, gyro, t_cam, R, *_ = record(20, 0.3)
    result = td_icp(t_imu, gyro, t_cam[0] + factor * (t_cam - t_cam[0]), R)
    assert result.status == "refused" and "the stamps of camera and IMU" in result.reason
    said = float(re.search(r"are ([0-9.]+) % too", result.reason)[1])
    assert said == pytest.approx(100 * abs(factor - 1), abs=0.4)
    assert ("fast" if factor > 1 else "slow") in result.reason
    assert "direction" not in result.reason


def test_the_rate_of_the_stamps_is_measured_where_it_is_small():
    t_imu, gyro, t_cam, R, *_ = record(21, 0.1)
    sound = td_icp(t_imu, gyro, t_cam, R)
    assert abs(sound.stamp_rate) < 4 * sound.stamp_rate_sigma < 4e-4
    middle = t_cam.mean()
    drifting = td_icp(t_imu, gyro, middle + (t_cam - middle) / (1 + 5e-4), R)
    assert abs(drifting.stamp_rate - 5e-4) < 4 * drifting.stamp_rate_sigma
    assert drifting.status == "ok"
    uneven = td_icp(t_imu, gyro, middle + (t_cam - middle) / 1.003, R)
    assert uneven.status == "degenerate" and "stamps" in uneven.reason
