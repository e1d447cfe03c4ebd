"""A small Monte Carlo of the target-free calibration with fixed seeds: near the bound, and honest about it.

Limits are chi-square quantiles at 99.9 %, as in `test_calibration_statistics.py`.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from vical_mocks.cramer_rao.bound import bounds
from vical_mocks.cramer_rao.information import BoundOptions
from vical_mocks.curves import Pause
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise, nees
from vical_mocks.random_rigs import draw
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.measurements import CalibrationOptions

pytestmark = pytest.mark.statistical
TRIALS, SECONDS, CAMERA_HZ = 6, 9.0, 8.0
BLOCKS = ("p_imu_cam", "r_imu_cam", "timeshift")


def one_trial(seed):
    shift_s = float(np.random.default_rng([seed, 91]).uniform(-0.05, 0.05))
    run = simulate_tracks(
        seed,
        SECONDS,
        rig=reference_rig(seed, timeshift_cam_imu_s=shift_s),
        camera_rate_hz=CAMERA_HZ,
        max_features=40,
    )
    prior = camera_prior(run, seed, StartErrors(), exact_lens=True)
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), target_free=True, imu_noise=imu_noise(run))
    record = feed(run, CalibratorSubject(options, prior, None))
    limit = bounds(run, BoundOptions(intrinsics=False, distortion=False, target_free=True))[0]
    return record, np.concatenate([limit.sigma(name) for name in BLOCKS])


@pytest.fixture(scope="module")
def trials():
    return [one_trial(seed) for seed in range(200, 200 + TRIALS)]


def test_every_trial_starts_and_none_ends_wrong(trials):
    for record, _ in trials:
        assert record.started_s() <= 7.0
        last = record.snapshots[-1]
        assert nees(last.error, last.covariance, 7) < chi2.isf(1e-4, 7)


def test_mean_nees_is_one(trials):
    total = sum(nees(r.snapshots[-1].error, r.snapshots[-1].covariance, 7) for r, _ in trials)
    low, high = chi2.ppf([0.0005, 0.9995], 7 * TRIALS)
    assert low < total < high


def test_sigmas_are_near_the_bound_and_not_below(trials):
    ratio = np.array(
        [np.sqrt(np.diag(record.snapshots[-1].covariance))[:7] / bound for record, bound in trials]
    )
    assert 0.97 < np.median(ratio) < 1.35
    assert ratio.min() > 0.9


def with_blocks(seed):
    """Readout and matrices of the imu unknown: normalised squared errors of the 7, the readout, the 15."""
    rng = np.random.default_rng([seed, 94])
    lower = np.eye(3) + np.tril(0.01 * rng.standard_normal((3, 3)))
    rig = reference_rig(
        seed,
        timeshift_cam_imu_s=float(rng.uniform(-0.05, 0.05)),
        readout_s=float(rng.uniform(-0.03, 0.03)),
        gyro_matrix=np.eye(3) + 0.01 * rng.standard_normal((3, 3)),
        accel_matrix=np.linalg.inv(lower),
    )
    run = simulate_tracks(seed, SECONDS, rig=rig, camera_rate_hz=CAMERA_HZ, max_features=40)
    prior = camera_prior(run, seed, StartErrors(), exact_lens=True)
    estimate = frozenset({"readout", "imu_intrinsics"})
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"}), estimate=estimate, target_free=True, imu_noise=imu_noise(run)
    )
    subject = CalibratorSubject(options, prior, None)
    last = feed(run, subject).snapshots[-1]
    estimate = subject.calibrator.estimate()
    camera, carry = estimate.cameras["cam0"], subject.calibrator.latest
    matrices = np.concatenate(
        [
            (np.array(estimate.imu.gyro_matrix) - np.linalg.inv(rig.gyro_matrix)).ravel(),
            (np.array(estimate.imu.accel_matrix) - lower)[np.tril_indices(3)],
        ]
    )
    entries = slice(carry.layout.gyro_matrix.start, carry.layout.accel_matrix.stop)
    P = carry.covariance()[entries, entries]
    return (
        nees(last.error, last.covariance, 7),
        ((camera.readout_s - rig.readout_s) / camera.readout_sigma_s) ** 2,
        matrices @ np.linalg.solve(P, matrices),
    )


def test_optional_blocks_are_as_good_as_they_say():
    found = np.array([with_blocks(seed) for seed in range(300, 300 + TRIALS)])
    for squares, dof in zip(found.T, (7, 1, 15), strict=True):
        low, high = chi2.ppf([0.0005, 0.9995], dof * TRIALS)
        assert low < squares.sum() < high, dof


@pytest.mark.parametrize("seed", [933, 966])
def test_stop_and_go_motion_starts(seed):
    """At rest no distance shows: steps cut off at infinity lowered nothing, and no window settled."""

    def paused(rig):
        pauses = [Pause(2.5 * k + 1.2, 2.5 * k + 2.4) for k in range(6)]
        return replace(rig, trajectory=rig.trajectory.with_pauses(pauses, ramp_s=0.3))

    run, known = draw(seed, 12.0, target_free=True, change=paused)
    prior = camera_prior(run, seed, StartErrors(0.03, 0.01 * run.rig.lens.resolution[0]), exact_lens=known)
    fix = frozenset({"intrinsics"}) if known else frozenset()
    record = feed(
        run,
        CalibratorSubject(
            CalibrationOptions(fix=fix, target_free=True, imu_noise=imu_noise(run)), prior, None
        ),
    )
    assert record.started_s() is not None and record.started_s() <= 8.0
    last = record.snapshots[-1]
    assert nees(last.error, last.covariance, 7) < chi2.isf(1e-4, 7)
