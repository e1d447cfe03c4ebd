"""Model selection: are the target's size and shape, the IMU's matrices and lag, and fixed lenses as given?

Estimating all of them on every rig would make the result up to three times less certain. Assuming that they
are exact puts the result up to ten stated sigmas off where they are not. So they are always states of the
filter. Each combination of them that may be zero is an alternative model. Its Gaussian is the filter's own,
conditioned on these zeros. Its odds follow from how far the states lie from zero (Savage-Dickey density
ratio). The reported mean and covariance are those of the mixture. With a fixed lens the reported mean is that
of the calibration for the lens as given; the covariance includes how far the mixture lies from it.
[docs/math/filter.md, eq. (18) and (19)]
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import ENTRY_SIGMA, LAG_SIGMA_S, OFF, SIZE_SIGMA
from vical_daemon.estimation.model.retract import retract
from vical_daemon.estimation.model.state import LOWER
from vical_daemon.estimation.model.unscented import root, solve_lower

IMU, LAG, SIZE, TARGET = "imu_intrinsics", "accel_lag", "target_scale", "target_shape"
IN_DOUBT = {
    IMU: "sigmas are small; it is not clear yet whether the imu's scale and alignment are as specified",
    SIZE: "sigmas are small; it is not clear yet whether the target has the size in its file",
    TARGET: "sigmas are small; it is not clear yet whether the target has the shape in its file",
}
_MOST = 300.0  # of a logarithm
_NEGLIGIBLE = 1e-9
_RIDGE = 1e-12  # of the variance of a lens that is off: one that is surely as given has none


@dataclass(frozen=True, slots=True)
class Block:
    """States that are zero where what they describe is as specified.

    Attributes:
        where: Among the errors.
        values: As estimated, shape (n,).
        sigma: Of their prior, shape (n,).
        stated: How well they are known where what they describe is as specified, shape (n,); zeros: exactly.
        held: They are reported as zero in any case.
    """

    where: slice
    values: FloatArray
    sigma: FloatArray
    stated: FloatArray
    held: bool = False

    @classmethod
    def of(cls, where: slice, values: FloatArray, sigma: float) -> Block:
        """Make one of values that are exactly zero where all is as specified."""
        return cls(where, values, np.full(len(values), sigma), np.zeros(len(values)))

    @property
    def share(self) -> FloatArray:
        """What is stated over the prior, shape (n,)."""
        return self.stated / self.sigma

    @property
    def noise(self) -> FloatArray:
        """Sigma of a measurement of zero that makes the prior what is stated, shape (n,)."""
        return np.asarray(self.stated / np.sqrt(1.0 - self.share**2))


def lens_block(camera: str) -> str:
    """Name of the block of a lens that is held."""
    return f"lens of {camera}"


def blocks(f: CalibrationFilter) -> dict[str, Block]:
    """What a filter estimates apart from the calibration, by its name in `CalibrationOptions.estimate`."""
    layout, state = f.layout, f.state
    found: dict[str, Block] = {}
    if layout.gyro_matrix is not None and layout.accel_matrix is not None:
        off = state.accel_matrix - np.eye(3)
        entries = np.concatenate([(state.gyro_matrix - np.eye(3)).ravel(), off[LOWER[:, 0], LOWER[:, 1]]])
        where = slice(layout.gyro_matrix.start, layout.accel_matrix.stop)
        found[IMU] = Block.of(where, entries, ENTRY_SIGMA)
    if layout.accel_lag is not None:
        where = slice(layout.accel_lag, layout.accel_lag + 1)
        found[LAG] = Block.of(where, np.array([state.accel_lag_s]), LAG_SIGMA_S)
    if layout.target_scale is not None:
        where = slice(layout.target_scale, layout.target_scale + 1)
        found[SIZE] = Block.of(where, np.array([state.target_scale - 1.0]), SIZE_SIGMA)
    if layout.target_shape is not None and layout.target_modes is not None:
        found[TARGET] = Block.of(layout.target_shape, state.target_shape, layout.target_modes.sigma_m)
    for name, lens in layout.held.items():
        camera = state.cameras[name]
        values = np.concatenate([camera.intrinsics, camera.distortion]) - lens.values
        found[lens_block(name)] = Block(layout.lens(name), values, lens.off_sigma, lens.sigma, held=True)
    return found


def lenses_known(f: CalibrationFilter) -> FloatArray:
    """Square root of the reported covariance if the errors of all fixed lenses were known."""
    if not f.layout.held:
        return f.S
    scaled = [f.S[f.layout.lens(n)] / lens.off_sigma[:, None] for n, lens in f.layout.held.items()]
    rows = np.concatenate(scaled)
    L = root(rows @ rows.T + _RIDGE * np.eye(len(rows)))
    U = solve_lower(L, rows)
    return np.asarray(f.S - (f.S @ U.T) @ U)


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
    off = 0.5 * min(float(fitted @ fitted) / factor, 2.0 * _MOST) - float(size)
    if share is None or not share.any():
        return off
    inverse = solve_lower(L, np.diag(share))  # with the share of each value on its right
    learnt = (inverse.T @ inverse - np.diag(share**2)) / factor
    return off - _log_evidence(learnt, inverse.T @ standard / factor)


def _log_evidence(learnt: FloatArray, weighted: FloatArray) -> float:
    """Logarithm of how likely data are under a prior of unit variance, over that under exact zeros."""
    L = root(np.eye(len(weighted)) + learnt)
    fitted = solve_lower(L, weighted)
    return 0.5 * min(float(fitted @ fitted), 2.0 * _MOST) - float(np.log(L.diagonal()).sum())


def factor(f: CalibrationFilter) -> float:
    """Reported variances over the filter's own (see `consistency`)."""
    return max((c.factor for c in f.consistency.values()), default=1.0)


def misfit(f: CalibrationFilter) -> float:
    """By how much images miss by more than their noise although all blocks are free.

    Then it is the images (a lens that is held and wrong), and what they say of imu and target is worth less
    by as much again.
    """
    return max((c.scale for c in f.consistency.values()), default=1.0)


def weights(f: CalibrationFilter) -> dict[tuple[str, ...], float]:
    """Probability of each hypothesis; a hypothesis is named by the blocks that are as specified."""
    doubtful = {name: block for name, block in blocks(f).items() if name not in f.off}
    if not doubtful:
        return {(): 1.0}
    rows = np.concatenate([f.S[b.where] / b.sigma[:, None] for b in doubtful.values()])
    values = {name: b.values / b.sigma for name, b in doubtful.items()}
    shares = {name: b.share for name, b in doubtful.items() if b.stated.any()}
    return posterior(values, rows @ rows.T, factor(f) * misfit(f), shares)


def posterior(
    values: dict[str, FloatArray],
    covariance: FloatArray,
    less: float,
    shares: Mapping[str, FloatArray] | None = None,
) -> dict[tuple[str, ...], float]:
    """Probability of each hypothesis, named by the blocks that are zero; each is in nineteen rigs of twenty.

    Args:
        values: Of each block, as estimated, over the sigma of its prior.
        covariance: Of all of them, in order, shape (n, n).
        less: As the factor of `log_bayes_factor`.
        shares: As its `share`, of the blocks that have one.
    """
    ends = np.cumsum([len(x) for x in values.values()])
    places = {name: np.arange(end - len(x), end) for (name, x), end in zip(values.items(), ends, strict=True)}
    every = np.concatenate([np.zeros(0), *values.values()])
    stated = [(shares or {}).get(name, np.zeros(len(x))) for name, x in values.items()]
    share = np.concatenate(stated) if shares else None
    logs = {}
    for true in (c for n in range(len(values) + 1) for c in combinations(values, n)):
        logs[true] = len(true) * np.log(1.0 - OFF) + (len(values) - len(true)) * np.log(OFF)
        if true:
            at = np.concatenate([places[name] for name in true])
            near = None if share is None else share[at]
            logs[true] -= log_bayes_factor(every[at], covariance[at[:, None], at], less, near)
    most = max(logs.values())
    total = sum(np.exp(x - most) for x in logs.values())
    return {true: float(np.exp(x - most) / total) for true, x in logs.items()}


def not_zero(shares: dict[tuple[str, ...], float], name: str) -> float:
    """Probability that a block is not zero; 1 where that is none of the hypotheses."""
    return sum(p for true, p in shares.items() if name not in true)


def off(f: CalibrationFilter, name: str) -> float:
    """Probability that a block is not zero; 1 where that was announced, or it was asked for."""
    return not_zero(weights(f), name)


def in_doubt(f: CalibrationFilter, *, believed: bool = False) -> str:
    """Name of a block for which the data speak, though not yet surely: they soon will. Empty: none.

    Images that do not fit may never decide it; the reported covariance then covers both. A result that was
    believed stays so until the block is more likely off than not: of many looks, one sees 5 % by chance.
    """
    if misfit(f) != 1.0:
        return ""
    doubtful, shares = blocks(f).keys() - f.off, weights(f)
    enough = 0.5 if believed else OFF
    return next((n for n in IN_DOUBT if n in doubtful and not_zero(shares, n) > enough), "")


def averaged(f: CalibrationFilter) -> CalibrationFilter:
    """Return the filter to be reported: mean and covariance over all models.

    Where a lens is held the mean is that of the hypotheses with this lens exactly as given; the covariance
    is about that mean, of all that may be.
    """
    every = blocks(f)
    held = [name for name, block in every.items() if block.held]
    columns, shifts, reported, shares = [], [], [], []
    for true, p in weights(f).items():
        if p < _NEGLIGIBLE:
            continue
        S, d = _given(f, every, true)
        columns.append(np.sqrt(p) * S)
        shifts.append(d)
        reported.append(_given(f, every, {*true, *held}, exactly=held)[1] if held else d)
        shares.append(p)
    if len(shares) == 1 and not shifts[0].any() and not held:
        return f
    share, d = np.array(shares) / sum(shares), np.array(shifts)
    mean = share @ np.array(reported)
    for name in held:
        mean[every[name].where] = every[name].values
    apart = (
        np.sqrt(share / factor(f))[:, None] * (d - mean)
    ).T  # of the reported covariance, `factor` times P
    return replace(f, state=retract(f.state, f.layout, -mean), S=np.concatenate([*columns, apart], axis=1))


def _given(
    f: CalibrationFilter, every: Mapping[str, Block], true: Collection[str], exactly: Collection[str] = ()
) -> tuple[FloatArray, FloatArray]:
    """Square root of the covariance given that some blocks are as specified, and the mean's step, negated.

    With E the rows of these blocks, R the noise with which they are said to be zero, L L' = E S S' E' + R and
    U = L^-1 [E S, R^1/2], that takes [S 0] U' U [S 0]' off P and moves the mean by -d, d = [S 0] U' L^-1 x.

    Args:
        f: The filter.
        every: Its blocks.
        true: Those that are as specified.
        exactly: Those of them that are exactly zero, whatever their stated sigma.
    """
    n = f.layout.size
    if not true:
        return f.S, np.zeros(n)
    given = [every[name] for name in every if name in true]
    rows = np.concatenate([f.S[b.where] for b in given])
    noise = np.concatenate(
        [np.zeros(len(every[k].values)) if k in exactly else every[k].noise for k in every if k in true]
    )
    S = f.S
    if noise.any():
        rows = np.concatenate([rows, np.diag(noise)], axis=1)
        S = np.concatenate([S, np.zeros((n, len(noise)))], axis=1)
    L = root(rows @ rows.T)
    U = solve_lower(L, rows)
    d = S @ (U.T @ solve_lower(L, np.concatenate([b.values for b in given])))
    S = S - (S @ U.T) @ U
    for block in given:
        if not block.stated.any():
            S[block.where] = 0.0
    return S, np.asarray(d)
