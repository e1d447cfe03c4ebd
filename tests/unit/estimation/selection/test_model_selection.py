"""Hypotheses about imu, lag, size and shape of the target: against dense Gaussians, and on recordings."""

from itertools import combinations

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from tests.unit.estimation.some_filter import NAME, imu_entries, off, some_filter
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.estimation.model.priors import ENTRY_SIGMA, LAG_SIGMA_S, SIZE_SIGMA, SURE
from vical_daemon.estimation.selection.model_mixture import log_bayes_factors
from vical_daemon.estimation.selection.model_selection import (
    IMU,
    LAG,
    SIZE,
    TARGET,
    averaged,
    in_doubt,
    weights,
)

EVERY = [true for n in range(5) for true in combinations((IMU, LAG, SIZE, TARGET), n)]


def conditioned(x, P, dense, true):
    """Mean and covariance if the blocks named are as specified."""
    if not true:
        return x, P
    zero = np.concatenate([dense.where[name] for name in true])
    gain = P[:, zero] @ np.linalg.inv(P[np.ix_(zero, zero)])
    return x - gain @ x[zero], P - gain @ P[zero]


@pytest.mark.parametrize(
    ("imu", "target", "lag", "size"),
    [(0.0, 0.0, 0.0, 0.0), (1.1, 0.0, 1.5, 0.0), (0.0, 1.1, 0.0, 1.5), (1.2, 1.2, 1.0, 1.0)],
)
def test_odds_are_those_of_the_measurements_under_each_hypothesis(imu, target, lag, size):
    f, _, _, dense = some_filter(imu, target, lag, size)
    logs = []
    for true in EVERY:
        prior = dense.prior.copy()
        for name in true:
            prior[dense.where[name]] = 0.0
        spread = dense.H @ np.diag(prior**2) @ dense.H.T + dense.noise**2 * np.eye(len(dense.z))
        likelihood = multivariate_normal.logpdf(dense.z, np.zeros(len(dense.z)), spread)
        logs.append(likelihood + np.log(0.95) * len(true) + np.log(0.05) * (4 - len(true)))
    expected = np.exp(np.array(logs) - max(logs))
    found = weights(f)
    assert set(found) == set(EVERY)
    np.testing.assert_allclose([found[true] for true in EVERY], expected / expected.sum(), rtol=1e-6)
    for name in (IMU, LAG, SIZE, TARGET):
        assert off(f, name) == pytest.approx(
            sum(p for true, p in found.items() if name not in true), rel=1e-9
        )


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_the_evidence_is_the_prior_over_the_posterior_density_at_zero(factor):
    _, x, P, dense = some_filter(factor=factor)
    entries = dense.where[IMU]
    # errors that last: what was learnt beyond the prior is worth `factor` times less
    full = np.linalg.inv(P[np.ix_(entries, entries)])
    prior = np.eye(15) / ENTRY_SIGMA**2
    tempered = np.linalg.inv(prior + (full - prior) / factor)
    mean = tempered @ full @ x[entries] / factor
    zero = np.zeros(15)
    expected = multivariate_normal.logpdf(zero, zero, ENTRY_SIGMA**2 * np.eye(15))
    expected -= multivariate_normal.logpdf(zero, mean, tempered)
    covariance = P[np.ix_(entries, entries)] / ENTRY_SIGMA**2
    assert log_bayes_factors(x[entries] / ENTRY_SIGMA, covariance, [15], factor, zero)[1] == pytest.approx(
        expected, rel=1e-9
    )


@pytest.mark.parametrize("less", [1.0, 3.0])
def test_hypotheses_that_share_their_work_are_weighed_as_if_each_were_alone(less):
    rng = np.random.default_rng(4)
    places, half = ([0, 1], [2, 3, 4], [5]), rng.standard_normal((6, 8)) / 3.0
    values, covariance, noise = (
        rng.standard_normal(6),
        half @ half.T,
        np.array([0.0, 0.0, 0.2, 0.0, 0.1, 0.0]),
    )
    found = log_bayes_factors(values, covariance, [2, 3, 1], less, noise)
    assert len(found) == 8 and found[0] == 0.0
    for number in range(1, 8):
        at = [k for block, own in enumerate(places) if number >> block & 1 for k in own]
        alone = log_bayes_factors(values[at], covariance[np.ix_(at, at)], [len(at)], less, noise[at])
        assert found[number] == pytest.approx(alone[1], rel=1e-9)


def test_nothing_learnt_is_no_evidence_however_long_errors_last():
    f, *_ = some_filter(factor=9.0)
    f.S = np.diag(np.full(f.layout.size, 1e-2))
    for where, sigma in (
        (slice(f.layout.gyro_matrix.start, f.layout.accel_matrix.stop), ENTRY_SIGMA),
        (slice(f.layout.accel_lag, f.layout.accel_lag + 1), LAG_SIGMA_S),
        (slice(f.layout.target_scale, f.layout.target_scale + 1), SIZE_SIGMA),
        (f.layout.target_shape, f.layout.target_modes.sigma_m),
    ):
        f.S[where, where] = sigma * np.eye(where.stop - where.start)
    f.state.gyro_matrix, f.state.accel_matrix = np.eye(3), np.eye(3)
    f.state.target_shape = np.zeros(11)
    f.state.accel_lag_s, f.state.target_scale = 0.0, 1.0
    assert off(f, IMU) == pytest.approx(0.05)
    assert off(f, TARGET) == pytest.approx(0.05)
    assert off(f, SIZE) == pytest.approx(0.05)


@pytest.mark.parametrize(("name", "unsure", "lasting"), [(IMU, 1.15, 2.8), (TARGET, 1.9, 3.2)])
def test_odds_go_the_way_of_the_evidence_and_images_that_do_not_fit_speak_the_less(name, unsure, lasting):
    def doubted(size, **how):
        return some_filter(*((size, 0.0) if name == IMU else (0.0, size)), **how)[0]

    assert off(doubted(0.0), name) < 0.05
    assert off(doubted(3.0), name) > SURE
    assert in_doubt(doubted(unsure)) == name
    assert off(doubted(unsure), name) < 0.5
    assert not in_doubt(doubted(unsure), believed=True)
    assert in_doubt(doubted(unsure * 1.2), believed=True) == name
    misfit, long = doubted(lasting, scale=4.0), doubted(lasting, factor=4.0)
    assert off(misfit, name) == pytest.approx(off(long, name), rel=1e-12)
    assert 0.05 < off(misfit, name) < off(doubted(lasting), name)
    assert in_doubt(long) == name
    assert not in_doubt(misfit)  # such images may never decide it: what is reported covers both
    misfit.off.add(name)
    assert off(misfit, name) == pytest.approx(1.0)


@pytest.mark.parametrize(("factor", "sizes"), [(1.0, (1.6, 1.1, 2.0, 1.5)), (3.0, (2.6, 1.8, 3.0, 2.0))])
def test_what_is_told_has_the_moments_of_the_mixture(factor, sizes):
    f, x, P, dense = some_filter(*sizes, factor=factor)
    shares = weights(f)
    assert sum(share > 0.01 for share in shares.values()) >= 4
    parts = {true: conditioned(x, P, dense, true) for true in EVERY}
    mean = sum(shares[true] * m for true, (m, _) in parts.items())
    covariance = sum(
        shares[true] * (factor * C + np.outer(m - mean, m - mean)) for true, (m, C) in parts.items()
    )
    reported = averaged(f)
    np.testing.assert_allclose(factor * reported.S @ reported.S.T, covariance, rtol=1e-6, atol=1e-13)
    shift = f.layout.cameras[NAME].timeshift
    assert reported.state.cameras[NAME].timeshift_s == pytest.approx(0.004 + mean[shift], rel=1e-8)
    np.testing.assert_allclose(imu_entries(reported.state), mean[dense.where[IMU]], atol=1e-12)
    assert reported.state.accel_lag_s == pytest.approx(mean[dense.where[LAG]][0], abs=1e-12)
    assert reported.state.target_scale == pytest.approx(1.0 + mean[dense.where[SIZE]][0], abs=1e-12)
    np.testing.assert_allclose(reported.state.target_shape, mean[dense.where[TARGET]], atol=1e-12)
    assert f.state.cameras[NAME].timeshift_s == pytest.approx(
        0.004 + x[shift], rel=1e-9
    )  # it goes on as it was


def calibrated(seed, size, seconds=16.0, **options):
    rng = np.random.default_rng([seed, 99])
    G = rng.standard_normal((3, 3))
    crooked = {
        "gyro_matrix": np.eye(3) + size * 0.5 * (G + G.T),
        "accel_matrix": np.eye(3) + size * rng.standard_normal((3, 3)),
    }
    run = simulate(seed, seconds, rig=reference_rig(seed, timeshift_cam_imu_s=0.01, **crooked), **options)
    options = CalibrationOptions(imu_noise=imu_noise(run))
    subject = CalibratorSubject(
        options, camera_prior(run, seed, StartErrors(), exact_lens=False), run.points_m
    )
    return feed(run, subject)


def largest_z(snapshot):
    return np.abs(snapshot.error[:7] / np.sqrt(np.diag(snapshot.covariance))[:7]).max()


@pytest.mark.parametrize("size", [3e-3, 1e-2])
def test_an_imu_that_is_off_is_noticed_and_nothing_told_is_far_out(size):
    record = calibrated(2, size)  # taken as true: 12 sigma at ten seconds, `converged`
    assert any(e.kind is EventKind.IMU_INTRINSICS for _, e in record.events)
    assert all(largest_z(s) < 4.0 for s in record.snapshots if s.status == "converged")
    assert largest_z(record.snapshots[-1]) < 3.5
    assert record.snapshots[-1].status == "converged"


@pytest.fixture(scope="module")
def as_specified():
    return calibrated(1, 0.0, seconds=32.0)


def test_a_true_imu_pays_nothing(as_specified):
    assert not any(e.kind is EventKind.IMU_INTRINSICS for _, e in as_specified.events)
    shot = as_specified.at(16.0)
    sigma = np.sqrt(np.diag(shot.covariance))
    assert sigma[0] < 5e-4  # half of what it is with the matrices estimated
    assert shot.status == "converged"


@pytest.mark.parametrize("asked", [frozenset(), frozenset({"size_effect"})])
def test_positions_of_an_accelerometers_axes_are_estimated_without_being_asked_for(asked):
    positions = np.array([[-5e-3, 8e-3, -1e-3], [2e-3, -4e-3, 0.0], [3e-3, -4e-3, 1e-3]])
    run = simulate(2, 20.0, rig=reference_rig(2, timeshift_cam_imu_s=0.01, accel_positions=positions))
    options = CalibrationOptions(imu_noise=imu_noise(run), estimate=asked)
    prior = camera_prior(run, 2, StartErrors(), exact_lens=False)
    subject = CalibratorSubject(options, prior, run.points_m)
    record = feed(run, subject)
    assert all(largest_z(s) < 3.5 for s in record.snapshots)  # taken as at one point: 7 sigma, `converged`
    assert record.snapshots[-1].status == "converged"
    found = np.array(subject.calibrator.estimate().imu.accel_positions_m)
    np.testing.assert_allclose(found, positions, atol=4e-3)
    np.testing.assert_allclose(found.sum(axis=0), 0.0, atol=1e-12)
    announced = [e.kind for _, e in record.events]
    assert announced == ([] if asked else [EventKind.ACCEL_POSITIONS])


@pytest.mark.parametrize("late_ms", [-0.3, 0.3])
def test_an_accelerometer_that_is_late_or_early_is_noticed_and_the_time_shift_is_the_gyros(late_ms):
    record = calibrated(2, 0.0, seconds=32.0, accel_lag_s=1e-3 * late_ms)  # taken as in step: 3 sigma off
    (event,) = (e for _, e in record.events if e.kind is EventKind.ACCEL_LAG)
    assert 1e3 * event.value == pytest.approx(late_ms, abs=0.15)
    assert all(abs(s.error[6]) < 3.5 * np.sqrt(s.covariance[6, 6]) for s in record.snapshots)
    assert abs(record.snapshots[-1].error[6]) < 4e-5


def test_one_that_is_in_step_pays_little(as_specified):
    assert not any(e.kind is EventKind.ACCEL_LAG for _, e in as_specified.events)
    assert np.sqrt(as_specified.snapshots[-1].covariance[6, 6]) < 3.1e-5  # 2.6e-5 at the bound
