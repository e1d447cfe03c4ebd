"""Two variances from many small sums: that of the first way in which an image moves, and that of the others.

Each image gives b = A e + noise with e ~ N(0, diag(v0, v1, v1)) and noise of covariance C. Maximum likelihood
by Fisher scoring; a variance is 0 unless its score at 0 is significant. [Harville, "Maximum likelihood
approaches to variance component estimation and to related problems", 1977, section 4]
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.significance import OUTLIER_SIGMAS

_ROUNDS = 10
_SETTLED = 0.01


class Observed(NamedTuple):
    """Sums of n images.

    Attributes:
        b: Shape (n, 3).
        A: Symmetric, shape (n, 3, 3).
        C: Covariance of b without the errors that are sought, shape (n, 3, 3).
    """

    b: FloatArray
    A: FloatArray
    C: FloatArray


def variances(observed: Observed, needed: tuple[float, float]) -> FloatArray:
    """Both variances; each 0 unless it shows.

    Args:
        observed: The sums.
        needed: Standard deviations of chance by which each must show, with the other as it is.

    Returns:
        (v0, v1), shape (2,).
    """
    v, chosen = np.zeros(2), np.zeros(2, dtype=bool)
    limits = np.array(needed)
    for _ in range(2):
        score, information = _score(observed, v)
        z = np.where(chosen, -np.inf, _standard(score, information, chosen))
        best = int(np.argmax(z - limits))
        if not z[best] > limits[best]:
            break
        chosen[best] = True
        v = _fitted(observed, v, chosen)
    return v


def _fitted(observed: Observed, v: FloatArray, chosen: BoolArray) -> FloatArray:
    """Maximum likelihood of the chosen ones."""
    for _ in range(_ROUNDS):
        score, information = _score(observed, v)
        new = np.maximum(v + _step(score, information, chosen & ((v > 0.0) | (score > 0.0))), 0.0)
        moved = np.abs(new - v) > _SETTLED * new
        v = new
        if not moved.any():
            break
    return v


def _step(score: FloatArray, information: FloatArray, free: BoolArray) -> FloatArray:
    step = np.zeros(2)
    index = np.flatnonzero(free & (np.diag(information) > 0.0))
    if len(index):
        unit = np.sqrt(np.diag(information)[index])
        scaled = information[np.ix_(index, index)] / np.outer(unit, unit) + 1e-9 * np.eye(len(index))
        step[index] = np.linalg.solve(scaled, score[index] / unit) / unit
    return step


def _standard(score: FloatArray, information: FloatArray, chosen: BoolArray) -> FloatArray:
    """Score of each over its standard deviation, once the chosen ones are fitted."""
    spread = np.diag(information).copy()
    for k in np.flatnonzero(chosen):
        if information[k, k] > 0.0:
            spread -= information[:, k] ** 2 / information[k, k]
    return np.asarray(score / np.sqrt(np.where(spread > 0.0, spread, np.inf)))


def _score(observed: Observed, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivative of the log-likelihood by both variances, and its Fisher information."""
    b, A, C = observed
    V = C + (A * np.array([v[0], v[1], v[1]])) @ A
    whiten = _inverse(V)
    PA = whiten @ A
    T = A @ PA
    h = np.matmul(b[:, None], PA)[:, 0]
    size = np.einsum("ni,nij,nj->n", b, whiten, b)
    square = h * h * np.minimum(1.0, OUTLIER_SIGMAS**2 / np.maximum(size, 1e-30))[:, None]
    over = square - np.diagonal(T, axis1=1, axis2=2)
    T2 = (T * T).sum(axis=0)
    score = 0.5 * np.array([over[:, 0].sum(), over[:, 1:].sum()])
    return score, 0.5 * np.array([[T2[0, 0], T2[0, 1:].sum()], [T2[0, 1:].sum(), T2[1:, 1:].sum()]])


def _inverse(V: FloatArray) -> FloatArray:
    """Inverses of covariances, shape (n, 3, 3), by cofactors: half the time of LAPACK's for each of them."""
    a, b, c, d, e, f = np.ascontiguousarray(V.reshape(-1, 9).T)[[0, 1, 2, 4, 5, 8]]
    ridge = 1e-12 * (a + d + f)
    a, d, f = a + ridge, d + ridge, f + ridge
    out = np.empty((3, 3, len(V)))
    out[0, 0], out[1, 1], out[2, 2] = d * f - e * e, a * f - c * c, a * d - b * b
    out[0, 1], out[0, 2], out[1, 2] = c * e - b * f, b * e - c * d, b * c - a * e
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    out /= a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
    return np.asarray(out.transpose(2, 0, 1))
