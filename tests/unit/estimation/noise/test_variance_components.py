"""Two variances by scoring, against the likelihood as scipy has it."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from vical_daemon.estimation.noise.variance_components import Observed, _inverse, variances


def drawn(seed, v0, v1, n=60):
    rng = np.random.default_rng(seed)
    U = rng.standard_normal((n, 12, 3)) * np.array([3.0, 1.0, 1.0])
    A = np.swapaxes(U, 1, 2) @ U
    G = 0.5 * rng.standard_normal((n, 3, 4))
    C = A + G @ np.swapaxes(G, 1, 2)
    e = rng.standard_normal((n, 3)) * np.sqrt([v0, v1, v1])
    noise = np.matmul(np.linalg.cholesky(C), rng.standard_normal((n, 3, 1)))[..., 0]
    return Observed(np.matmul(A, e[..., None])[..., 0] + noise, A, C)


def unlikelihood(log_v, observed):
    D = np.diag(np.exp(log_v)[[0, 1, 1]])
    return -sum(
        multivariate_normal.logpdf(b, cov=C + A @ D @ A)
        for b, A, C in zip(observed.b, observed.A, observed.C, strict=True)
    )


@pytest.mark.parametrize(("v0", "v1"), [(0.02, 0.3), (0.3, 0.2), (1.0, 5.0)])
def test_both_are_where_the_likelihood_is_largest(v0, v1):
    observed = drawn(1, v0, v1)
    best = minimize(unlikelihood, np.log([v0, v1]), args=(observed,), method="Nelder-Mead")
    # outliers are clipped, which no likelihood does
    np.testing.assert_allclose(variances(observed, (0.0, 0.0)), np.exp(best.x), rtol=0.05)


@pytest.mark.parametrize(("v0", "v1"), [(0.3, 0.0), (0.0, 2.0)])
def test_one_is_not_taken_for_the_other(v0, v1):
    found = np.array([variances(drawn(seed, v0, v1), (5.0, 5.0)) for seed in range(20)])
    present, absent = (0, 1) if v0 else (1, 0)
    assert np.count_nonzero(found[:, absent]) <= 1
    assert found[:, present].mean() == pytest.approx(v0 + v1, rel=0.15)


def test_chance_alone_shows_nothing():
    assert not any(variances(drawn(seed, 0.0, 0.0), (5.0, 5.0)).any() for seed in range(50))


def test_an_outlier_is_no_variance():
    observed = drawn(3, 0.0, 0.0)
    observed.b[7] *= 1e3
    assert not variances(observed, (5.0, 5.0)).any()


def test_a_way_in_which_nothing_moves_has_no_variance():
    observed = drawn(4, 0.0, 2.0)
    observed.A[:, 0, :] = observed.A[:, :, 0] = observed.b[:, 0] = 0.0
    observed.C[:, 0, :] = observed.C[:, :, 0] = 0.0
    v = variances(observed, (0.0, 0.0))
    assert v[0] == 0.0
    assert v[1] > 0.5


def test_inverses_are_those_of_lapack_whatever_the_units():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(50, 3, 5)) * np.array([1e3, 1.0, 0.1])[:, None]
    V = A @ A.swapaxes(1, 2)
    expected = np.linalg.inv(V + 1e-12 * np.eye(3) * np.trace(V, axis1=1, axis2=2)[:, None, None])
    np.testing.assert_allclose(_inverse(V), expected, rtol=1e-6, atol=0.0)
