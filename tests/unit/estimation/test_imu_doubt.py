"""Two hypotheses about an IMU's matrices: against dense Gaussians, and on recordings."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from benchmarks.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_daemon.estimation import so3
from vical_daemon.estimation.calibration_filter import CalibrationFilter
from vical_daemon.estimation.consistency import Consistency
from vical_daemon.estimation.corner_noise import CornerNoise
from vical_daemon.estimation.imu_doubt import (
    ENTRY_SIGMA,
    KNOWN_OFF_SIGMA,
    ImuDoubt,
    averaged,
    in_doubt,
    log_evidence,
    off,
)
from vical_daemon.estimation.measurements import CalibrationOptions, ImuNoise
from vical_daemon.estimation.retract import retract
from vical_daemon.estimation.state import LOWER, CameraState, State, make_layout

NAME = "cam0"


def some_filter(size=1.0, factor=1.0, scale=1.0):
    """A filter after linear measurements of entries and other states; entries lie `size` times as far off."""
    rng = np.random.default_rng(5)
    layout = make_layout(
        {NAME: "radtan"}, fix=frozenset({"intrinsics"}), estimate=frozenset({"imu_intrinsics"})
    )
    n, entries = layout.size, np.arange(layout.gyro_matrix.start, layout.accel_matrix.stop)
    sigma = np.full(n, 1e-2)
    sigma[entries] = ENTRY_SIGMA
    H = rng.normal(size=(2 * n, n))
    truth = np.zeros(n)
    truth[entries] = size * 1e-3 * rng.normal(size=15)
    noise = 8e-3
    z = H @ truth + noise * rng.normal(size=len(H))
    information = np.diag(sigma**-2) + H.T @ H / noise**2
    P = np.linalg.inv(information)
    x = P @ H.T @ z / noise**2
    camera = CameraState(
        so3.exp(np.array([0.3, -0.2, 0.9])), np.array([0.03, -0.05, 0.02]), 0.004,
        np.array([460.0, 455.0, 325.0, 238.0]), np.zeros(4), "radtan", (640, 480),
    )  # fmt: skip
    zero = np.zeros(3)
    start = State(1.0, np.eye(3), zero, zero, zero, zero, np.array([0.0, 0, -9.8]), {NAME: camera})
    consistency = Consistency()
    consistency.factor, consistency.scale = factor, scale
    f = CalibrationFilter(
        retract(start, layout, x), layout, np.linalg.cholesky(P), ImuNoise(), {NAME: CornerNoise(0.5)},
        np.zeros(n), {NAME: consistency}, imu_off=False,
    )  # fmt: skip
    return f, x, P, entries, (H, z, noise, sigma)


def values(state):
    return np.concatenate(
        [(state.gyro_matrix - np.eye(3)).ravel(), (state.accel_matrix - np.eye(3))[*LOWER.T]]
    )


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_the_evidence_is_the_prior_over_the_posterior_density_at_zero(factor):
    f, _, P, entries, _ = some_filter(factor=factor)
    # errors that last: what was learnt beyond the prior is worth `factor` times less
    full = np.linalg.inv(P[np.ix_(entries, entries)])
    prior = np.eye(15) / ENTRY_SIGMA**2
    tempered = np.linalg.inv(prior + (full - prior) / factor)
    mean = tempered @ full @ values(f.state) / factor
    zero = np.zeros(15)
    expected = multivariate_normal.logpdf(zero, zero, ENTRY_SIGMA**2 * np.eye(15))
    expected -= multivariate_normal.logpdf(zero, mean, tempered)
    assert log_evidence(f) == pytest.approx(expected, rel=1e-9)


def test_nothing_learnt_is_no_evidence_however_long_errors_last():
    f, *_ = some_filter(factor=9.0)
    f.S = np.diag(np.full(f.layout.size, 1e-2))
    entries = np.arange(f.layout.gyro_matrix.start, f.layout.accel_matrix.stop)
    f.S[entries, entries] = ENTRY_SIGMA
    f.state.gyro_matrix, f.state.accel_matrix = np.eye(3), np.eye(3)
    assert log_evidence(f) == pytest.approx(0.0, abs=1e-9)
    assert off(f) == pytest.approx(0.05)


def test_odds_go_the_way_of_the_evidence_and_images_that_do_not_fit_speak_the_less_of_the_imu():
    assert off(some_filter(0.0)[0]) < 0.05 < 0.99 < off(some_filter(3.0)[0])
    assert in_doubt(some_filter(3.0)[0])
    misfit, *_ = some_filter(3.0, scale=8.0)
    lasting, *_ = some_filter(3.0, factor=8.0)
    assert log_evidence(misfit) == pytest.approx(log_evidence(lasting), rel=1e-12)
    assert log_evidence(misfit) < 0.2 * log_evidence(some_filter(3.0)[0])
    assert log_evidence(misfit) > 0.0
    assert not in_doubt(misfit)  # such images may never decide it: what is told covers both


@pytest.mark.parametrize(("factor", "size"), [(1.0, 0.75), (3.0, 1.2)])
def test_what_is_told_has_the_moments_of_the_mixture(factor, size):
    f, x, P, entries, _ = some_filter(size, factor=factor)
    p = off(f)
    assert 0.01 < p < 0.99
    gain = P[:, entries] @ np.linalg.inv(P[np.ix_(entries, entries)])
    closed, P_closed = x - gain @ x[entries], P - gain @ P[entries]
    told = averaged(f, gyro_frame=False)
    shift = f.layout.cameras[NAME].timeshift
    mean = p * x + (1.0 - p) * closed
    covariance = factor * (p * P + (1.0 - p) * P_closed) + p * (1.0 - p) * np.outer(x - closed, x - closed)
    np.testing.assert_allclose(factor * told.S @ told.S.T, covariance, rtol=1e-7, atol=1e-14)
    assert told.state.cameras[NAME].timeshift_s == pytest.approx(0.004 + mean[shift], rel=1e-9)
    np.testing.assert_allclose(values(told.state), mean[entries], atol=1e-12)
    assert f.state.cameras[NAME].timeshift_s == pytest.approx(
        0.004 + x[shift], rel=1e-9
    )  # it goes on as it was


def test_once_announced_the_answer_is_that_of_a_wide_prior():
    f, _, _, entries, (H, z, noise, sigma) = some_filter(3.0)
    doubt = ImuDoubt()
    told = doubt.look(f)
    assert "scale or alignment of the imu" in told
    assert off(f) == 1.0
    assert doubt.look(f) == ""
    wide = sigma.copy()
    wide[entries] = KNOWN_OFF_SIGMA
    P = np.linalg.inv(np.diag(wide**-2) + H.T @ H / noise**2)
    np.testing.assert_allclose(f.S @ f.S.T, P, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(values(f.state), (P @ H.T @ z / noise**2)[entries], atol=1e-8)
    m, sigmas = 100.0 * (P @ H.T @ z / noise**2)[entries], 100.0 * np.sqrt(np.diag(P))[entries]
    surest = np.argmax(np.abs(m) / sigmas)
    assert f"{abs(m[surest]):.2f} +- {sigmas[surest]:.2f} %" in told


def test_the_gyros_frame_is_that_in_which_its_matrix_is_symmetric():
    f, *_ = some_filter(3.0)
    f.imu_off = True
    where = f.layout.cameras[NAME]

    def in_gyro_frame(state):
        """By the polar decomposition: M_g = Q A, A symmetric; what the imu frame is called is turned by Q."""
        U, _, Vt = np.linalg.svd(state.gyro_matrix)
        Q, camera = U @ Vt, state.cameras[NAME]
        return Q.T @ camera.R_imu_cam, Q.T @ camera.p_imu_cam

    told = averaged(f, gyro_frame=True)
    R, p = in_gyro_frame(f.state)
    np.testing.assert_allclose(told.state.cameras[NAME].R_imu_cam, R, atol=2e-5)
    np.testing.assert_allclose(told.state.cameras[NAME].p_imu_cam, p, atol=2e-6)
    J = np.zeros((6, f.layout.size))
    for k in range(f.layout.size):
        step = np.zeros(f.layout.size)
        step[k] = 1e-6
        (R1, p1), (R0, p0) = (in_gyro_frame(retract(f.state, f.layout, s)) for s in (step, -step))
        J[:, k] = np.concatenate([p1 - p0, so3.log(R0.T @ R1)]) / 2e-6
    rows = [
        *range(where.position.start, where.position.stop),
        *range(where.rotation.start, where.rotation.stop),
    ]
    expected = J @ f.S @ f.S.T @ J.T
    np.testing.assert_allclose(told.covariance(rows), expected, atol=0.02 * np.abs(expected).max())


def calibrated(seed, size, seconds=16.0):
    rng = np.random.default_rng([seed, 99])
    G = rng.standard_normal((3, 3))
    crooked = {
        "gyro_matrix": np.eye(3) + size * 0.5 * (G + G.T),
        "accel_matrix": np.eye(3) + size * rng.standard_normal((3, 3)),
    }
    run = simulate(seed, seconds, rig=reference_rig(seed, timeshift_cam_imu_s=0.01, **crooked))
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
    assert any("scale or alignment" in text for _, text in record.events)
    assert all(largest_z(s) < 4.0 for s in record.snapshots if s.status == "converged")
    assert largest_z(record.snapshots[-1]) < 3.5
    assert record.snapshots[-1].status == "converged"


def test_a_true_imu_pays_nothing():
    record = calibrated(1, 0.0)
    assert not any("scale or alignment" in text for _, text in record.events)
    sigma = np.sqrt(np.diag(record.snapshots[-1].covariance))
    assert sigma[0] < 5e-4  # half of what it is with the matrices estimated
    assert record.snapshots[-1].status == "converged"
