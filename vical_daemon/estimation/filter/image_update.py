"""The linear algebra of one image's correction: gates, compression, and iteration while far from straight."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import lstsq

from vical_daemon.estimation.filter.linearise import Image, Linear
from vical_daemon.estimation.measurements import LEAST_POINTS, BoolArray, FloatArray
from vical_daemon.estimation.model import unscented
from vical_daemon.estimation.noise.corner_noise import MOST_PX, POSE_DOF, noise_of_image
from vical_daemon.estimation.robust import MEDIAN_RAYLEIGH
from vical_daemon.estimation.significance import LIKELY_SIGMAS, SURE_SIGMAS, chi_square_limit

_ITERATIONS = 5  # of the update, at most: each takes a digit or more off what is left
_CURVED = 0.1  # iterate while the second-order part exceeds this share of the corner noise
_CORNER_GATE = chi_square_limit(2, LIKELY_SIGMAS)  # of a corner before the update
_RESIDUAL_GATE = chi_square_limit(2, LIKELY_SIGMAS)  # of what the update leaves of it
_ALONE = 1e-2  # of the corner variance: what the states add to a row that is called residual

Linearise = Callable[[FloatArray, FloatArray], Linear]  # about dx, with spread S


@lru_cache(maxsize=256)
def frame_limit(dof: int) -> float:
    """Chi-square limit of a whole frame (scipy takes half a millisecond for it)."""
    return chi_square_limit(dof, SURE_SIGMAS)


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
        ways: The ways of the kept rows, whitened and compressed: sums over the rows stay, shape (m, k).
        r: Their innovation, shape (m,).
        rows: Ways and innovation of the kept rows, whitened, where the fit is linearised; (2n, k), (2n,).
        log_det: Logarithm of the determinant of the covariance of what the state can explain, whitened.
        noise: Of the kept corners over `Image.sigma_px`; by both all but `rest` and `left` is whitened.
        again: The image was linearised again about the result.
    """

    S: FloatArray
    dx: FloatArray
    nis: float
    dof: int
    keep: BoolArray
    rest: float
    dof_rest: int
    left: FloatArray
    ways: FloatArray
    r: FloatArray
    rows: tuple[FloatArray, FloatArray]
    log_det: float
    noise: float
    again: bool = False


def log_likelihood(fit: ImageFit | None, image: Image) -> float:
    """Of an image, by its innovation, up to a constant: what is refused counts as if it were at its gate.

    Filters whose noise of corners has grown differently can be compared: its logarithm is counted.

    Args:
        fit: Its correction; None: it was refused.
        image: With its noise.
    """
    noise = 2.0 * float(np.log(image.sigma_px).sum())
    if fit is None:
        return -0.5 * frame_limit(POSE_DOF) - noise
    kept = int(np.count_nonzero(fit.keep))
    squares = fit.nis + fit.rest / fit.noise**2 + (len(fit.keep) - kept) * _CORNER_GATE
    return -0.5 * (squares + fit.log_det - 2 * kept) - 2 * kept * math.log(fit.noise) - noise


def rows_of(keep: BoolArray) -> BoolArray | slice:
    """The two rows of each point kept; a slice where that is all of them, which copies nothing."""
    return slice(None) if keep.all() else np.repeat(keep, 2)


def whitened(image: Image, lin: Linear, fit: ImageFit) -> tuple[FloatArray, FloatArray]:
    """The ways of the kept corners and their innovation over the corner noise, shapes (2n, k), (2n,)."""
    sigma = image.sigma_px[fit.keep] * fit.noise
    ways = lin.ways[rows_of(fit.keep)] / np.repeat(sigma, 2)[:, None]
    return ways, ((image.uv - lin.z)[fit.keep] / sigma[:, None]).ravel()


def corner_gate(image: Image, innovation: FloatArray, lin: Linear) -> BoolArray:
    """Chi-square gate of each corner with its predicted variance (per axis, both axes together)."""
    moves = lin.moves
    var = np.vecdot(lin.ways @ (moves @ moves.T), lin.ways)
    if lin.curved.size:
        var += np.vecdot(lin.curved, lin.curved)
    var = var.reshape(-1, 2) + (image.sigma_px**2)[:, None]
    passed: BoolArray = np.vecdot(innovation, innovation / var) < _CORNER_GATE
    return passed


def blurred(image: Image, innovation: FloatArray, lin: Linear) -> float:
    """How much noisier than usual the corners of an image are, at least 1, by what no state error explains.

    For an image in which most corners fail the gate. Where the rig has moved the states explain it, and the
    result is 1. The median leaves out corners that are elsewhere.
    """
    sigma, shown = image.sigma_px[lin.valid, None], rows_of(lin.valid)
    ways, r = lin.ways[shown] / np.repeat(sigma, 2, axis=0), innovation[lin.valid] / sigma
    spare = r.size - ways.shape[1]
    if spare < LEAST_POINTS:
        return 1.0
    # by QR: the SVD of numpy's does not always converge
    explained = ways @ lstsq(ways, r.ravel(), lapack_driver="gelsy", check_finite=False)[0]
    left = r - explained.reshape(-1, 2)
    noise = float(np.median(np.linalg.norm(left, axis=1))) / MEDIAN_RAYLEIGH * math.sqrt(r.size / spare)
    return max(noise, 1.0) if noise * float(np.median(sigma)) < MOST_PX else 1.0


def curved_share(image: Image, lin: Linear, keep: BoolArray) -> float:
    """Largest second-order standard deviation of a corner over its noise."""
    if not lin.curved.size or not keep.any():
        return 0.0
    share = np.sqrt(np.vecdot(lin.curved, lin.curved)).reshape(-1, 2).max(axis=1) / image.sigma_px
    return float(share[keep].max())


def solve(image: Image, prior: FloatArray, lin: Linear, keep: BoolArray, linearise: Linearise) -> ImageFit:
    """Iterated posterior linearisation (once is enough when the prior is tight).

    Args:
        image: The points.
        prior: Square root of the covariance, shape (c, c).
        lin: The image linearised about the prior.
        keep: Points that passed the gate, shape (n,).
        linearise: Linearises again, about a step and with a spread.

    Returns:
        The fit. [Garcia-Fernandez et al., "Posterior linearization filter", 2015]
    """
    S, dx, offset = prior, np.zeros(len(prior)), np.zeros(2 * len(image.ids))
    for step in range(_ITERATIONS):
        if step:
            lin = linearise(dx, S)
            if (keep & lin.valid).sum() < LEAST_POINTS:  # about this step most points are behind the camera
                break
            keep = keep & lin.valid
            # the innovation refers to the prior mean
            lin, offset = replace(lin, spread=lin.by_error @ prior), lin.ways @ (lin.by_error @ dx)
        fit = _correct(prior, image, (image.uv - lin.z).ravel() + offset, lin, keep)
        fit.again = step > 0
        if curved_share(image, lin, fit.keep) < _CURVED:
            break
        step_size = unscented.solve_upper(fit.S, fit.dx - dx)
        S, dx, keep = fit.S, fit.dx, fit.keep
        if step and float(np.linalg.norm(step_size)) < 0.05:
            break
    return fit


def _unmoved(rows: FloatArray, r: FloatArray) -> tuple[float, int]:
    """Sum of squares and number of the rows that no state moves."""
    alone = np.vecdot(rows, rows) < _ALONE
    count = int(np.count_nonzero(alone))
    left = r[alone] if count else r[:0]
    return float(left @ left), count


def _correct(
    prior: FloatArray, image: Image, innovation: FloatArray, lin: Linear, keep: BoolArray
) -> ImageFit:
    """One linear correction; corners whose residual stays impossible are dropped and it is done again."""
    weight, k = 1.0 / np.repeat(image.sigma_px, 2), lin.ways.shape[1]
    ways, r = lin.ways * weight[:, None], innovation * weight
    if lin.curved.size:
        curved = lin.curved * weight[:, None]
        if float(np.vecdot(curved, curved).max(initial=0.0)) > 1e-4:
            ways = np.concatenate([ways, curved], axis=1)
    moves, known = lin.moves, lin.moves.shape[1]
    for _ in range(3):
        rows = rows_of(keep)
        kept, r_kept = ways[rows], r[rows]
        R, r_small, rest, dof_rest = unscented.compress(kept, r_kept)
        small = np.concatenate([R[:, k:], R[:, :k] @ moves], axis=1)
        # Rows that no state moves are residuals like the rest, and say nothing about whether innovations fit.
        apart, count = _unmoved(small, r_small) if dof_rest else (0.0, 0)
        rest, dof_rest = rest + apart, dof_rest + count
        noise = noise_of_image(rest * image.scale, dof_rest)
        c = unscented.correct(prior, small / noise, r_small / noise)
        moved = np.concatenate([moves @ c.solution[-known:], c.solution[:-known]])
        left = (r - ways @ moved).reshape(-1, 2)
        bad = keep & (np.vecdot(left, left) > _RESIDUAL_GATE * max(1.0, rest / max(dof_rest, 1)))
        if not bad.any() or np.count_nonzero(keep & ~bad) < LEAST_POINTS:
            break
        keep = keep & ~bad
    return ImageFit(
        c.S,
        c.dx,
        max(c.nis - apart / noise**2, 0.0),
        max(len(r_small) - count, 1),
        keep,
        rest,
        dof_rest,
        left,
        R[:, :k] / noise,
        r_small / noise,
        (kept[:, :k] / noise, r_kept / noise),
        c.log_det,
        noise,
    )
