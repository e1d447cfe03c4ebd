"""A small Monte Carlo of the target-free calibration with fixed seeds: near the bound, and honest about it.

Limits are chi-square quantiles at 99.9 %, as in `test_calibration_statistics.py`.
"""

import numpy as np
import pytest
from scipy.stats import chi2
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks

from benchmarks.bound import BoundOptions, bounds
from benchmarks.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from benchmarks.scores import nees
from vical_daemon.estimation.measurements import CalibrationOptions

pytestmark = [pytest.mark.statistical, pytest.mark.timeout(600)]
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
