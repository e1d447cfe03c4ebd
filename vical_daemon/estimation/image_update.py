"""The linear algebra of one image's correction: gates, compression, and iteration while far from straight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import chi2

from vical_daemon.estimation import unscented
from vical_daemon.estimation.linearise import Image, Linear
from vical_daemon.estimation.measurements import BoolArray, FloatArray

_ITERATIONS = 5
_CURVED = 0.1  # iterate while the second-order part exceeds this share of the corner noise
_CORNER_GATE = float(chi2.isf(1e-4, 2))
_RESIDUAL_GATE = float(chi2.isf(2e-5, 2))
_FRAME_GATE_P = 1e-9
_ALONE = 1e-2  # of the corner variance: what the states add to a row that is called residual

Linearise = Callable[[FloatArray, FloatArray], Linear]  # about dx, with spread S


@lru_cache(maxsize=256)
def frame_limit(dof: int) -> float:
    """Chi-square limit of a whole frame (scipy takes half a millisecond for it)."""
    return float(chi2.isf(_FRAME_GATE_P, dof))


@dataclass(slots=True)
class ImageFit:
    """Outcome of a correction.

    Attributes:
        S: New square root of the covariance, shape (c, c).
        dx: State step, shape (c,).
        nis: Normalised innovation squared of what the state can explain.
        dof: Its degrees of freedom.
        keep: Which points took part, shape (n,).
        rest: Sum of squares that no state error explains, whitened.
        dof_rest: Its degrees of freedom.
        left: Whitened residuals after the correction, shape (n, 2).
    """

    S: FloatArray
    dx: FloatArray
    nis: float
    dof: int
    keep: BoolArray
    rest: float
    dof_rest: int
    left: FloatArray


def rows_of(keep: BoolArray) -> BoolArray | slice:
    """The two rows of each point kept; a slice where that is all of them, which copies nothing."""
    return slice(None) if keep.all() else np.repeat(keep, 2)


def corner_gate(image: Image, innovation: FloatArray, lin: Linear) -> BoolArray:
    """Chi-square gate of each corner with its predicted variance (per axis, both axes together)."""
    var = np.einsum("ij,ij->i", lin.linear, lin.linear)
    for more in (image.common_px, lin.curved):
        if more.size:
            var += np.einsum("ij,ij->i", more, more)
    var = var.reshape(-1, 2) + (image.sigma_px**2)[:, None]
    passed: BoolArray = (innovation**2 / var).sum(axis=1) < _CORNER_GATE
    return passed


def curved_share(image: Image, lin: Linear, keep: BoolArray) -> float:
    """Largest second-order standard deviation of a corner over its noise."""
    if not lin.curved.size or not keep.any():
        return 0.0
    share = np.sqrt((lin.curved**2).sum(axis=1)).reshape(-1, 2).max(axis=1) / image.sigma_px
    return float(share[keep].max())


def solve(image: Image, prior: FloatArray, lin: Linear, keep: BoolArray, linearise: Linearise) -> ImageFit:
    """Iterated posterior linearisation (once is enough when the prior is tight).

    Args:
        image: The points.
        prior: Square root of the covariance, shape (c, c).
        lin: The image linearised about the prior.
        keep: Points that passed the gate, shape (n,).
        linearise: Linearises anew about a step and a spread.

    Returns:
        The fit. [Garcia-Fernandez et al., "Posterior linearization filter", 2015]
    """
    S, dx = prior, np.zeros(len(prior))
    M, offset = lin.linear, np.zeros(2 * len(image.ids))
    weight = 1.0 / np.repeat(image.sigma_px, 2)
    for step in range(_ITERATIONS):
        if step:
            lin = linearise(dx, S)
            keep = keep & lin.valid
            M, offset = lin.H @ prior, lin.H @ dx  # the innovation refers to the prior mean
        r = ((image.uv - lin.z).ravel() + offset) * weight
        fit = _correct(image, prior, M * weight[:, None], r, lin, weight, keep)
        if curved_share(image, lin, fit.keep) < _CURVED:
            break
        step_size = unscented.solve_lower(fit.S, fit.dx - dx)
        S, dx, keep = fit.S, fit.dx, fit.keep
        if step and float(np.linalg.norm(step_size)) < 0.05:
            break
    return fit


def _correct(
    image: Image,
    prior: FloatArray,
    M: FloatArray,
    r: FloatArray,
    lin: Linear,
    weight: FloatArray,
    keep: BoolArray,
) -> ImageFit:
    """One linear correction; corners whose residual stays impossible are dropped and it is done again."""
    columns = [M]
    if image.common_px.size:
        columns.append(image.common_px * weight[:, None])
    if lin.curved.size:
        curved = lin.curved * weight[:, None]
        if float((curved**2).sum(axis=1).max(initial=0.0)) > 1e-4:
            columns.append(curved)
    full = np.concatenate(columns, axis=1) if len(columns) > 1 else M
    for _ in range(3):
        rows = rows_of(keep)
        small, r_small, rest, dof_rest = unscented.compress(full[rows], r[rows])
        c = unscented.correct(prior, small, r_small)
        left = (r - full @ c.solution).reshape(-1, 2)
        bad = keep & ((left**2).sum(axis=1) > _RESIDUAL_GATE * max(1.0, rest / max(dof_rest, 1)))
        if not bad.any() or (keep & ~bad).sum() < 4:
            break
        keep = keep & ~bad
    # A compressed image has as many rows as there are states, though it shows but some of them: rows that no
    # state moves are residuals like the rest, and say nothing about whether the innovations fit.
    alone = np.einsum("ij,ij->i", small, small) < _ALONE if dof_rest else np.zeros(len(r_small), bool)
    apart = float((r_small[alone] ** 2).sum())
    count = int(alone.sum())
    return ImageFit(
        c.S,
        c.dx,
        max(c.nis - apart, 0.0),
        max(len(r_small) - count, 1),
        keep,
        rest + apart,
        dof_rest + count,
        left,
    )
