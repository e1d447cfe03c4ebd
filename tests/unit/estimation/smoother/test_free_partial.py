"""A rig that turns about one axis, without a target: what shows is right, the rest is named."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks import trajectory
from vical_mocks.curves import Curve, Pause, Paused, Sinusoids
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.rig import NOMINAL_P_IMU_CAM, NOMINAL_R_IMU_CAM, reference_rig
from vical_mocks.tracks import simulate_tracks

from benchmarks.verify import Plan
from tests.unit.estimation.test_target_free import subject_for
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.estimation.smoother.track_start import ArmPrior, NoStartError, mounting_about, still_axis

MOUNT = (NOMINAL_R_IMU_CAM, NOMINAL_P_IMU_CAM)


@dataclass
class Sum:
    """Two curves at once."""

    first: Curve
    second: Curve

    def evaluate(self, t_s):
        both = zip(self.first.evaluate(t_s), self.second.evaluate(t_s), strict=True)
        return tuple(a + b for a, b in both)


def run_of(motion, seed=1, seconds=24.0):
    rig = reference_rig(seed, timeshift_cam_imu_s=0.02, trajectory=motion)
    return simulate_tracks(seed, seconds, rig=rig, camera_rate_hz=10.0)


@pytest.fixture(scope="module")
def cart():
    run = run_of(trajectory.planar(1, T_imu_cam=MOUNT))
    subject = subject_for(run)
    return run, subject, feed(run, subject)


def test_a_cart_is_calibrated_but_for_the_lever_arm_along_its_axis(cart):
    _, subject, record = cart
    assert "converged" not in {status for _, status, _ in record.statuses}
    assert record.statuses[-1][1] == "degenerate"
    last = record.snapshots[-1]
    sigma = np.sqrt(np.diag(last.covariance))[:7]
    assert np.abs(last.error[3:7] / sigma[3:7]).max() < 4.0
    assert sigma[3:6].max() < np.deg2rad(0.5)
    assert sigma[6] < 3e-4
    camera = subject.calibrator.estimate().cameras["cam0"]
    (name,) = camera.unobservable
    assert "lever arm along the image's y axis" in name


def test_the_lever_arm_across_the_axis_is_right_and_along_it_not_claimed(cart):
    run, _, record = cart
    last = record.snapshots[-1]
    axes = run.rig.R_imu_cam
    spread = np.sqrt(np.diag(axes.T @ last.covariance[:3, :3] @ axes))
    assert spread[1] > 0.25
    assert max(spread[0], spread[2]) < 0.02
    off = axes.T @ last.error[:3]
    assert abs(off[0]) < 4.0 * spread[0]
    assert abs(off[2]) < 4.0 * spread[2]


def test_a_second_axis_makes_it_whole():
    nod = trajectory.one_axis(1, [1, 0, 0], T_imu_cam=MOUNT)
    hand = trajectory.hand_motion(1, T_imu_cam=MOUNT)
    both = trajectory.Trajectory(
        Sum(nod.rotation, Paused(hand.rotation, [Pause(0.0, 13.0)])),
        nod.position,
        nod.R_world_base0,
        (nod.R_base_imu, nod.p_base_imu),
    )
    run = run_of(both, seconds=30.0)
    subject = subject_for(run)
    held = []
    ordinary = subject.look

    def look(*arguments):
        held.append(subject.calibrator.evaluator.held is not None)
        return ordinary(*arguments)

    subject.look = look
    record = feed(run, subject)
    assert any(held)
    assert not held[-1]
    last = record.snapshots[-1]
    sigma = np.sqrt(np.diag(last.covariance))[:7]
    assert last.status == "converged"
    assert sigma[:3].max() < 2e-3
    assert np.abs(last.error[:7] / sigma).max() < 4.0


def test_the_axis_that_stays_is_found_from_the_gyro():
    t = np.arange(0.0, 6.0, 0.01)
    axis = np.array([1.0, 2.0, -1.0]) / np.sqrt(6.0)
    rates = np.sin(3.0 * t)[:, None] * axis
    bias = np.array([0.002, -0.003, 0.004])
    assert abs(still_axis(t, rates + bias, bias) @ axis) > 0.999
    assert still_axis(t, 0.0 * rates, np.zeros(3)) is None  # all of them stay
    wobble = np.cos(2.0 * t)[:, None] * np.array([2.0, -1.0, 0.0]) / np.sqrt(5.0)
    assert still_axis(t, rates + wobble, np.zeros(3)) is None


class Valley:
    """A stretch in which mountings miss by how far they are turned from the right one, or by nothing else."""

    def __init__(self, R, contrast):
        self.R, self.contrast = R, contrast

    def misfit(self, R_imu_cam, arm, rounds):
        off = np.linalg.norm(so3.log(self.R.T @ R_imu_cam))
        return np.hypot(1e-3, self.contrast * off)


AXIS = np.array([0.0, 0.6, 0.8])
ARM = ArmPrior(np.zeros(3), held=AXIS)


@pytest.mark.parametrize("turn_deg", [-170.0, -31.0, 4.0, 100.0])
def test_the_mounting_about_an_axis_is_searched_all_the_way_round(turn_deg):
    R = Rotation.random(rng=3).as_matrix()
    wrong = so3.exp(np.deg2rad(turn_deg) * AXIS) @ R
    found = mounting_about(Valley(R, 0.01), AXIS, wrong, ARM)
    assert np.linalg.norm(so3.log(R.T @ found)) < np.deg2rad(0.5)


def test_a_mounting_that_does_not_show_is_not_invented():
    with pytest.raises(NoStartError, match="second axis"):
        mounting_about(Valley(np.eye(3), 1e-3), AXIS, np.eye(3), ARM)


def test_a_cart_does_not_stretch_the_lens_that_it_cannot_show():
    """A longer focal length across the floor makes every angle there smaller: no reason to believe it."""
    run = run_of(trajectory.planar(1, T_imu_cam=MOUNT), seconds=9.0)
    subject = subject_for(run, lens_known=False)
    feed(run, subject)
    camera = subject.calibrator.estimate().cameras["cam0"]
    off = np.array(camera.intrinsics) - run.rig.lens.intrinsics
    assert np.all(np.abs(off) < 4.0 * np.array(camera.intrinsics_sigma))
    assert camera.intrinsics_sigma[1] > 5.0 * camera.intrinsics_sigma[0]


def test_a_drive_that_does_not_show_the_lens_starts_with_the_lens_as_given():
    # in the fit of rotations the lens ran away, and there was no start
    run = Plan("driving", 30.0, 14.0, 1.0).second(13)
    options = CalibrationOptions(target_free=True, imu_noise=imu_noise(run))
    prior = camera_prior(run, 13, StartErrors(), exact_lens=True)
    record = feed(run, CalibratorSubject(options, prior, None))
    assert record.snapshots
    sigma = np.sqrt(np.diag(record.snapshots[-1].covariance))[:7]
    assert np.abs(record.snapshots[-1].error[:7] / sigma).max() < 4.0


def test_turns_about_a_point_never_converge():
    """On a tripod's head, 12 cm from the camera: lever arm and distances may grow together."""
    run = run_of(trajectory.about_a_point(1, T_imu_cam=MOUNT), seconds=12.0)
    record = feed(run, subject_for(run))
    assert "converged" not in {status for _, status, _ in record.statuses}


def test_turns_about_a_point_that_sways_give_an_answer():
    head = trajectory.about_a_point(1, T_imu_cam=MOUNT)
    sway = Sinusoids(np.zeros(3), np.full((1, 3), 0.02), np.array([[0.5, 0.6, 0.7]]), np.zeros((1, 3)))
    there = Sum(head.position, sway)
    mount = (head.R_base_imu, head.p_base_imu)
    motion = trajectory.Trajectory(head.rotation, there, head.R_world_base0, mount)
    run = run_of(motion, seconds=8.0)
    assert feed(run, subject_for(run)).snapshots
