"""Two variances on a grid, against the likelihood as scipy has it."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from vical_daemon.estimation.noise.variance_components import (
    Observed,
    _inverse,
    grid,
    of_images,
    of_window,
    posterior,
)

FIRST, OTHERS = grid(0.01), grid(0.05)


def drawn(seed, v0, v1, n=60):
    rng = np.random.default_rng(seed)
    U = rng.standard_normal((n, 12, 3)) * np.array([3.0, 1.0, 1.0])
    A = np.swapaxes(U, 1, 2) @ U
    G = 0.5 * rng.standard_normal((n, 3, 4))
    C = A + G @ np.swapaxes(G, 1, 2)
    e = rng.standard_normal((n, 3)) * np.sqrt([v0, v1, v1])
    noise = np.matmul(np.linalg.cholesky(C), rng.standard_normal((n, 3, 1)))[..., 0]
    return Observed(np.matmul(A, e[..., None])[..., 0] + noise, A, C)


def found(observed):
    return posterior(of_images(observed, FIRST, OTHERS), FIRST, OTHERS)


def log_likelihood(v, observed):
    V = observed.C + observed.A @ np.diag([v[0], v[1], v[1]]) @ observed.A
    squares = np.einsum("ni,nij,nj->", observed.b, np.linalg.inv(V), observed.b)
    return -0.5 * (squares + np.linalg.slogdet(2.0 * np.pi * V)[1].sum())


def test_the_likelihood_of_images_is_that_of_normal_variables():
    observed = drawn(5, 0.0, 0.0, n=7)
    got = of_images(observed, FIRST, OTHERS)
    nothing = log_likelihood((0.0, 0.0), observed)
    for i, j in ((0, 0), (0, 12), (9, 0), (15, 20), (29, 29)):
        expected = log_likelihood((FIRST[i] ** 2, OTHERS[j] ** 2), observed) - nothing
        assert got[i, j] == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_the_likelihood_of_a_window_is_that_of_all_its_pixels():
    """Images whose motion and constants are unknown, so that errors of one change the residuals of others."""
    rng, n, rows = np.random.default_rng(6), 5, 10
    Z = rng.standard_normal((n, rows, 3)) * np.array([3.0, 1.0, 1.0])
    H = rng.standard_normal((n * rows, 8))
    whole = np.zeros((n * rows, 3 * n))
    for k in range(n):
        whole[k * rows : (k + 1) * rows, 3 * k : 3 * k + 3] = Z[k]
    y = whole @ (0.5 * rng.standard_normal(3 * n)) + rng.standard_normal(n * rows)
    prior = np.diag(rng.uniform(0.1, 2.0, 8))
    N = np.linalg.inv(H.T @ H + np.linalg.inv(prior))
    S = whole.T @ whole - whole.T @ H @ N @ H.T @ whole
    s = whole.T @ y - whole.T @ H @ N @ H.T @ y
    got = of_window(S, s, FIRST, OTHERS)

    def expected(v0, v1):
        D = np.diag(np.tile([v0, v1, v1], n))
        cov = np.eye(n * rows) + H @ prior @ H.T + whole @ D @ whole.T
        return multivariate_normal.logpdf(y, cov=cov)

    for i, j in ((0, 9), (13, 0), (17, 21), (29, 29)):
        difference = expected(FIRST[i] ** 2, OTHERS[j] ** 2) - expected(0.0, 0.0)
        assert got[i, j] == pytest.approx(difference, abs=1e-6)  # on the grid that is worked out
    for i, j in ((0, 7), (11, 0), (15, 24)):
        difference = expected(FIRST[i] ** 2, OTHERS[j] ** 2) - expected(0.0, 0.0)
        assert got[i, j] == pytest.approx(difference, abs=0.3)  # between


@pytest.mark.parametrize(("v0", "v1"), [(0.02, 0.3), (0.3, 0.2), (1.0, 5.0)])
def test_both_are_where_the_likelihood_is_largest(v0, v1):
    observed = drawn(1, v0, v1, n=200)
    best = minimize(
        lambda log_v: -log_likelihood(np.exp(log_v), observed), np.log([v0, v1]), method="Nelder-Mead"
    )
    # a sigma between two of the grid is met to a tenth; outliers are clipped, which no likelihood does
    np.testing.assert_allclose(found(observed).mean, np.exp(best.x), rtol=0.2)


@pytest.mark.parametrize(("v0", "v1"), [(0.3, 0.0), (0.0, 2.0)])
def test_one_is_not_taken_for_the_other(v0, v1):
    results = [found(drawn(seed, v0, v1)) for seed in range(20)]
    present, absent = (0, 1) if v0 else (1, 0)
    assert np.mean([r.mean[present] for r in results]) == pytest.approx(v0 + v1, rel=0.15)
    assert np.median([r.mean[absent] for r in results]) < 0.01 * (v0 + v1)
    assert max(r.absent[present] for r in results) < 1e-6 < min(r.absent[absent] for r in results)


def test_few_images_leave_open_which_of_two_it_is():
    """Both ways look alike in three images: either is allowed for, and neither is sure."""
    few = drawn(2, 0.0, 0.2, n=3)
    r = found(few)
    assert (r.mean > 0.01**2).all()
    assert (r.absent > 1e-3).all()


def test_an_outlier_is_no_variance():
    observed = drawn(3, 0.0, 0.0)
    observed.b[7] *= 1e3
    assert (found(observed).absent > 0.01).all()


def test_a_way_in_which_nothing_moves_says_nothing():
    observed = drawn(4, 0.0, 2.0)
    observed.A[:, 0, :] = observed.A[:, :, 0] = observed.b[:, 0] = 0.0
    observed.C[:, 0, :] = observed.C[:, :, 0] = 0.0
    log_likelihood_ = of_images(observed, FIRST, OTHERS)
    np.testing.assert_allclose(log_likelihood_, np.broadcast_to(log_likelihood_[:1], log_likelihood_.shape))
    assert found(observed).mean[1] == pytest.approx(2.0, rel=0.3)


def test_inverses_are_those_of_lapack_whatever_the_units():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(50, 3, 5)) * np.array([1e3, 1.0, 0.1])[:, None]
    V = A @ A.swapaxes(1, 2)
    expected = np.linalg.inv(V + 1e-12 * np.eye(3) * np.trace(V, axis1=1, axis2=2)[:, None, None])
    np.testing.assert_allclose(_inverse(V), expected, rtol=1e-6, atol=0.0)
