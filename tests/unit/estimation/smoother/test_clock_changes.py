"""Clocks that change; mostly by linear windows that measure nothing but the time shift and its drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import room_landmarks, simulate_tracks

from tests.unit.estimation.some_layout import window_layout
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.estimation.model.priors import CLOCK_CHANGES_HZ, OFF, SKEW_SIGMA, STEP_SIGMA_S
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.smoother.alternative_models import AlternativeModels
from vical_daemon.estimation.smoother.clock_changes import (
    REMEMBERED,
    forgotten,
    mixed,
    opened,
    over_clocks,
    settled,
    what_happened,
)
from vical_daemon.estimation.smoother.marginal_prior import MarginalPrior, root_of

WINDOW_S, NOISE_S = 3.0, 60e-6
LAYOUT = window_layout(fix=("extrinsics", "intrinsics"), estimate=())
AT = LAYOUT.camera.timeshift
CAMERA = CameraState(
    p_imu_cam=np.zeros(3),
    R_imu_cam=np.eye(3),
    timeshift_s=0.01,
    intrinsics=np.array([500.0, 500.0, 320.0, 240.0]),
    distortion=np.zeros(4),
    distortion_model="radtan",
    resolution=(640, 480),
)


def started():
    P = np.diag([1.0] * AT + [1e-6, SKEW_SIGMA**2])
    motion = np.eye(3), np.zeros(3), np.zeros(6)
    return MarginalPrior(*motion, CAMERA, root_of(P), LAYOUT, 0.0, np.array([9.8]))


def after_window(carry, shift_s, rng, noise_s=NOISE_S):
    """What is known after a window that measured the time shift six times; `shift_s`: the truth, by time."""
    P, at = carry.covariance(), (np.arange(6) + 0.5) * WINDOW_S / 6
    H = np.zeros((6, len(P)))
    H[:, AT], H[:, AT + 1] = 1.0, at
    known = carry.camera.timeshift_s + carry.camera.skew * at
    R = 6.0 * noise_s**2 * np.eye(6)
    y = shift_s(carry.t_cam_s + at) + np.sqrt(6.0) * noise_s * rng.standard_normal(6) - known
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    dx, P = K @ y, P - K @ H @ P
    camera = replace(
        carry.camera,
        timeshift_s=carry.camera.timeshift_s + dx[AT],
        skew=carry.camera.skew + dx[AT + 1],
    )
    found = replace(carry, camera=camera, root=root_of(P), jumps=carry.jumps + dx[AT + 2 :])
    return found.at(carry.t_cam_s + WINDOW_S)


def followed(shift_s, windows, seed):
    """Announcements, and z of the time shift, of clocks that are followed as the calibrator does."""
    models, carry = AlternativeModels(LAYOUT, asked=frozenset(), rolling=True), started()
    rng, events, z = np.random.default_rng(seed), [], []
    for _ in range(windows):
        carry = after_window(carry, shift_s, rng)
        events += [(carry.t_cam_s, e) for e in models.watch(carry, 1.0, compared=False)]
        d, P = over_clocks(carry, models.clocks(carry, 1.0))
        error = carry.camera.timeshift_s + d[AT] - shift_s(carry.t_cam_s)
        z.append(float(error / np.sqrt(P[AT, AT])))
        carry, more = models.window_done(carry, 1.0)
        events += [(carry.t_cam_s, e) for e in more]
        carry = opened(carry)
    return events, np.array(z)


def three_windows(seed=3):
    carry, rng = started(), np.random.default_rng(seed)
    for _ in range(3):
        carry = after_window(opened(carry), lambda t: 0.01 + 3e-5 * np.maximum(t - 3.0, 0.0), rng)
    return carry


def unknowns(carry):
    """[drift before all jumps, jumps]: by the errors of the carry, and values."""
    rows = np.zeros((7, len(carry.root)))
    rows[0, AT + 1] = 1.0
    rows[0, [AT + 3, AT + 5, AT + 7]] = -1.0
    rows[1:, AT + 2 :] = np.eye(6)
    return rows, np.concatenate([[carry.camera.skew - carry.jumps[1::2].sum()], carry.jumps])


def zero_rows(free):
    """Combinations of the unknowns that are zero: all but those that are free, and the sum of a pair."""
    pairs = [x for x in free if len(x) == 2]
    rows = [np.eye(7)[k] for k in range(7) if k not in {k for x in free for k in x}]
    return np.array(rows + [np.eye(7)[a] + np.eye(7)[b] for a, b in pairs])


def test_a_jump_adds_its_variance_and_changes_nothing_else():
    carry = started()
    before, after = carry.covariance(), opened(carry).covariance()
    n = AT + 2
    added = after[:n, :n] - before
    assert np.diag(added)[-2:] == pytest.approx([STEP_SIGMA_S**2, SKEW_SIGMA**2])
    assert after[n:, n:] == pytest.approx(np.diag([STEP_SIGMA_S**2, SKEW_SIGMA**2]))
    assert added[:AT] == pytest.approx(np.zeros((AT, n)), abs=1e-12)
    # without the jump it is what it was
    dx, P = mixed(opened(carry), [(1.0, [(0,)])])
    assert dx == pytest.approx(np.zeros(n + 2), abs=1e-15)
    assert P[:n, :n] == pytest.approx(before, rel=1e-9, abs=1e-18)


def test_odds_are_densities_at_zero_over_those_before_the_data():
    carry = three_windows()
    rows, u = unknowns(carry)
    P, Q = rows @ carry.covariance() @ rows.T, np.diag([SKEW_SIGMA, *[STEP_SIGMA_S, SKEW_SIGMA] * 3]) ** 2
    found = what_happened(carry, 1.0, 0.0, 9.0, drifting=False)
    assert len(found) == 2 * (1 + 3 * 4 - 1)
    expected = []
    for c in found:
        A = zero_rows(c.free)
        odds = multivariate_normal.logpdf(np.zeros(len(A)), A @ u, A @ P @ A.T)
        odds -= multivariate_normal.logpdf(np.zeros(len(A)), None, A @ Q @ A.T)
        kind = OFF if c.step and c.rate else (0.25 if c.step else 0.5) * (1.0 - OFF)
        prior = (OFF if c.drifted else 1.0 - OFF) * (
            1.0 if c.jump < 0 else CLOCK_CHANGES_HZ * WINDOW_S * kind
        )
        expected.append(np.log(prior) + odds)
    weights = np.exp(np.array(expected) - max(expected))
    assert [c.probability for c in found] == pytest.approx((weights / weights.sum()).tolist(), rel=1e-6)


def test_mixture_is_that_of_conditioned_gaussians():
    carry = three_windows()
    (rows, u), P = unknowns(carry), carry.covariance()
    weighed = [(0.5, []), (0.3, [(0,)]), (0.2, [(3,), (4, 6)])]
    mean, second = np.zeros(len(P)), np.zeros_like(P)
    for p, free in weighed:
        A = zero_rows(free) @ rows
        K = np.linalg.solve(A @ P @ A.T, A @ P).T
        d = -K @ (zero_rows(free) @ u)
        mean += p * d
        second += p * (2.0 * (P - K @ A @ P) + np.outer(d, d))
    dx, covariance = mixed(carry, weighed, 2.0)
    sigma = np.sqrt(np.diag(P))
    assert dx / sigma == pytest.approx(mean / sigma, abs=1e-6)
    expected = (second - np.outer(mean, mean)) / np.outer(sigma, sigma)
    assert covariance / np.outer(sigma, sigma) == pytest.approx(expected, abs=1e-6)


def test_less_is_said_where_windows_disagree():
    carry = three_windows()
    prior = (1.0 - OFF) / (1.0 + 3.0 * CLOCK_CHANGES_HZ * WINDOW_S)
    known = what_happened(carry, 1.0, 0.0, 9.0, drifting=False)
    assert known[0].probability > prior + 0.01
    disagree = what_happened(carry, 1e6, 0.0, 9.0, drifting=False)
    assert disagree[0].probability == pytest.approx(prior, abs=1e-3)
    # the same where the imu's driver hardly knows its device's clock
    vague = what_happened(carry, 1.0, 0.1, 9.0, drifting=False)
    assert vague[0].probability == pytest.approx(prior, abs=1e-3)


def test_jumps_are_spaced_by_age_and_the_most_likely_stays():
    carry, rng = started(), np.random.default_rng(1)
    for k in range(60):
        step = 4e-4 if k > 20 else 0.0
        carry = after_window(carry, lambda t, s=step: np.full_like(t, 0.01 + s), rng)
        carry = opened(forgotten(carry, what_happened(carry, 1.0, 0.0, carry.t_cam_s, drifting=False)))
    assert len(carry.jump_t_s) == REMEMBERED
    assert 21 * WINDOW_S in carry.jump_t_s
    assert len(settled(carry, what_happened(carry, 1.0, 0.0, 180.0, drifting=False)).jumps) == 0


@pytest.mark.parametrize("rate", [1e-4, -1e-4])
def test_a_drift_that_begins_is_announced_as_one(rate):
    for seed in range(4):
        events, z = followed(lambda t: 0.01 + rate * np.maximum(t - 20.0, 0.0), 16, seed)
        ((t_s, event),) = events
        assert event.kind == EventKind.CLOCK_DRIFT
        assert t_s < 35.0
        assert event.value == pytest.approx(rate, rel=0.5)
        assert np.abs(z[10:]).max() < 4.0


def test_images_and_readings_show_a_drift_that_begins():
    rig = reference_rig(4, timeshift_cam_imu_s=0.01, clock_skew_ppm=100.0, clock_skew_from_s=14.0)
    run = simulate_tracks(4, 30.0, rig=rig, landmarks_m=room_landmarks(4, 200))
    prior = camera_prior(run, 4, StartErrors(), exact_lens=True)
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), target_free=True, imu_noise=imu_noise(run))
    record = feed(run, CalibratorSubject(options, prior, None), 0.5)
    assert [e.kind for _, e in record.events] == [EventKind.CLOCK_DRIFT]
    off = [abs(s.error[6]) / np.sqrt(s.covariance[6, 6]) for s in record.snapshots if s.t_s > 21.0]
    assert max(off) < 5.0
    assert abs(record.snapshots[-1].error[6]) < 2e-4  # it has drifted by 1.6 ms


def test_a_delay_that_grows_by_10_ms_within_a_window_is_no_jitter():
    """Half of the images of the window are late alike."""
    run = simulate_tracks(
        2, 26.0, rig=reference_rig(2, timeshift_cam_imu_s=0.01), landmarks_m=room_landmarks(2, 200)
    )
    late = [replace(f, t_cam_ns=f.t_cam_ns + 10_000_000 * (f.t_s >= 20.0)) for f in run.frames]
    prior = camera_prior(run, 2, StartErrors(), exact_lens=True)
    options = CalibrationOptions(target_free=True, imu_noise=imu_noise(run))
    record = feed(replace(run, frames=late), CalibratorSubject(options, prior, None), 0.5)
    assert [e.kind for _, e in record.events] == [EventKind.TIMESHIFT_STEPPED]
    assert record.events[0][1].value == pytest.approx(-0.01, abs=2e-4)
    after = [s for s in record.snapshots if s.t_s > 23.0 and s.status == "converged"]
    assert after and after[0].t_s < 25.0
    off = [abs(s.error[6] + 0.01) / np.sqrt(s.covariance[6, 6]) for s in after]
    assert max(off) < 5.0


@pytest.mark.parametrize("at_s", [21.0, 22.5])
def test_a_small_step_is_announced_as_one(at_s):
    for seed in range(4):
        events, z = followed(lambda t: np.where(t > at_s, 0.0105, 0.01), 20, seed)
        ((_, event),) = events
        assert event.kind == EventKind.TIMESHIFT_STEPPED
        assert event.value == pytest.approx(5e-4, abs=2e-4)
        assert np.abs(z[10:]).max() < 4.0


def test_a_known_drift_that_changes_wanders():
    events, z = followed(lambda t: 0.01 + 5e-5 * t + 1e-4 * np.maximum(t - 45.0, 0.0), 30, 2)
    assert [e.kind for _, e in events] == [EventKind.CLOCK_DRIFT, EventKind.CLOCK_WANDER]
    assert np.abs(z[-6:]).max() < 4.0


def test_clocks_that_run_alike_are_left_alone():
    every = [followed(lambda t: np.full_like(t, 0.01), 40, seed) for seed in range(12)]
    assert not any(events for events, _ in every)
    z = np.concatenate([z for _, z in every])
    assert np.abs(z).max() < 4.5
    assert 0.7 < np.sqrt((z**2).mean()) < 1.2
