"""Likelihood ratios of jumps from one run, against runs of a Kalman filter that knows of each jump."""

import numpy as np
import pytest

from vical_daemon.estimation.filter.jump_scores import JumpScores, JumpSizes

IMAGES, SIGMA = 12, np.array([0.7, 0.4])


@pytest.fixture
def problem():
    """Nine errors that move and three that do not; images of five rows in four ways."""
    rng = np.random.default_rng(3)
    F = np.eye(12)
    F[:9, :9] += 0.1 * rng.standard_normal((9, 9))
    images = [
        (rng.standard_normal((5, 4)), rng.standard_normal((4, 12)), rng.standard_normal(5))
        for _ in range(IMAGES)
    ]
    return F, images


def run(F, images, jump_at=None):
    """Log-likelihood, and the scores where no jump is known."""
    S = 0.5 * np.eye(12)
    mean, total = np.zeros(12), 0.0
    scores = JumpScores.of(12, 2)
    columns = np.zeros((12, 2))
    columns[[9, 11], [0, 1]] = SIGMA
    P = S @ S.T
    for k, (ways, by_error, z) in enumerate(images):
        if k == jump_at:
            P = P.copy()
            P[[9, 11], [9, 11]] += SIGMA**2
        H = ways @ by_error
        V = np.eye(5) + H @ P @ H.T
        r = z - H @ mean
        total -= 0.5 * (r @ np.linalg.solve(V, r) + np.linalg.slogdet(V)[1])
        L = np.linalg.cholesky(P)
        scores.begin(columns)
        scores.update((ways, r), by_error, by_error @ L, L)
        K = P @ H.T @ np.linalg.inv(V)
        mean, P = mean + K @ r, P - K @ H @ P
        L = np.linalg.cholesky(P)
        scores.predict(F[:9, :9] @ L[:9, :9], L[:9, :9])
        mean, P = F @ mean, F @ P @ F.T
    return total, scores


def test_ratios_are_those_of_filters_that_know_of_the_jump(problem):
    F, images = problem
    without, scores = run(F, images)
    ratios = scores.log_ratios(slice(0, 2))
    expected = [run(F, images, k)[0] - without for k in range(IMAGES)]
    assert ratios == pytest.approx(expected, abs=1e-9)


def test_sizes_are_those_of_a_filter_that_estimates_the_jump(problem):
    F, images = problem
    columns = np.zeros((12, 2))
    columns[[9, 11], [0, 1]] = SIGMA
    P = 0.25 * np.eye(12) + columns @ columns.T
    joint = np.block([[P, columns], [columns.T, np.eye(2)]])  # of the state after the jump, and the jump
    mean = np.zeros(14)
    jumped = JumpSizes.of(columns)
    motion = np.eye(14)
    motion[:12, :12] = F
    for ways, by_error, z in images:
        L = np.linalg.cholesky(joint[:12, :12])
        H = np.concatenate([ways @ by_error, np.zeros((5, 2))], axis=1)
        r = z - H @ mean
        K = joint @ H.T @ np.linalg.inv(np.eye(5) + H @ joint @ H.T)
        mean, joint = mean + K @ r, joint - K @ H @ joint
        dx, after = (K @ r)[:12], np.linalg.cholesky(joint[:12, :12])
        jumped.correct(L, after, dx)
        L = after
        jumped.predict(F[:9, :9] @ L[:9, :9], L[:9, :9])
        mean, joint = motion @ mean, motion @ joint @ motion.T
    expected = np.sqrt(mean[12:] ** 2 + np.diag(joint)[12:])
    assert jumped.sizes == pytest.approx(expected, abs=1e-9)
