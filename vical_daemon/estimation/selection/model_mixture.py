"""Alternative models of one Gaussian: states that are zero where what they describe is as specified.

Estimating all of them on every rig would make the result up to three times less certain. Assuming that they
are exact puts the result up to ten stated sigmas off where they are not. So they are always states. Each
combination of them that may be zero is an alternative model. Its Gaussian is that of the estimator,
conditioned on these zeros. Its odds follow from how far the states lie from zero (Savage-Dickey density
ratio). The reported mean and covariance are those of the mixture. With a fixed lens the reported mean is that
of the calibration for the lens as given and, if it is not this camera's lens, for all else as specified. The
covariance includes how far the mixture lies from it. [docs/math/filter.md, eq. (18) and (19)]
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import compress
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.model.priors import OFF
from vical_daemon.estimation.model.unscented import RIDGE, root, solve_lower, unit

_NEGLIGIBLE = 1e-9  # probability of a hypothesis that is left out of the mixture

Weights = dict[tuple[str, ...], float]
"""Probability of each hypothesis, named by the blocks that are as specified."""


@dataclass(frozen=True, slots=True)
class Block:
    """States that are zero where what they describe is as specified.

    Attributes:
        where: Among the errors.
        values: As estimated, shape (n,).
        sigma: Of their prior, shape (n,).
        stated: How well they are known where what they describe is as specified, shape (n,); zeros: exactly.
        held: They are reported as zero in any case.
        lens: They are a fixed lens. Where it is not as specified, all else is reported as specified.
        off: Probability that they are not zero, before any data.
    """

    where: slice
    values: FloatArray
    sigma: FloatArray
    stated: FloatArray
    held: bool = False
    lens: bool = False
    off: float = OFF

    @classmethod
    def of(cls, where: slice, values: FloatArray, sigma: float) -> Block:
        """Make one of values that are exactly zero where all is as specified."""
        return cls(where, values, np.full(len(values), sigma), np.zeros(len(values)))

    @classmethod
    def of_lens(cls, where: slice, lens: FixedLens, now: FloatArray) -> Block:
        """Make that of a fixed lens; `now`: fx fy cx cy and the distortion as estimated, shape (n,)."""
        return cls(where, now - lens.values, lens.off_sigma, lens.sigma, held=True, lens=True, off=lens.off)

    @property
    def share(self) -> FloatArray:
        """What is stated over the prior, shape (n,)."""
        return self.stated / self.sigma

    @property
    def noise(self) -> FloatArray:
        """Sigma of a measurement of zero that makes the prior what is stated, shape (n,)."""
        return np.asarray(self.stated / np.sqrt(1.0 - self.share**2))


def hypotheses(S: FloatArray, every: Mapping[str, Block], less: float) -> Weights:
    """Probability of each hypothesis about some blocks.

    Args:
        S: Square root of the covariance, shape (n, m).
        every: The blocks that may be as specified.
        less: As the factor of `log_bayes_factors`.
    """
    if not every:
        return {(): 1.0}
    names = sorted(every, key=lambda name: -len(every[name].values))  # see `_of_submatrices`
    blocks = [every[name] for name in names]
    sigma = np.concatenate([b.sigma for b in blocks])
    values, noise = _of_all(blocks)
    rows = np.concatenate([S[b.where] for b in blocks]) / sigma[:, None]
    true, off = _subsets(len(blocks)), np.array([b.off for b in blocks])
    logs = np.where(true, np.log(1.0 - off), np.log(off)).sum(axis=1)
    sizes = [len(b.values) for b in blocks]
    logs -= log_bayes_factors(values / sigma, rows @ rows.T, sizes, less, noise / sigma)
    shares = np.exp(logs - logs.max())
    return dict(zip(_named(tuple(names), tuple(every)), (shares / shares.sum()).tolist(), strict=True))


def _of_all(blocks: Collection[Block]) -> tuple[FloatArray, FloatArray]:
    """Values and noise of blocks, one after the other, each of shape (k,)."""
    return np.concatenate([b.values for b in blocks]), np.concatenate([b.noise for b in blocks])


@lru_cache(maxsize=16)
def _subsets(count: int) -> BoolArray:
    """Which blocks are as specified in each hypothesis: block i where bit i of its number is set."""
    return np.asarray((np.arange(2**count)[:, None] >> np.arange(count)) & 1 == 1)


@lru_cache(maxsize=16)
def _named(names: tuple[str, ...], order: tuple[str, ...]) -> list[tuple[str, ...]]:
    """The same by name, each in another order."""
    return [tuple(sorted(compress(names, row), key=order.index)) for row in _subsets(len(names))]


def not_zero(shares: Weights, name: str) -> float:
    """Probability that a block is not zero; 1 where that is none of the hypotheses."""
    return sum(p for true, p in shares.items() if name not in true)


def mixture(
    S: FloatArray,
    every: Mapping[str, Block],
    weights: Weights,
    factor: float,
    asked: Collection[str] = (),
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance over all models.

    Where a lens is held what is reported is the mean of the hypotheses with this lens exactly as given. A
    wrong lens bends what the data say of imu and target, so where it is wrong all else is as specified, as
    it is for calibrators without these states. The covariance is about that, of all that may be.

    Args:
        S: Square root of the covariance, shape (n, m).
        every: All blocks.
        weights: Probability of each hypothesis.
        factor: Reported covariance over that of `S`.
        asked: Blocks that are to be estimated in any case.

    Returns:
        What is reported moves by, shape (n,), and the square root of the covariance over `factor`, shape
        (n, k). Where a lens is held its last column is how far the mean over all models is from what is
        reported, see `parts`.
    """
    if not every:
        return np.zeros(len(S)), S
    # large blocks first, as long as few hypotheses differ; lenses that are held last
    names = sorted(every, key=lambda name: (every[name].held, -len(every[name].values)))
    order = {name: every[name] for name in names}
    held = [name for name in names if every[name].held]
    likely = {true: p for true, p in weights.items() if p >= _NEGLIGIBLE}
    share = np.array(list(likely.values())) / sum(likely.values())
    values, noise = _of_all(order.values())
    Q, R = np.linalg.qr(np.concatenate([S[b.where] for b in order.values()]).T)
    k = len(values)
    rows = np.concatenate([R.T, np.diag(noise)[:, noise > 0.0]], axis=1)
    found, end, as_given = _Conditioned.none(len(likely), rows.shape[1]), 0, None
    for name, block in order.items():
        if block.held and as_given is None:
            as_given = _as_given(found, order, rows, likely, asked)
        at = slice(end, end + len(block.values))
        found, end = found.on(rows[at], values[at], [name in true for true in likely]), at.stop
    P, means = found.of_each(k)
    mean = share @ means
    apart = np.sqrt(share / factor)[:, None] * (means - mean)  # of the reported covariance
    P = (np.sqrt(share)[:, None, None] * P).swapaxes(0, 1).reshape(k, -1)
    columns = np.concatenate([P, apart.T], axis=1)
    by = S @ Q
    mixed = S + (by @ (root(columns @ columns.T + RIDGE * unit(k)) - unit(k))) @ Q.T
    for name, block in order.items():
        if all(name in true for true in likely) and not block.stated.any():
            mixed[block.where] = 0.0
    if as_given is None:
        return by @ mean, mixed
    shown = by @ (share @ as_given)
    for name in held:
        shown[every[name].where] = -every[name].values
    return shown, joined(mixed, by @ mean - shown, factor)


def _as_given(
    found: _Conditioned,
    order: Mapping[str, Block],
    rows: FloatArray,
    likely: Collection[tuple[str, ...]],
    asked: Collection[str],
) -> FloatArray:
    """Mean of each hypothesis that is reported for held blocks, shape (h, k).

    Args:
        found: Conditioned on the other blocks.
        order: All blocks, held ones last.
        rows: Of them, shape (k, w).
        likely: The hypotheses.
        asked: See `mixture`.
    """
    values = np.concatenate([block.values for block in order.values()])
    exactly = np.where(np.arange(rows.shape[1]) < len(values), rows, 0.0)
    at = sum(len(block.values) for block in order.values() if not block.held)
    means = found.on(exactly[at:], values[at:], [True] * len(likely)).of_each(len(values))[1].copy()
    lenses = {name for name, block in order.items() if block.lens}
    wrong = [not lenses <= set(true) for true in likely]
    if any(wrong):
        zero = np.concatenate(
            [np.full(len(block.values), name not in asked) for name, block in order.items()]
        )
        only = _Conditioned.none(1, rows.shape[1]).on(exactly[zero], values[zero], [True])
        means[wrong] = only.of_each(len(values))[1][0]
    return means


def joined(S: FloatArray, apart: FloatArray, factor: float) -> FloatArray:
    """The square root of a covariance about what is reported.

    Args:
        S: That about the mean over all models, shape (n, m).
        apart: The mean over all models minus what is reported, shape (n,).
        factor: Reported covariance over that of `S`.
    """
    return np.concatenate([S, apart[:, None] / np.sqrt(factor)], axis=1)


def parts(S: FloatArray, factor: float) -> tuple[FloatArray, FloatArray]:
    """The inverse of `joined`."""
    return S[:, :-1], S[:, -1] * np.sqrt(factor)


def lenses_known(S: FloatArray, every: Mapping[str, Block]) -> FloatArray:
    """Square root of the covariance if the errors of all fixed lenses among the blocks were known."""
    scaled = [S[block.where] / block.sigma[:, None] for block in every.values() if block.held]
    if not scaled:
        return S
    rows = np.concatenate(scaled)
    L = root(rows @ rows.T + RIDGE * np.eye(len(rows)))
    U = solve_lower(L, rows)
    return np.asarray(S - (S @ U.T) @ U)


def lens_block(camera: str) -> str:
    """Name of the block of a lens that is held."""
    return f"lens of {camera}"


def term_block(camera: str) -> str:
    """Name of the block of the term that a free lens has beyond its model."""
    return f"lens term of {camera}"


def log_bayes_factors(
    values: FloatArray, covariance: FloatArray, sizes: Sequence[int], less: float, noise: FloatArray
) -> FloatArray:
    """Logarithm of how much more likely the data are without each hypothesis, in the order of `_subsets`.

    With C the covariance of the blocks of a hypothesis and x their values, the information beyond the prior,
    C^-1 - 1, is divided by f, which makes the covariance f C (1 + (f - 1) C)^-1 and the mean
    (1 + (f - 1) C)^-1 x. The density of a measurement of zero with noise R under the prior, over that under
    this posterior, follows from the submatrices C + R / (f + (f - 1) R) and 1 + (f - 1) C of two matrices.

    Args:
        values: Of all blocks as estimated, over the sigmas of their prior, shape (k,).
        covariance: Of them, shape (k, k).
        sizes: Of the blocks.
        less: f: what was learnt beyond the prior is worth so many times less than the covariance says.
        noise: Sigma of a measurement of zero that makes the prior what is stated, likewise, shape (k,).

    Returns:
        Shape (2^blocks,).
    """
    R = noise**2
    wider = less + (less - 1.0) * R
    both = np.array([covariance + np.diag(R / wider), unit(len(R)) + (less - 1.0) * covariance])
    (log_det, other_det), (square, other) = _of_submatrices(both, values, sizes)
    log_det, square = log_det - other_det, square - (less - 1.0) * other
    sums = np.add.reduceat(np.log(wider / (1.0 + R)), np.cumsum([0, *sizes[:-1]]))
    return np.asarray(0.5 * (_subsets(len(sizes)) @ sums + log_det + square / less))


def _of_submatrices(A: FloatArray, x: FloatArray, sizes: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Log det A and x' A^-1 x of all submatrices of some blocks, in the order of `_subsets`.

    Block by block, by Schur complements: what two submatrices begin with is eliminated once. That is quickest
    with large blocks first, as long as few submatrices differ.

    Args:
        A: Several matrices, shape (m, k, k).
        x: Shape (k,).
        sizes: Of the blocks.

    Returns:
        Both of shape (m, 2^blocks).

    Raises:
        numpy.linalg.LinAlgError: A is not positive definite.
    """
    m, k = A.shape[:2]
    left = np.zeros((m, 1, k + 1, k + 1))
    left[:, 0, :k, :k], left[:, 0, :k, k], left[:, 0, k, :k] = A, x, x
    logs = np.zeros((m, 1))
    for n in sizes:
        L = np.linalg.cholesky(left[:, :, :n, :n])
        U = np.linalg.solve(L, left[:, :, :n, n:])
        rest = left[:, :, n:, n:]
        left = np.concatenate([rest, rest - U.swapaxes(2, 3) @ U], axis=1)
        grown = 2.0 * np.log(np.diagonal(L, axis1=2, axis2=3)).sum(axis=2)
        logs = np.concatenate([logs, logs + grown], axis=1)
    return logs, -left[:, :, 0, 0]


class _Conditioned(NamedTuple):
    """Gaussians of u, at first N(0, 1), conditioned on blocks that are as specified: values + rows u = 0.

    With E the rows of all blocks of the square root S and E' = Q R (QR), the rows of u are [R', noise], and
    the state moves by S Q u: u has as many components as there are values and noises. Each Gaussian has the
    covariance P P', P = 1 - U' U a projection. The sum of squares P P' cannot have negative eigenvalues.

    Attributes:
        gaussians: P and mean of each, shape (g, w, w + 1).
        which: Gaussian of each hypothesis: those that agree so far share one.
    """

    gaussians: FloatArray
    which: list[int]

    @classmethod
    def none(cls, hypotheses: int, width: int) -> _Conditioned:
        """Nothing is as specified yet."""
        return cls(np.eye(width, width + 1)[None], [0] * hypotheses)

    def of_each(self, k: int) -> tuple[FloatArray, FloatArray]:
        """P and mean of the first components in each hypothesis, shapes (h, k, w) and (h, k)."""
        found = self.gaussians[self.which, :k]
        return found[:, :, :-1], found[:, :, -1]

    def on(self, rows: FloatArray, values: FloatArray, true: Sequence[bool]) -> _Conditioned:
        """Condition on one block.

        Args:
            rows: Of the block, shape (n, w).
            values: Its values, shape (n,).
            true: The hypotheses in which it is as specified.
        """
        pairs = list(zip(true, self.which, strict=True))
        places = {pair: place for place, pair in enumerate(sorted(set(pairs)))}  # without it first
        still = self.gaussians[[which for now, which in places if not now]]
        now = self.gaussians[[which for now, which in places if now]]
        G = rows @ now
        G[:, :, -1] += values
        U = np.linalg.solve(np.linalg.cholesky(G[:, :, :-1] @ G[:, :, :-1].swapaxes(1, 2)), G)
        now -= U[:, :, :-1].swapaxes(1, 2) @ U
        return _Conditioned(np.concatenate([still, now]), [places[pair] for pair in pairs])
