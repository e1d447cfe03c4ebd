"""Likelihood ratios of jumps from one run, against runs of a Kalman filter that knows of each jump."""

import numpy as np
import pytest
from scipy.special import logsumexp
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import simulate
from vical_mocks.rig import Bump, reference_rig

from vical_daemon.estimation.filter.jump_scores import SIZES, JumpScores, JumpSizes
from vical_daemon.estimation.filter.passed import Corrected, Moved
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.estimation.model.unscented import solve_upper, upper_root

IMAGES, SIGMA = 12, np.array([0.7, 0.4])
NOISE, SECONDS, DRIFTS = 1e-3 * np.eye(12), 0.3, [(11, 10)]


@pytest.fixture
def problem():
    """Nine errors that move and three that do not; images of five rows in four ways."""
    rng = np.random.default_rng(3)
    F = np.eye(12)
    F[:9, :9] += 0.1 * rng.standard_normal((9, 9))
    F[DRIFTS[0]] = SECONDS
    images = [
        (rng.standard_normal((5, 4)), rng.standard_normal((4, 12)), rng.standard_normal(5))
        for _ in range(IMAGES)
    ]
    return F, images


def run(F, images, jump_at=None, size=1.0):
    """Log-likelihood, and the scores where no jump is known."""
    S = 0.5 * np.eye(12)
    mean, total = np.zeros(12), 0.0
    passed = []
    columns = np.zeros((12, 2))
    columns[[9, 11], [0, 1]] = SIGMA
    P = S @ S.T
    for k, (ways, by_error, z) in enumerate(images):
        if k == jump_at:
            P = P.copy()
            P[[9, 11], [9, 11]] += (size * SIGMA) ** 2
        H = ways @ by_error
        V = np.eye(5) + H @ P @ H.T
        r = z - H @ mean
        total -= 0.5 * (r @ np.linalg.solve(V, r) + np.linalg.slogdet(V)[1])
        L = upper_root(np.linalg.cholesky(P))
        K = P @ H.T @ np.linalg.inv(V)
        mean, P = mean + K @ r, P - K @ H @ P
        after = upper_root(np.linalg.cholesky(P))
        seen = Corrected(L, after, after, ways, r, by_error @ L)
        mean, P = F @ mean, F @ P @ F.T + NOISE
        passed.append([seen, Moved(after, upper_root(np.linalg.cholesky(P)), F[:9] @ after, SECONDS)])
    return total, JumpScores.of(passed, [columns] * IMAGES, DRIFTS)


def test_ratios_are_those_of_filters_that_know_of_the_jump(problem):
    F, images = problem
    without, scores = run(F, images)
    ratios = scores.log_ratios(slice(0, 2))
    each = [[run(F, images, k, size)[0] - without for size in SIZES] for k in range(IMAGES)]
    assert ratios == pytest.approx(logsumexp(each, axis=1) - np.log(len(SIZES)), abs=1e-9)


def estimated(F, images, size):
    """Log-likelihood, mean square of the jump, and what `JumpSizes` say, with a jump of `size` at first."""
    columns = np.zeros((12, 2))
    columns[[9, 11], [0, 1]] = SIGMA * size
    P = 0.25 * np.eye(12) + columns @ columns.T
    joint = np.block([[P, columns], [columns.T, np.eye(2)]])  # of the state after the jump, and the jump
    mean, total = np.zeros(14), 0.0
    jumped = JumpSizes.of(columns)
    motion = np.eye(14)
    motion[:12, :12] = F
    for ways, by_error, z in images:
        L = upper_root(np.linalg.cholesky(joint[:12, :12]))
        H = np.concatenate([ways @ by_error, np.zeros((5, 2))], axis=1)
        r = z - H @ mean
        V = np.eye(5) + H @ joint @ H.T
        total -= 0.5 * (r @ np.linalg.solve(V, r) + np.linalg.slogdet(V)[1])
        K = joint @ H.T @ np.linalg.inv(V)
        mean, joint = mean + K @ r, joint - K @ H @ joint
        dx, after = (K @ r)[:12], upper_root(np.linalg.cholesky(joint[:12, :12]))
        jumped.correct(L, after, dx)
        L = after
        jumped.predict(F[:9] @ L, L)
        jumped.D[11] += SECONDS * jumped.D[10]  # as the filter does
        mean, joint = motion @ mean, motion @ joint @ motion.T
    return total, size**2 * (mean[12:] ** 2 + np.diag(joint)[12:]), jumped


def test_sizes_are_those_of_filters_that_estimate_the_jump(problem):
    each = [estimated(*problem, size) for size in SIZES]
    totals, squares = np.array([x[0] for x in each]), np.array([x[1] for x in each])
    jumped = each[0][2]
    assert jumped.any_size == pytest.approx(logsumexp(totals) - np.log(len(SIZES)) - totals[0], abs=1e-9)
    expected = np.exp(totals - logsumexp(totals)) @ squares
    assert jumped.sizes == pytest.approx(np.sqrt(expected), abs=1e-9)


def test_a_jump_is_never_known_better_than_the_state_after_it(monkeypatch):
    """Nor after a turn that is large: the covariance with the jump is in the errors of the moved state."""
    rig = reference_rig(3, timeshift_cam_imu_s=0.01, bumps=(Bump(12.0, tuple(np.deg2rad([2.0, -1.0, 2.0]))),))
    run = simulate(3, 14.0, rig=rig)
    ordinary, least = JumpSizes.correct, []

    def correct(self, before, after, dx):
        by_jump = solve_upper(before, self.D)
        least.append(np.linalg.eigvalsh(self.covariance - by_jump.T @ by_jump)[0])
        ordinary(self, before, after, dx)

    monkeypatch.setattr(JumpSizes, "correct", correct)
    options = CalibrationOptions(imu_noise=imu_noise(run))
    feed(run, CalibratorSubject(options, camera_prior(run, 3, StartErrors(), exact_lens=False), run.points_m))
    assert len(least) > 100
    assert min(least) > -1e-6
