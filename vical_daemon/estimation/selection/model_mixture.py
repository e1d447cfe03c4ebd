"""Alternative models of one Gaussian: states that are zero where what they describe is as specified.

Estimating all of them on every rig would make the result up to three times less certain. Assuming that they
are exact puts the result up to ten stated sigmas off where they are not. So they are always states. Each
combination of them that may be zero is an alternative model. Its Gaussian is that of the estimator,
conditioned on these zeros. Its odds follow from how far the states lie from zero (Savage-Dickey density
ratio). The reported mean and covariance are those of the mixture. With a fixed lens the reported mean is that
of the calibration for the lens as given; the covariance includes how far the mixture lies from it.
[docs/math/filter.md, eq. (18) and (19)]
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray
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
        off: Probability that they are not zero, before any data.
    """

    where: slice
    values: FloatArray
    sigma: FloatArray
    stated: FloatArray
    held: bool = False
    off: float = OFF

    @classmethod
    def of(cls, where: slice, values: FloatArray, sigma: float) -> Block:
        """Make one of values that are exactly zero where all is as specified."""
        return cls(where, values, np.full(len(values), sigma), np.zeros(len(values)))

    @classmethod
    def of_lens(cls, where: slice, lens: FixedLens, now: FloatArray) -> Block:
        """Make that of a fixed lens; `now`: fx fy cx cy and the distortion as estimated, shape (n,)."""
        return cls(where, now - lens.values, lens.off_sigma, lens.sigma, held=True, off=lens.off)

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
        less: As the factor of `log_bayes_factor`.
    """
    if not every:
        return {(): 1.0}
    rows = np.concatenate([S[b.where] / b.sigma[:, None] for b in every.values()])
    values = {name: b.values / b.sigma for name, b in every.items()}
    shares = {name: b.share for name, b in every.items() if b.stated.any()}
    return posterior(values, rows @ rows.T, less, shares, {name: b.off for name, b in every.items()})


def not_zero(shares: Weights, name: str) -> float:
    """Probability that a block is not zero; 1 where that is none of the hypotheses."""
    return sum(p for true, p in shares.items() if name not in true)


def mixture(
    S: FloatArray, every: Mapping[str, Block], weights: Weights, factor: float
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance over all models.

    Where a lens is held what is reported is the mean of the hypotheses with this lens exactly as given; the
    covariance is about that, of all that may be.

    Args:
        S: Square root of the covariance, shape (n, m).
        every: All blocks.
        weights: Probability of each hypothesis.
        factor: Reported covariance over that of `S`.

    Returns:
        What is reported moves by, shape (n,), and the square root of the covariance over `factor`, shape
        (n, k). Where a lens is held its last column is how far the mean over all models is from what is
        reported, see `parts`.
    """
    if not every:
        return np.zeros(len(S)), S
    held = [name for name, block in every.items() if block.held]
    zeros = _Zeros.of(S, every)
    ways, shifts, reported, shares, surely = [], [], [], [], set(every)
    for true, p in weights.items():
        if p < _NEGLIGIBLE:
            continue
        surely &= set(true)
        U, shift = zeros.given(true)
        ways.append(U)
        shifts.append(shift)
        if held:
            reported.append(zeros.given({*true, *held}, exactly=held)[1])
        shares.append(p)
    share, d = np.array(shares) / sum(shares), np.array(shifts) @ S.T
    mean = share @ d
    taken = [p * (2.0 * U - (U @ U.T) @ U) for p, U in zip(shares, ways, strict=True)]
    M = sum(shares) * unit(ways[0].shape[1]) - np.concatenate(ways).T @ np.concatenate(taken)
    mixed = S @ root(M + RIDGE * unit(len(M)))[: S.shape[1]]
    for name in surely:
        if not every[name].stated.any():
            mixed[every[name].where] = 0.0
    apart = (np.sqrt(share / factor)[:, None] * (d - mean)).T  # of the reported covariance
    columns = np.concatenate([mixed, apart], axis=1)
    if not held:
        return -mean, columns
    shown = share @ (np.array(reported) @ S.T)
    for name in held:
        shown[every[name].where] = every[name].values
    return -shown, joined(columns, shown - mean, factor)


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


def log_bayes_factor(
    values: FloatArray, covariance: FloatArray, factor: float, share: FloatArray | None = None
) -> float:
    """Logarithm of how much more likely the data are if the values are not zero.

    Args:
        values: As estimated, over the sigmas of their prior, shape (n,).
        covariance: Of them, shape (n, n).
        factor: What was learnt beyond the prior is worth so many times less than the covariance says.
        share: Not zero, but as near to it as that share of the prior's sigma, shape (n,); None: zero.
    """
    L = root(covariance)
    standard = fitted = solve_lower(L, values)
    size = -np.log(L.diagonal()).sum() - 0.5 * len(values) * np.log(factor)
    if factor != 1.0:
        # with C = L L' and M M' = I + (factor - 1) L'L: I + (C^-1 - I) / factor = L^-T M M' L^-1 / factor
        M = root(np.eye(len(values)) + (factor - 1.0) * (L.T @ L))
        fitted, size = solve_lower(M, standard), size + np.log(M.diagonal()).sum()
    off = 0.5 * float(fitted @ fitted) / factor - float(size)
    if share is None or not share.any():
        return off
    inverse = solve_lower(L, np.diag(share))  # with the share of each value on its right
    learnt = (inverse.T @ inverse - np.diag(share**2)) / factor
    return off - _log_evidence(learnt, inverse.T @ standard / factor)


def _log_evidence(learnt: FloatArray, weighted: FloatArray) -> float:
    """Logarithm of how likely data are under a prior of unit variance, over that under exact zeros."""
    L = root(np.eye(len(weighted)) + learnt)
    fitted = solve_lower(L, weighted)
    return 0.5 * float(fitted @ fitted) - float(np.log(L.diagonal()).sum())


def posterior(
    values: dict[str, FloatArray],
    covariance: FloatArray,
    less: float,
    shares: Mapping[str, FloatArray] | None = None,
    off: Mapping[str, float] | None = None,
) -> Weights:
    """Probability of each hypothesis, named by the blocks that are zero.

    Args:
        values: Of each block, as estimated, over the sigma of its prior.
        covariance: Of all of them, in order, shape (n, n).
        less: As the factor of `log_bayes_factor`.
        shares: As its `share`, of the blocks that have one.
        off: As its `off`; None: each is zero in nineteen rigs of twenty.
    """
    ends = np.cumsum([len(x) for x in values.values()])
    places = {name: np.arange(end - len(x), end) for (name, x), end in zip(values.items(), ends, strict=True)}
    every = np.concatenate([np.zeros(0), *values.values()])
    stated = [(shares or {}).get(name, np.zeros(len(x))) for name, x in values.items()]
    share = np.concatenate(stated) if shares else None
    logs, priors = {}, dict.fromkeys(values, OFF) | dict(off or {})
    for true in (c for n in range(len(values) + 1) for c in combinations(values, n)):
        logs[true] = sum(np.log(1.0 - p if name in true else p) for name, p in priors.items())
        if true:
            at = np.concatenate([places[name] for name in true])
            near = None if share is None else share[at]
            logs[true] -= log_bayes_factor(every[at], covariance[at[:, None], at], less, near)
    most = max(logs.values())
    total = sum(np.exp(x - most) for x in logs.values())
    return {true: float(np.exp(x - most) / total) for true, x in logs.items()}


@dataclass(frozen=True, slots=True)
class _Zeros:
    """A Gaussian conditioned on blocks that are as specified.

    With E the rows of these blocks, R the noise with which they are said to be zero, L L' = E S S' E' + R and
    U = L^-1 [E S, R^1/2], that takes [S 0] U' U [S 0]' off P and moves the mean by -d, d = [S 0] U' L^-1 x.
    The covariance over all models is [S 0] M [S 0]', M = sum p (I - U' U)^2 = sum p (I - U' (2 I - U U') U).
    Without the square, which changes nothing but rounding, M may have negative eigenvalues.

    Attributes:
        places: Of each block among the rows of all blocks.
        noise: Of all blocks, shape (k,).
        rows: [E S, R^1/2] of all blocks, and their values; of R^1/2 the columns that are not zero; shape
            (k, m + q + 1).
        own: E S S' E' of all blocks, shape (k, k).
        columns: m.
    """

    places: dict[str, IntArray]
    noise: FloatArray
    rows: FloatArray
    own: FloatArray
    columns: int

    @classmethod
    def of(cls, S: FloatArray, every: Mapping[str, Block]) -> _Zeros:
        """Prepare the blocks of a square root of a covariance, shape (n, m)."""
        blocks = every.values()
        E = np.concatenate([S[b.where] for b in blocks])
        values = np.concatenate([b.values for b in blocks])
        noise = np.concatenate([b.noise for b in blocks])
        ends = np.cumsum([len(b.values) for b in blocks])
        places = {
            name: np.arange(end - len(b.values), end)
            for (name, b), end in zip(every.items(), ends, strict=True)
        }
        R = np.diag(noise)[:, noise > 0.0]
        return cls(places, noise, np.concatenate([E, R, values[:, None]], axis=1), E @ E.T, S.shape[1])

    def given(self, true: Collection[str], exactly: Collection[str] = ()) -> tuple[FloatArray, FloatArray]:
        """U, shape (j, m + q), and U' L^-1 x, shape (m,), where some blocks are as specified.

        Args:
            true: These.
            exactly: Those of them that are exactly zero, whatever their stated sigma.
        """
        if not true:
            return self.rows[:0, :-1], np.zeros(self.columns)
        at = np.concatenate([self.places[name] for name in self.places if name in true])
        noise = self.noise.copy()
        for name in exactly:
            noise[self.places[name]] = 0.0
        U = solve_lower(root(self.own[at[:, None], at] + np.diag(noise[at] ** 2)), self.rows[at])
        return U[:, :-1], U[:, : self.columns].T @ U[:, -1]
