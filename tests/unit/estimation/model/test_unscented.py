"""The sigma-point algebra against textbook formulas that invert matrices."""

import numpy as np
import pytest

from vical_daemon.estimation.model import unscented


def random_root(rng, n):
    A = rng.normal(size=(n, n))
    return unscented.upper_root(np.linalg.cholesky(A @ A.T + 0.1 * np.eye(n)))


@pytest.mark.parametrize("common", [0, 3])
def test_correct_equals_the_kalman_update(common):
    rng = np.random.default_rng(4)
    n, m = 9, 40
    S = random_root(rng, n)
    H, r = rng.normal(size=(m, n)), rng.normal(size=m)
    C = rng.normal(size=(m, common))
    P, R = S @ S.T, np.eye(m) + C @ C.T
    Z = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(Z)
    c = unscented.correct(S, np.hstack([C, H @ S]) if common else H @ S, r)
    np.testing.assert_allclose(c.dx, K @ r, atol=1e-10)
    np.testing.assert_allclose(c.S @ c.S.T, P - K @ Z @ K.T, atol=1e-9)
    assert c.nis == pytest.approx(r @ np.linalg.solve(Z, r), rel=1e-9)
    np.testing.assert_allclose(S @ c.solution[common:], c.dx, atol=1e-10)
    assert np.abs(np.tril(c.S, -1)).max() == 0.0
    assert (np.diag(c.S) > 0).all()


def test_compressed_rows_give_the_same_correction_and_the_rest_is_what_nothing_explains():
    rng = np.random.default_rng(5)
    n, m = 6, 80
    S = random_root(rng, n)
    M, r = rng.normal(size=(m, n)) @ S, rng.normal(size=m)
    small, r_small, rest, dof = unscented.compress(M, r)
    full, less = unscented.correct(S, M, r), unscented.correct(S, small, r_small)
    np.testing.assert_allclose(less.dx, full.dx, atol=1e-10)
    np.testing.assert_allclose(less.S, full.S, atol=1e-10)
    residual = r - M @ np.linalg.lstsq(M, r, rcond=None)[0]
    assert rest == pytest.approx(residual @ residual)
    assert dof == m - n
    assert full.nis == pytest.approx(less.nis + rest)


def test_upper_root_keeps_the_product_and_a_rank_deficient_one_stays_finite():
    rng = np.random.default_rng(6)
    A = rng.normal(size=(5, 12))
    A[3] = 0.0
    U = unscented.upper_root(A)
    np.testing.assert_allclose(U @ U.T, A @ A.T, atol=1e-12)
    assert np.abs(np.tril(U, -1)).max() == 0.0
    assert (np.diag(U) >= 0.0).all()


@pytest.mark.parametrize(("d", "k"), [(4, 3), (4, 9), (7, 2), (2, 0)])
def test_a_root_that_grew_in_its_first_rows_is_that_of_the_sum(d, k):
    rng = np.random.default_rng(9)
    A, C = random_root(rng, 7), np.zeros((7, k))
    A[:2] = rng.normal(size=(2, 7))  # what propagation leaves of the motion's rows
    A[5] += 0.1 * A[6]  # a time shift drifts
    C[:d] = rng.normal(size=(d, k))
    U = A.copy()
    unscented.grow(U, C[:d])
    np.testing.assert_allclose(U, unscented.upper_root(np.concatenate([A, C], axis=1)), atol=1e-12)


def test_rows_turned_in_place_are_those_of_the_whole_product():
    rng = np.random.default_rng(10)
    S, J = random_root(rng, 8), np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    for where in (slice(0, 3), slice(4, 7)):
        product = S.copy()
        product[where] = J @ S[where]
        turned = S.copy()
        unscented.turn_rows(turned, where, J)
        np.testing.assert_allclose(turned, unscented.upper_root(product), atol=1e-12)


def test_moments_of_a_quadratic_agree_with_monte_carlo():
    rng = np.random.default_rng(7)
    S = np.linalg.cholesky(np.array([[0.5, 0.1], [0.1, 0.3]]))
    B = np.array([[0.7, 0.2], [0.2, -0.4]])

    def f(x):
        return np.stack([x @ [1.0, -2.0] + np.einsum("...i,ij,...j->...", x, B, x), 3.0 * x[..., 1]], axis=-1)

    points = unscented.offsets(S)
    values = f(points)
    m = unscented.moments(values[1:] - values[0])
    samples = f(rng.normal(size=(400_000, 2)) @ S.T)
    np.testing.assert_allclose(values[0] + m.shift, samples.mean(axis=0), atol=6e-3)
    covariance = m.linear @ m.linear.T + m.curved @ m.curved.T
    # The cross second derivative is beyond a symmetric set of 2n points: 8 % of the variance here.
    np.testing.assert_allclose(covariance, np.cov(samples.T), rtol=0.1, atol=0.01)


def test_moments_are_exact_for_a_linear_function():
    rng = np.random.default_rng(8)
    S, H = random_root(rng, 4), rng.normal(size=(3, 4))
    values = unscented.offsets(S) @ H.T
    m = unscented.moments(values[1:] - values[0])
    np.testing.assert_allclose(m.linear, H @ S, atol=1e-12)
    np.testing.assert_allclose(m.curved, 0.0, atol=1e-12)
    np.testing.assert_allclose(m.shift, 0.0, atol=1e-12)
