"""Variance components of errors that an image shares: of the first mode in which it moves, and of the others.

An image gives b = A e + noise with e ~ N(0, diag(v0, v1, v1)) and noise of covariance C. The likelihood of
both variances is added up over images on a grid of standard deviations. The means of the posterior are used:
few images do not distinguish the two, and then both are allowed for.
[Harville, "Maximum likelihood approaches to variance component estimation and to related problems", 1977]
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.significance import SURE_SIGMAS

STEP = 1.2
"""Ratio of neighbours on the grid: a sigma between two is met to a tenth."""
SIZE = 30
"""Standard deviations on the grid: none, and 29 that span a factor of 165."""
_FEW = np.array([0, *range(1, SIZE, 4)])
"""Each fourth is enough for the likelihood of a window, which is a few images wide."""
PRESENT = 0.5
"""Prior probability that an error is there at all."""


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


class Variances(NamedTuple):
    """What is known of both variances.

    Attributes:
        mean: Of the posterior, shape (2,).
        absent: Posterior probability that there is no such error, shape (2,).
    """

    mean: FloatArray
    absent: FloatArray


def grid(least: float) -> FloatArray:
    """Standard deviations from `least` on, with 0 first, shape (SIZE,)."""
    return np.concatenate([[0.0], least * STEP ** np.arange(SIZE - 1)])


def of_images(observed: Observed, first: FloatArray, others: FloatArray) -> FloatArray:
    """Logarithm of the likelihood over that without either, summed over images.

    With G = A C^-1 A and h = A C^-1 b, log det(1 + D G) and h' (D^-1 + G)^-1 h, D = diag(v0, v1, v1), are
    ratios of polynomials in the two variances. An outlier counts as if it were no larger.

    Args:
        observed: The images.
        first: Standard deviations of the first way, shape (p,).
        others: Of the other two, shape (q,).

    Returns:
        Shape (p, q).
    """
    b, A, C = observed
    whiten = _inverse(C)
    PA = whiten @ A
    G, h = A @ PA, np.matmul(b[:, None], PA)[:, 0]
    x, y = np.meshgrid(first**2, others**2, indexing="ij")
    powers = np.stack([x, y, x * y, y * y, x * y * y]).reshape(5, -1)
    det = 1.0 + _determinant(G) @ powers
    explained = (_quadratic(G, h) @ powers) / det
    size = np.einsum("ni,nij,nj->n", b, whiten, b)
    far = size > SURE_SIGMAS**2
    if far.any():
        before = size[far, None]
        explained[far] = _clipped(before) - _clipped(np.maximum(before - explained[far], 0.0))
    return np.asarray(0.5 * (explained.sum(axis=0) - np.log(det).sum(axis=0)).reshape(x.shape))


def of_window(S: FloatArray, s: FloatArray, first: FloatArray, others: FloatArray) -> FloatArray:
    """The same of images that have a motion in common: s = S e + noise of covariance S.

    Args:
        S: Information on the errors of all images, [3 each], without motion and constants, shape (3n, 3n).
        s: Right side, shape (3n,).
        first: See `grid`, shape (SIZE,).
        others: Likewise.

    Returns:
        Shape (SIZE, SIZE).
    """
    x, y = first[_FEW, None] ** 2, others[_FEW, None] ** 2
    one, rest = slice(None, None, 3), np.flatnonzero(np.arange(len(s)) % 3)
    # of each variance of the others, these are eliminated; eigenvalues give all variances of the first
    found, V = np.linalg.eigh(S[np.ix_(rest, rest)])
    found, across, b = np.maximum(found, 0.0), S[one, rest] @ V, s[rest] @ V
    gain = y / (1.0 + y * found)
    left, U = np.linalg.eigh(S[one, one] - (gain[:, None] * across) @ across.T)
    left, a = np.maximum(left, 0.0)[:, None], np.vecmat(s[one] - (gain * b) @ across.T, U)[:, None]
    explained = (gain @ b**2)[:, None] + (a**2 * x / (1.0 + x * left)).sum(axis=2)
    out = 0.5 * (explained - np.log1p(y * found).sum(axis=1)[:, None] - np.log1p(x * left).sum(axis=2)).T
    return np.asarray(_from_few() @ out @ _from_few().T)


def posterior(log_likelihood: FloatArray, first: FloatArray, others: FloatArray) -> Variances:
    """Mean variances, and whether there are any; sizes are equally likely by their logarithm before."""
    prior = np.full(SIZE, PRESENT / (SIZE - 1))
    prior[0] = 1.0 - PRESENT
    weight = np.exp(log_likelihood - log_likelihood.max()) * np.outer(prior, prior)
    weight /= weight.sum()
    by_first, by_others = weight.sum(axis=1), weight.sum(axis=0)
    mean = np.array([by_first @ first**2, by_others @ others**2])
    return Variances(mean, np.array([by_first[0], by_others[0]]))


@lru_cache(maxsize=1)
def _from_few() -> FloatArray:
    """Weights of the values at `_FEW` that interpolate at all: cubics through the four nearest but 0."""
    nodes, out = _FEW[1:], np.zeros((SIZE, len(_FEW)))
    out[0, 0] = 1.0
    for place in range(1, SIZE):
        at = min(max(int(nodes.searchsorted(place)) - 2, 0), len(nodes) - 4)
        for k, node in enumerate(nodes[at : at + 4]):
            others = np.delete(nodes[at : at + 4], k)
            out[place, 1 + at + k] = np.prod((place - others) / (node - others))
    return out


def _clipped(square: FloatArray) -> FloatArray:
    """Squared sizes, of which those of outliers grow by their logarithm only."""
    limit = SURE_SIGMAS**2
    return np.where(square > limit, limit * (1.0 + np.log(np.maximum(square, limit) / limit)), square)


def _determinant(G: FloatArray) -> FloatArray:
    """Coefficients of det(1 + D G) - 1 for x, y, x y, y^2, x y^2; shape (n, 5)."""
    a, b, c, d, e, f = _entries(G)
    m01, m02, m12 = a * d - b * b, a * f - c * c, d * f - e * e
    whole = a * m12 - b * (b * f - c * e) + c * (b * e - c * d)
    return np.stack([a, d + f, m01 + m02, m12, whole], axis=1)


def _quadratic(G: FloatArray, h: FloatArray) -> FloatArray:
    """Coefficients of h' (D^-1 + G)^-1 h times that determinant, likewise."""
    a, b, c, d, e, f = _entries(G)
    x, y, z = h.T
    both = x * x * (d + f) + (y * y + z * z) * a - 2.0 * x * (y * b + z * c)
    plane = y * y * f + z * z * d - 2.0 * y * z * e
    whole = (
        x * x * (d * f - e * e)
        + y * y * (a * f - c * c)
        + z * z * (a * d - b * b)
        - 2.0 * (x * y * (b * f - c * e) + x * z * (c * d - b * e) + y * z * (a * e - b * c))
    )
    return np.stack([x * x, y * y + z * z, both, plane, whole], axis=1)


def _entries(G: FloatArray) -> FloatArray:
    """The six of symmetric matrices (n, 3, 3), row by row, shape (6, n)."""
    return np.ascontiguousarray(G.reshape(-1, 9).T)[[0, 1, 2, 4, 5, 8]]


def _inverse(V: FloatArray) -> FloatArray:
    """Inverses of covariances, shape (n, 3, 3), by cofactors: half the time of LAPACK's for each of them."""
    a, b, c, d, e, f = _entries(V)
    ridge = 1e-12 * (a + d + f)
    a, d, f = a + ridge, d + ridge, f + ridge
    out = np.empty((3, 3, len(V)))
    out[0, 0], out[1, 1], out[2, 2] = d * f - e * e, a * f - c * c, a * d - b * b
    out[0, 1], out[0, 2], out[1, 2] = c * e - b * f, b * e - c * d, b * c - a * e
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    out /= a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
    return np.asarray(out.transpose(2, 0, 1))
