"""Gravity at the place of a recording is not 9.80665 m/s^2: its magnitude is a state."""

from __future__ import annotations

import numpy as np
import pytest
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.random_rigs import draw
from vical_mocks.rig import STANDARD_GRAVITY_MPS2

from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions, gravity_sigma_mps2

OFF_MPS2 = 0.02  # from the standard to Helsinki or Manila


def answered(seed: int, *, target_free: bool):
    run, known = draw(seed, 20.0, target_free=target_free)
    prior = camera_prior(run, seed, StartErrors(), exact_lens=known)
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"}) if known else frozenset(),
        target_free=target_free,
        gravity_mps2=STANDARD_GRAVITY_MPS2 + OFF_MPS2,
        imu_noise=imu_noise(run),
    )
    subject = CalibratorSubject(options, prior, None if target_free else run.points_m)
    return feed(run, subject), subject.calibrator


@pytest.mark.parametrize(("seed", "target_free"), [(900, False), (909, False), (907, True), (909, True)])
def test_gravity_that_is_not_the_standard_one_is_found_and_no_imu_is_blamed(seed, target_free):
    """As it was taken for exact, a scale error of the IMU was announced on all of these."""
    record, calibrator = answered(seed, target_free=target_free)
    assert EventKind.IMU_INTRINSICS not in {event.kind for _, event in record.events}
    last = record.snapshots[-1]
    assert last.status == "converged"
    assert np.abs(last.error[:7] / np.sqrt(np.diag(last.covariance))[:7]).max() < 4.0
    if target_free:
        size, sigma = calibrator.latest.imu[0], calibrator.latest.sigma(calibrator.layout.gravity)
    else:
        f = calibrator.filter
        size = np.linalg.norm(f.state.gravity)
        up = f.state.gravity / size
        sigma = np.sqrt(up @ f.covariance([15, 16, 17]) @ up)
    assert abs(size - STANDARD_GRAVITY_MPS2) < 4.0 * sigma
    assert sigma < 0.5 * OFF_MPS2
    shown = calibrator.estimate().gravity_world_mps2
    assert np.linalg.norm(shown) == pytest.approx(STANDARD_GRAVITY_MPS2 + OFF_MPS2)  # as it was stated


def test_what_is_stated_is_known_better_than_the_standard():
    assert gravity_sigma_mps2(STANDARD_GRAVITY_MPS2) == CalibrationOptions().gravity_sigma_mps2
    assert gravity_sigma_mps2(9.81) < 0.3 * gravity_sigma_mps2(STANDARD_GRAVITY_MPS2)
