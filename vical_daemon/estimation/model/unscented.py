"""Sigma-point linear algebra on a square-root covariance: P = S S^T with S upper triangular, always.

The errors that come first are those that move. Noise that they gather changes their own corner of S only.

The transform is the symmetric sigma-point set with spread sqrt(3) in its divided-difference form
[Norgaard, Poulsen & Ravn, "New developments in state estimation for nonlinear systems", 2000, DD2]: mean and
covariance agree with the unscented transform to second order, and the covariance is a sum of squares, so it
cannot lose symmetry or positivity. No matrix is ever inverted.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dgeqrf, dgerqf, dorgrq, dpotrf, dtpqrt, dtrtrs

from vical_daemon.estimation.measurements import FloatArray

SPREAD = np.sqrt(3.0)  # matches the kurtosis of a Gaussian
RIDGE = 1e-12  # over the diagonal of a matrix that may be singular
_BLOCK = 8  # columns that LAPACK's QR of triangle and rows takes at once: a fifth quicker than 16 or 32


def offsets(S: FloatArray) -> FloatArray:
    """Return the sigma points as offsets: first 0, then +, then - each column of S; shape (2c + 1, n)."""
    scaled = SPREAD * S.T
    return np.concatenate([np.zeros((1, S.shape[0])), scaled, -scaled])


def solve_lower(L: FloatArray, b: FloatArray, *, transposed: bool = False) -> FloatArray:
    """Solve L x = b, or L^T x = b, for lower-triangular L; LAPACK without scipy's checks (ten times quicker).

    Raises:
        numpy.linalg.LinAlgError: A diagonal entry is exactly zero.
    """
    if L.flags.c_contiguous:  # in LAPACK's eyes an upper triangle: nothing is copied
        x, info = dtrtrs(L.T, b, lower=0, trans=0 if transposed else 1)
    else:
        x, info = dtrtrs(L, b, lower=1, trans=1 if transposed else 0)
    if info:
        raise np.linalg.LinAlgError(f"triangular factor is singular at row {info - 1}")
    return np.asarray(x)


def solve_upper(U: FloatArray, b: FloatArray, *, transposed: bool = False) -> FloatArray:
    """The same for upper-triangular U."""
    return solve_lower(U.T, b, transposed=not transposed)


def root(P: FloatArray) -> FloatArray:
    """Return lower-triangular L with L L^T = P; LAPACK without numpy's checks (five times quicker).

    Raises:
        numpy.linalg.LinAlgError: P is not positive definite.
    """
    L, info = dpotrf(P, lower=1, clean=1)
    if info:
        raise np.linalg.LinAlgError(f"not positive definite from row {info - 1} on")
    return np.asarray(L)


class Moments(NamedTuple):
    """A function seen through sigma points.

    Attributes:
        shift: Mean minus the central value, shape (m,).
        linear: Square root of the part explained by the state: d[m, c]; linear = H S. Shape (m, c).
        curved: Square root of the second-order covariance, independent of the state; shape (m, c).
    """

    shift: FloatArray
    linear: FloatArray
    curved: FloatArray


def moments(values: FloatArray) -> Moments:
    """Turn values at sigma points (relative to the central one) into mean and covariance factors.

    Args:
        values: f(x_i) - f(x_0) for i = 1 .. 2c (plus half first), shape (2c, m).

    Returns:
        The moments.
    """
    c = len(values) // 2
    plus, minus = values[:c], values[c:]
    second = plus + minus
    shift = second.sum(axis=0) / (2.0 * SPREAD**2)
    linear = (plus - minus).T / (2.0 * SPREAD)
    curved = second.T * (np.sqrt(SPREAD**2 - 1.0) / (2.0 * SPREAD**2))
    return Moments(shift, linear, curved)


def lower_root(columns: FloatArray) -> FloatArray:
    """Return lower-triangular L with L L^T = A A^T for A (n, k), k >= n; its columns give sigma points."""
    L: FloatArray = triangle(columns.T).T
    return L * np.copysign(1.0, L.diagonal())


def upper_root(columns: FloatArray) -> FloatArray:
    """Return upper-triangular U with U U^T = A A^T for A (n, k), k >= n, by RQ; its diagonal is >= 0."""
    n = columns.shape[0]
    rq, _, _, _ = dgerqf(columns)
    U: FloatArray = rq[:, -n:] * _upper(n)
    U *= np.copysign(1.0, U.diagonal())
    return U


def grow(U: FloatArray, columns: FloatArray) -> None:
    """Add C C^T to U U^T, in place; U becomes upper triangular.

    Args:
        U: Upper triangular but for its first rows, in the first k columns; shape (n, n).
        columns: C of the first k errors, zero for the others; shape (k, m).
    """
    k = len(columns)
    U[:k, :k] = upper_root(np.concatenate([U[:k, :k], columns], axis=1))


def turn_rows(S: FloatArray, where: slice, J: FloatArray) -> None:
    """Multiply rows of an upper-triangular S by a square J from the left, in place; S stays upper triangular.

    Only the diagonal block of these rows loses its form; a rotation of its columns restores it.
    """
    rq, tau, _, _ = dgerqf(J @ S[where, where])
    sign = np.copysign(1.0, rq.diagonal())
    Q = dorgrq(rq, tau)[0].T * sign
    S[where, where.stop :] = J @ S[where, where.stop :]
    S[where, where] = rq * _upper(len(Q)) * sign
    S[: where.start, where] = S[: where.start, where] @ Q


def triangle(rows: FloatArray) -> FloatArray:
    """Return R, zero below the diagonal, with R^T R = A^T A for A (m, n), by QR; shape (min(m, n), n)."""
    qr, _, _, _ = dgeqrf(rows)
    R: FloatArray = qr[: rows.shape[1]]
    return R * _upper(R.shape[1])[: len(R)]


@lru_cache(maxsize=64)
def _upper(n: int) -> FloatArray:
    """Ones on and above the diagonal (numpy's `triu` makes them at each call)."""
    return np.tri(n).T


@lru_cache(maxsize=64)
def unit(n: int) -> FloatArray:
    """The unit matrix of size n, made once; not to be written to."""
    out: FloatArray = np.eye(n, order="F")
    out.flags.writeable = False
    return out


def compress(M: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray, float, int]:
    """Compress whitened measurements r = M e + unit noise to at most as many rows as columns, by QR.

    Args:
        M: shape (m, n).
        r: shape (m,).

    Returns:
        (M_small, r_small, rest, dof): `rest` is the sum of squares that no state error can explain and
        `dof` its degrees of freedom; both 0 where there was nothing to compress.
    """
    m, n = M.shape
    if m <= n + 1:
        return M, r, 0.0, 0
    stacked = np.empty((m, n + 1), order="F")
    stacked[:, :n] = M
    stacked[:, n] = r
    top = triangle(stacked)
    return top[:n, :n], top[:n, n], float(top[n, n] ** 2), m - n


class Correction(NamedTuple):
    """Result of one linear correction.

    Attributes:
        S: New square root, upper triangular, shape (n, n).
        dx: State correction, shape (n,).
        nis: Normalised innovation squared of the rows given.
        solution: Most likely common c and e, shape (k + n,): dx = S_old e.
        log_det: Logarithm of the determinant of the innovation's covariance, whitened.
    """

    S: FloatArray
    dx: FloatArray
    nis: float
    solution: FloatArray
    log_det: float


def correct(S: FloatArray, M: FloatArray, r: FloatArray) -> Correction:
    """Kalman update in square-root form for whitened rows r = M [c e] + unit noise, c and e ~ N(0, I).

    With Lambda upper triangular, Lambda^T Lambda = I + M^T M: S+ = S Lambda^-1 (bottom right),
    dx = S+ y, y = Lambda^-T M^T r, NIS = r^T r - y^T y.

    Args:
        S: Square root of the covariance, upper triangular, (n, n).
        M: Columns of noise c shared by rows (stamp jitter, curvature), if any, then H S of the whitened rows,
            shape (m, k + n).
        r: Whitened innovation, shape (m,).

    Returns:
        The correction.
    """
    n, k = S.shape[0], M.shape[1]
    # QR of [I; M], which costs half as much where the rows of I are known to be that
    Lambda = dtpqrt(0, min(k, _BLOCK), unit(k), M)[0]
    y = solve_upper(Lambda, M.T @ r, transposed=True)
    new = dtrsm(1.0, Lambda[k - n :, k - n :], S, side=1, lower=0)  # zeros below the diagonal stay zero
    dx = new @ y[k - n :]
    new *= np.copysign(1.0, new.diagonal())
    solution = solve_upper(Lambda, y)
    log_det = 2.0 * float(np.log(np.abs(Lambda.diagonal())).sum())
    return Correction(new, dx, float(r @ r - y @ y), solution, log_det)
