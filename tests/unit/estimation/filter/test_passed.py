"""The way back through what was done to a filter, against all images adjusted at once."""

import numpy as np
import pytest

from vical_daemon.estimation.filter.passed import Corrected, Moved, smoothed
from vical_daemon.estimation.model.unscented import upper_root

IMAGES, SIZE, SECONDS, DRIFTS = 8, 12, 0.3, [(11, 10)]


@pytest.fixture
def system():
    """Nine errors that move and three that do not, of which one drifts by another; images of five rows."""
    rng = np.random.default_rng(5)
    F = np.eye(SIZE)
    F[:9, :9] += 0.1 * rng.standard_normal((9, 9))
    F[DRIFTS[0]] = SECONDS
    Q = np.diag(np.r_[np.full(9, 0.04), np.zeros(3)]) + 1e-9 * np.eye(SIZE)
    ways, shared = rng.standard_normal((IMAGES, 5, 4)), rng.standard_normal((IMAGES, 4, 1))
    by_error = rng.standard_normal((IMAGES, 4, SIZE))
    return F, Q, ways, by_error, shared, rng.standard_normal((IMAGES, 5))


def test_smoothed_errors_are_those_of_all_images_at_once(system):
    F, Q, ways, by_error, shared, z = system
    mean, P, predicted, run = np.zeros(SIZE), 0.25 * np.eye(SIZE), [], []
    for W, B, C, y in zip(ways, by_error, shared, z, strict=True):
        L, H = upper_root(np.linalg.cholesky(P)), W @ B
        V = np.eye(5) + W @ C @ C.T @ W.T
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + V)
        predicted.append(mean)
        innovation = y - H @ mean
        mean, P = mean + K @ innovation, P - K @ H @ P
        after = upper_root(np.linalg.cholesky(P))
        moves = np.concatenate([C, B @ L], axis=1)
        run.append(Corrected(L, after, after, W, innovation, moves))
        mean, P = F @ mean, F @ P @ F.T + Q
        run.append(Moved(after, upper_root(np.linalg.cholesky(P)), F[:9] @ after, SECONDS))
    found = np.array(predicted) + smoothed(run[:-1], DRIFTS)

    n = SIZE * IMAGES  # least squares over the errors at all images
    A, b = np.zeros((n, n)), np.zeros(n)
    A[:SIZE, :SIZE] = 4.0 * np.eye(SIZE)
    for k in range(IMAGES):
        here = slice(SIZE * k, SIZE * k + SIZE)
        H, V = ways[k] @ by_error[k], np.eye(5) + ways[k] @ shared[k] @ shared[k].T @ ways[k].T
        A[here, here] += H.T @ np.linalg.solve(V, H)
        b[here] += H.T @ np.linalg.solve(V, z[k])
        if k:
            link = np.concatenate([-F, np.eye(SIZE)], axis=1)
            both = slice(SIZE * (k - 1), SIZE * k + SIZE)
            A[both, both] += link.T @ np.linalg.solve(Q, link)
    best = np.linalg.solve(A, b).reshape(IMAGES, SIZE)
    np.testing.assert_allclose(found, best, atol=1e-5)
    assert np.abs(np.array(predicted) - best).max() > 0.1
