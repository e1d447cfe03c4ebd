"""Least squares with an orientation drift underneath: linear in time and memory, exact in its covariance.

The residual of orientation k between a camera and an integrated gyro is `e_k = theta_k + J_k x + n_k`,
n_k ~ N(0, W_k^-1), where x are the few wanted parameters and theta_k is the drift of the integrated gyro:
`theta_{k+1} = theta_k - M_k b_k + w_k`, `b_{k+1} = b_k + u_k` (white gyro noise w, bias walk u). Taking only
n_k for noise makes the answer over-confident; the covariance of all e_k together is dense. Here drift and
bias are eliminated instead by a banded Cholesky factorisation of their information matrix, which gives the
same answer. The first drift (the unknown orientation of the reference frame) is free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_solve_banded, cholesky_banded

FloatArray = npt.NDArray[np.float64]

_ROWS, _COLUMNS = np.tril_indices(6)
_ALL_ROWS, _ALL_COLUMNS = np.divmod(np.arange(36), 6)


@dataclass(frozen=True)
class DriftProblem:
    """One linearised problem of n orientations and p parameters.

    Attributes:
        e: Residuals, rad, shape (n, 3).
        J: Their derivative by the parameters, shape (n, 3, p).
        weight: Information of the measurement noise (0 for a rejected orientation), shape (n, 3, 3).
        bias_effect: M_k: integral of the orientation from k to k + 1, s, shape (n - 1, 3, 3).
        drift_variance: Of w_k per axis, rad^2, shape (n - 1,).
        walk_variance: Of u_k per axis, (rad/s)^2, shape (n - 1,).
        bias_prior: Prior of b_0 as (mean (3,), variance per axis), rad/s.
        prior_information: Of the parameters, around zero, shape (p, p).
    """

    e: FloatArray
    J: FloatArray
    weight: FloatArray
    bias_effect: FloatArray
    drift_variance: FloatArray
    walk_variance: FloatArray
    bias_prior: tuple[FloatArray, float]
    prior_information: FloatArray


@dataclass(frozen=True)
class DriftSolution:
    """The minimum.

    Attributes:
        x: Parameters, shape (p,).
        covariance: Of the parameters, then the bias in the middle, shape (p + 3, p + 3).
        drift: theta_k, rad, shape (n, 3).
        bias: b_k, rad/s, shape (n, 3).
        noise: e_k - theta_k - J_k x: what is left to the measurements, rad, shape (n, 3).
        quadratic: Weighted sum of squares at the minimum, measurements, drift and priors.
        log_determinant: log det of the information of all unknowns (for the restricted likelihood).
    """

    x: FloatArray
    covariance: FloatArray
    drift: FloatArray
    bias: FloatArray
    noise: FloatArray
    quadratic: float
    log_determinant: float


def _band(problem: DriftProblem) -> FloatArray:
    """Lower band of the information of [theta_k, b_k], k = 0 .. n - 1, shape (12, 6 n)."""
    n = len(problem.e)
    M = problem.bias_effect
    q = (1.0 / problem.drift_variance)[:, None, None]
    u = (1.0 / problem.walk_variance)[:, None, None] * np.eye(3)
    D = np.zeros((n, 6, 6))
    D[:, :3, :3] = problem.weight
    D[:-1, :3, :3] += q * np.eye(3)
    D[1:, :3, :3] += q * np.eye(3)
    qM = q * M
    D[:-1, :3, 3:] -= qM
    D[:-1, 3:, :3] -= np.swapaxes(qM, 1, 2)
    D[:-1, 3:, 3:] += np.swapaxes(M, 1, 2) @ qM + u
    D[1:, 3:, 3:] += u
    D[0, 3:, 3:] += np.eye(3) / problem.bias_prior[1]
    off = np.zeros((n - 1, 6, 6))
    off[:, :3, :3] = -q * np.eye(3)
    off[:, :3, 3:] = qM
    off[:, 3:, 3:] = -u
    band = np.zeros((12, n, 6))
    band[_ROWS - _COLUMNS, :, _COLUMNS] = D[:, _ROWS, _COLUMNS].T
    inside = 6 + _ALL_ROWS - _ALL_COLUMNS
    band[inside, :-1, _ALL_COLUMNS] = off[:, _ALL_ROWS, _ALL_COLUMNS].T
    return band.reshape(12, 6 * n)


def solve(problem: DriftProblem) -> DriftSolution:
    """Minimise over parameters, drift and bias together.

    Raises:
        numpy.linalg.LinAlgError: all orientations rejected, or numbers that are not finite.
    """
    n, _, p = problem.J.shape
    WJ = problem.weight @ problem.J
    We = (problem.weight @ problem.e[..., None])[..., 0]
    rhs = np.zeros((n, 6, p + 4))
    rhs[:, :3, :p] = WJ
    rhs[:, :3, p] = We
    mean, variance = problem.bias_prior
    rhs[0, 3:, p] = mean / variance
    middle = n // 2
    rhs[middle, 3:, p + 1 :] = np.eye(3)
    rhs = rhs.reshape(6 * n, p + 4)
    factor = cholesky_banded(_band(problem), lower=True, check_finite=False)
    Z = cho_solve_banded((factor, True), rhs, check_finite=False)
    S = np.einsum("kip,kiq->pq", problem.J, WJ) - rhs[:, :p].T @ Z[:, :p] + problem.prior_information
    g = np.einsum("kip,ki->p", problem.J, We) - rhs[:, :p].T @ Z[:, p]
    S = 0.5 * (S + S.T)
    scale = 1.0 / np.sqrt(np.diagonal(S))
    L = np.linalg.cholesky(S * np.outer(scale, scale))
    inverse = np.linalg.inv(L) * scale
    P = inverse.T @ inverse
    x = P @ g
    states = (Z[:, p] - Z[:, :p] @ x).reshape(n, 6)
    gain = Z.reshape(n, 6, p + 4)[middle, 3:]
    covariance = np.empty((p + 3, p + 3))
    covariance[:p, :p] = P
    covariance[p:, :p] = -gain[:, :p] @ P
    covariance[:p, p:] = covariance[p:, :p].T
    covariance[p:, p:] = gain[:, p + 1 :] + gain[:, :p] @ P @ gain[:, :p].T
    quadratic = np.einsum("ki,ki->", problem.e, We) + mean @ mean / variance - rhs[:, p] @ Z[:, p] - g @ x
    log_determinant = 2.0 * (np.log(factor[0]).sum() + np.log(np.diagonal(L)).sum() - np.log(scale).sum())
    noise = problem.e - states[:, :3] - (problem.J @ x)
    return DriftSolution(
        x, covariance, states[:, :3], states[:, 3:], noise, float(quadratic), float(log_determinant)
    )
