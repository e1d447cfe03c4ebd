"""Least squares with slow errors underneath: linear in time and memory, exact in its covariance.

The residual of orientation k between a camera and an integrated gyro is `e_k = H_k s_k + J_k x + n_k`, with
n_k ~ N(0, W_k^-1). x are the few wanted parameters and s_k is a slowly moving state,
`s_{k+1} = F_k s_k + w_k`: the drift of the integrated gyro, its bias, slow errors of the camera. Taking only
n_k for noise makes the answer over-confident, for the covariance of all e_k together is dense. Here the
states are eliminated by a banded Cholesky factorisation of their information, which gives the same answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import cholesky_banded
from scipy.linalg.lapack import dtbtrs

from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.estimation.model.unscented import root, solve_lower, unit

BIAS = slice(3, 6)  # where the gyro bias stands in the state


@dataclass(frozen=True)
class DriftProblem:
    """One linearised problem of n orientations, states of dimension d and p parameters.

    Attributes:
        e: Residuals, rad, shape (n, 3).
        J: Their derivative by the parameters, shape (n, 3, p).
        H: Their derivative by the state, shape (n, 3, d).
        weight: Information of the measurement noise (0 for a rejected orientation), shape (n, 3, 3).
        F: State transitions, shape (n - 1, d, d).
        Q_inverse: Information of what is added to the state, shape (n - 1, d, d).
        Q_log_determinant: Log determinant of its covariance, summed over all steps.
        first_mean: Prior mean of the first state, shape (d,).
        first_information: Its information, diagonal; 0 where nothing is known, shape (d,).
        prior_information: Of the parameters, around zero, shape (p, p).
    """

    e: FloatArray
    J: FloatArray
    H: FloatArray
    weight: FloatArray
    F: FloatArray
    Q_inverse: FloatArray
    Q_log_determinant: float
    first_mean: FloatArray
    first_information: FloatArray
    prior_information: FloatArray


@dataclass(frozen=True)
class DriftSolution:
    """The minimum.

    Attributes:
        x: Parameters, shape (p,).
        covariance: Of the parameters, then the gyro bias in the middle, shape (p + 3, p + 3).
        states: s_k, shape (n, d).
        noise: e_k - H_k s_k - J_k x: what is left to the measurements, rad, shape (n, 3).
    """

    x: FloatArray
    covariance: FloatArray
    states: FloatArray
    noise: FloatArray


def _band(problem: DriftProblem) -> FloatArray:
    """Lower band of the block-tridiagonal information of all states, shape (2 d, n d)."""
    n, _, d = problem.H.shape
    QF = problem.Q_inverse @ problem.F
    D = np.swapaxes(problem.H, 1, 2) @ (problem.weight @ problem.H)
    D[:-1] += np.swapaxes(problem.F, 1, 2) @ QF
    D[1:] += problem.Q_inverse
    D[0] += np.diag(problem.first_information)
    band = np.zeros((2 * d, n, d))
    (rows, columns), (every, each) = _lower_and_all(d)
    band[rows - columns, :, columns] = D[:, rows, columns].T
    band[d + every - each, :-1, each] = -QF[:, every, each].T
    return band.reshape(2 * d, n * d)


@lru_cache(maxsize=8)
def _lower_and_all(d: int) -> tuple[tuple[IntArray, IntArray], tuple[IntArray, IntArray]]:
    """Rows and columns of the lower triangle of a d by d matrix, and of all of it."""
    return np.tril_indices(d), np.divmod(np.arange(d * d), d)


@dataclass(frozen=True)
class _Reduced:
    """The problem with the states eliminated.

    Attributes:
        factor: Banded Cholesky factor L of the states' information.
        Y: L^-1 [H' W J, H' W e + prior, unit vectors of the bias in the middle], shape (n d, p + 1 or p + 4).
        P: Covariance of the parameters, shape (p, p).
        x: Parameters, shape (p,).
        quadratic: Weighted sum of squares at the minimum, measurements, states and priors.
        log_determinant: log det of the information of all unknowns, less that of the state's steps: with
            `quadratic` and the weights' own this is -2 log of the restricted likelihood.
    """

    factor: FloatArray
    Y: FloatArray
    P: FloatArray
    x: FloatArray
    quadratic: float
    log_determinant: float


def _reduce(problem: DriftProblem, with_bias: bool) -> _Reduced:
    n, _, p = problem.J.shape
    d = problem.H.shape[2]
    Ht = np.swapaxes(problem.H, 1, 2)
    WJ = problem.weight @ problem.J
    We = problem.weight @ problem.e[..., None]
    mean, information = problem.first_mean, problem.first_information
    rhs = np.zeros((p + 4 if with_bias else p + 1, n, d))  # columns one after the other, as LAPACK wants them
    rhs[:p] = np.moveaxis(Ht @ WJ, 2, 0)
    rhs[p] = (Ht @ We)[..., 0]
    rhs[p, 0] += information * mean
    if with_bias:
        rhs[p + 1 :, n // 2, BIAS] = np.eye(3)
    factor = cholesky_banded(_band(problem), lower=True, check_finite=False)
    Y, _ = dtbtrs(factor, rhs.reshape(-1, n * d).T, uplo="L", overwrite_b=1)
    rows = problem.J.reshape(-1, p).T
    S = rows @ WJ.reshape(-1, p) - Y[:, :p].T @ Y[:, :p] + problem.prior_information
    g = rows @ We.ravel() - Y[:, :p].T @ Y[:, p]
    P, log_det_S = _inverse(0.5 * (S + S.T))
    x = P @ g
    squares = float(problem.e.ravel() @ We.ravel() + information @ mean**2)
    quadratic = squares - float(Y[:, p] @ Y[:, p]) - float(g @ x)
    log_determinant = 2.0 * float(np.log(factor[0]).sum()) + log_det_S + problem.Q_log_determinant
    return _Reduced(factor, np.asarray(Y, dtype=np.float64), P, x, quadratic, log_determinant)


def cost(problem: DriftProblem) -> float:
    """Return -2 log of the restricted likelihood, but for the weights' own part: what `solve` minimises.

    Raises:
        numpy.linalg.LinAlgError: all orientations rejected, or numbers that are not finite.
    """
    reduced = _reduce(problem, with_bias=False)
    return reduced.quadratic + reduced.log_determinant


def solve(problem: DriftProblem) -> DriftSolution:
    """Minimise over parameters and states together.

    Raises:
        numpy.linalg.LinAlgError: all orientations rejected, or numbers that are not finite.
    """
    n, _, p = problem.J.shape
    reduced = _reduce(problem, with_bias=True)
    Y, P, x = reduced.Y, reduced.P, reduced.x
    back, _ = dtbtrs(reduced.factor, (Y[:, p] - Y[:, :p] @ x)[:, None], uplo="L", trans="T")
    states = back.reshape(n, -1)
    gain = Y[:, p + 1 :].T @ Y
    covariance = np.empty((p + 3, p + 3))
    covariance[:p, :p] = P
    covariance[p:, :p] = -gain[:, :p] @ P
    covariance[:p, p:] = covariance[p:, :p].T
    covariance[p:, p:] = gain[:, p + 1 :] + gain[:, :p] @ P @ gain[:, :p].T
    noise = problem.e - (problem.H @ states[..., None])[..., 0] - problem.J @ x
    return DriftSolution(x, covariance, states, noise)


def _inverse(S: FloatArray) -> tuple[FloatArray, float]:
    """Inverse and log determinant of a positive definite matrix, by Cholesky in scaled units."""
    diagonal = np.diagonal(S)
    if not (diagonal > 0.0).all():  # rounding, or numbers that are not finite
        raise np.linalg.LinAlgError("matrix is not positive definite")
    scale = 1.0 / np.sqrt(diagonal)
    L = root(S * np.outer(scale, scale))
    inverse = solve_lower(L, unit(len(S))) * scale
    return inverse.T @ inverse, 2.0 * float(np.log(np.diagonal(L)).sum() - np.log(scale).sum())
