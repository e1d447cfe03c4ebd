"""What is reported without a target is the mixture over the alternative models."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tests.unit.estimation.some_layout import window_layout
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.model.priors import ENTRY_SIGMA, LAG_SIGMA_S
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.selection.model_selection import IMU
from vical_daemon.estimation.smoother.alternative_models import AlternativeModels
from vical_daemon.estimation.smoother.marginal_prior import CORE, MarginalPrior, root_of
from vical_daemon.estimation.smoother.snapshot import camera_estimate

PRIOR = np.array([ENTRY_SIGMA] * 15 + [LAG_SIGMA_S])
LAYOUT = window_layout()
N = LAYOUT.size - CORE
NUMBERS = 1 + np.arange(16)  # of the imu; the first of the constants is gravity
STATED = {"both": NUMBERS, "imu": NUMBERS[:15], "lag": NUMBERS[15:], "none": NUMBERS[:0]}
POSE, SHIFT = slice(17, 23), 23


def carry(seed, off):
    """A calibration in which what is known of the imu hangs together with all the rest."""
    rng = np.random.default_rng(seed)
    size = np.array([0.015, *PRIOR] + [1e-3] * 6 + [1e-4, 1e-5] + [1.0] * 4 + [1e-3] * 4 + [1e-4])
    half = rng.standard_normal((N, N + 4)) / np.sqrt(N)
    P = half @ half.T * np.outer(size, size) * 0.3
    whole = np.eye(CORE + N)
    whole[CORE:, CORE:] = P
    imu = off * np.sqrt(np.diag(P))[NUMBERS] * rng.standard_normal(16)
    camera = CameraState(
        np.eye(3),
        rng.standard_normal(3),
        0.01,
        np.array([500.0, 500.0, 320.0, 240.0]),
        np.zeros(4),
        "radtan",
        (640, 480),
    )
    imu = np.concatenate([[9.8], imu])
    return MarginalPrior(np.eye(3), np.zeros(3), np.zeros(6), camera, root_of(whole), LAYOUT, 0.0, imu), P


def given_stated(P, x, at):
    """Mean and covariance where `at` is zero, from the information matrix."""
    rest = np.setdiff1d(np.arange(N), at)
    information = np.linalg.inv(P)
    left = np.linalg.inv(information[np.ix_(rest, rest)])
    mean, covariance = np.zeros(N), np.zeros((N, N))
    mean[rest] = x[rest] + left @ information[np.ix_(rest, at)] @ x[at]
    covariance[np.ix_(rest, rest)] = left
    return mean, covariance


def mixture(P, x):
    """Odds by Savage and Dickey, each hypothesis in one of twenty rigs; mean and covariance over all four."""
    odds, parts = {}, {}
    for name, at in STATED.items():
        k = {"both": 2, "imu": 1, "lag": 1, "none": 0}[name]
        sigma = PRIOR[at - 1]
        posterior = multivariate_normal.pdf(np.zeros(len(at)), x[at], P[np.ix_(at, at)]) if k else 1.0
        prior = multivariate_normal.pdf(np.zeros(len(at)), None, np.diag(sigma**2)) if k else 1.0
        odds[name] = 0.95**k * 0.05 ** (2 - k) * posterior / prior
        parts[name] = given_stated(P, x, at)
    total = sum(odds.values())
    mean = sum(odds[n] * parts[n][0] for n in odds) / total
    return mean, sum(
        odds[n] / total * (parts[n][1] + np.outer(parts[n][0] - mean, parts[n][0] - mean)) for n in odds
    )


@pytest.mark.parametrize(("seed", "off"), [(1, 0.0), (2, 0.7), (3, 1.5), (4, 2.5)])
def test_what_is_told_is_the_mixture_of_dense_gaussians(seed, off):
    known, P = carry(seed, off)
    x = np.zeros(N)
    x[NUMBERS] = known.imu[1:]
    models = AlternativeModels(LAYOUT, asked=frozenset(), rolling=True)
    models.drifting = True
    reported = camera_estimate(
        replace(models.weighed(known, 1.0, compared=True), asked=frozenset({IMU})), 0.5, 0.5
    )
    mean, covariance = mixture(P, x)
    assert np.array(reported.T_imu_cam.p_m) - known.camera.p_imu_cam == pytest.approx(
        mean[POSE][:3], abs=1e-9
    )
    assert reported.timeshift_cam_imu_s - 0.01 == pytest.approx(mean[SHIFT], abs=1e-12)
    assert np.array(reported.T_imu_cam.covariance) == pytest.approx(
        covariance[POSE, POSE], rel=1e-6, abs=1e-13
    )
    assert reported.timeshift_sigma_s == pytest.approx(np.sqrt(covariance[SHIFT, SHIFT]), rel=1e-6)


@pytest.mark.parametrize("drifting", [False, True])
def test_until_something_is_learnt_the_models_are_weighed_once_and_the_time_shift_moves_on(drifting):
    known, _ = carry(7, 1.0)
    known.camera = replace(known.camera, skew=3e-5)
    models = AlternativeModels(LAYOUT, asked=frozenset(), rolling=True)
    models.drifting = drifting
    weighed = models.weighed(known, 1.0, compared=True)
    assert models.weighed(known, 1.0, compared=True) is weighed
    later, then = camera_estimate(weighed, 0.5, 0.5, later_s=0.7), known.at(known.t_cam_s + 0.7)
    anew = camera_estimate(models.weighed(then, 1.0, compared=True), 0.5, 0.5)
    assert later.timeshift_cam_imu_s == pytest.approx(anew.timeshift_cam_imu_s, abs=1e-12)
    assert later.timeshift_cam_imu_s != camera_estimate(weighed, 0.5, 0.5).timeshift_cam_imu_s
    np.testing.assert_allclose(
        later.calibration_covariance, anew.calibration_covariance, rtol=1e-6, atol=1e-15
    )
    for changes in ({"factor": 1.2, "compared": True}, {"factor": 1.0, "compared": False}):
        assert models.weighed(known, **changes) is not weighed
    models.stamp_sigma_s = 1e-5
    assert models.weighed(known, 1.0, compared=True) is not weighed


def test_what_is_asked_for_is_never_taken_as_stated():
    known, _ = carry(5, 0.0)
    models = AlternativeModels(LAYOUT, asked=frozenset({"imu_intrinsics", "accel_lag"}), rolling=False)
    assert models.weighed(known, 1.0, compared=True).weights == {(): 1.0}


def test_until_windows_can_be_compared_the_imu_is_as_likely_true_as_not():
    known, _ = carry(6, 8.0)
    models = AlternativeModels(LAYOUT, asked=frozenset(), rolling=False)
    for compared, least in ((False, 0.5), (True, 0.0)):
        shares = models.weighed(known, 1.0, compared=compared).weights
        assert shares["imu_intrinsics", "accel_lag"] == pytest.approx(least, abs=1e-6)
        assert sum(shares.values()) == pytest.approx(1.0)
    kinds = {event.kind for event in models.watch(known, 1.0, compared=False)}
    assert EventKind.IMU_INTRINSICS not in kinds
    assert EventKind.IMU_INTRINSICS in {event.kind for event in models.watch(known, 1.0, compared=True)}
    assert models.watch(known, 1.0, compared=True) == []  # said once
