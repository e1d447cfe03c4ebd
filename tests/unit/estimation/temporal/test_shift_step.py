"""A step of the time shift against a curve whose true shift is known; and what it refuses to answer."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.rig import reference_rig

from vical_daemon.estimation.temporal.rotation_curves import GyroCurve
from vical_daemon.estimation.temporal.shift_step import (
    Orientations,
    find_shift,
    first_after_step,
    level_at,
)

SIGMA = np.deg2rad(0.1)
RIG = reference_rig(4)


def gyro_curve(rig=RIG):
    t = np.arange(0.0, 10.0, 0.01)
    gyro, _ = rig.imu_reading(t)
    return GyroCurve.integrate(t, gyro, np.zeros(3))


def orientations(shift_s, n=20, rig=RIG, turned=None, seed=0):
    """What a camera sees whose stamps are `shift_s` before the imu's."""
    t_imu = 5.0 + 0.05 * np.arange(n)
    R = rig.trajectory.R_world_imu(t_imu) @ rig.R_imu_cam
    if turned is not None:
        R = R @ Rotation.from_rotvec(turned).as_matrix()
    noise = Rotation.from_rotvec(SIGMA * np.random.default_rng(seed).standard_normal((n, 3))).as_matrix()
    return Orientations(t_imu - shift_s, R @ noise, np.full(n, SIGMA))


def fit(seen, present_s=0.0, level=1.0):
    return find_shift(gyro_curve(), seen, RIG.R_imu_cam, present_s, 1.5, level)


@pytest.mark.parametrize("shift_s", [0.02, -0.02, 0.5, -1.2, 1.0])
def test_finds_a_step_within_its_sigma(shift_s):
    found = fit(orientations(shift_s))
    assert found is not None
    assert found.stepped
    assert abs(found.timeshift_s - shift_s) < 4.0 * found.sigma_s
    assert found.sigma_s < 2e-3


def test_its_sigma_is_honest():
    z = []
    for seed in range(60):
        found = fit(orientations(0.3, seed=seed))
        z.append((found.timeshift_s - 0.3) / found.sigma_s)
    assert 0.7 < np.std(z) < 1.3  # 60 draws: 1 +- 0.09
    assert abs(np.mean(z)) < 0.4


def test_says_when_there_is_no_step():
    found = fit(orientations(0.0))
    assert found is not None
    assert not found.stepped


def test_a_mounting_that_moved_is_no_step():
    assert fit(orientations(0.0, n=40, turned=np.array([0.0, 0.05, 0.03]))) is None


def test_a_rig_at_rest_fits_everywhere_and_gives_no_answer():
    seen = orientations(0.3)
    R = np.repeat(seen.R_world_cam[:1], 20, axis=0)
    t = np.arange(0.0, 10.0, 0.01)
    still = GyroCurve.integrate(t, np.zeros((len(t), 3)), np.zeros(3))
    assert find_shift(still, seen._replace(R_world_cam=R), RIG.R_imu_cam, 0.0, 1.5, 1.0) is None


def test_too_few_images_or_no_readings_give_no_answer():
    assert fit(orientations(0.3, n=7)) is None
    assert fit(orientations(0.3)._replace(t_cam_s=100.0 + 0.05 * np.arange(20))) is None


def test_level_is_the_size_of_the_misfit():
    seen = orientations(0.0, n=30)
    assert level_at(gyro_curve(), seen, RIG.R_imu_cam, 0.0) == pytest.approx(1.0, abs=0.4)
    doubled = seen._replace(sigma_rad=0.5 * seen.sigma_rad)
    assert level_at(gyro_curve(), doubled, RIG.R_imu_cam, 0.0) == pytest.approx(4.0, rel=0.4)


@pytest.mark.parametrize(("step_s", "at"), [(0.02, 30), (-0.02, 45), (0.5, 10), (-0.5, 50)])
def test_no_image_from_after_a_step_is_taken_for_one_from_before(step_s, at):
    seen = orientations(0.0, n=60)
    stepped = seen._replace(t_cam_s=seen.t_cam_s - step_s * (np.arange(60) >= at))
    first = first_after_step(gyro_curve(), stepped, RIG.R_imu_cam, (0.0, step_s))
    # 20 ms at 1 rad/s are 1.1 deg, eleven sigma: one image leaves little doubt, two of them none.
    assert at - 3 <= first <= at


def test_where_a_step_is_needs_images_that_the_gyro_covers():
    seen = orientations(0.0, n=60)
    late = seen._replace(t_cam_s=seen.t_cam_s + 4.9)
    assert first_after_step(gyro_curve(), late, RIG.R_imu_cam, (0.0, 0.02)) is None
    assert first_after_step(gyro_curve(), orientations(0.0, n=6), RIG.R_imu_cam, (0.0, 0.02)) is None
