"""What was done to a filter from image to image, and the way back through it.

Going back, what images say about the errors at an instant is added up: that is what a smoother adds to the
filter's mean (Bryson and Frazier), and what tells a jump from none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import MOTION
from vical_daemon.estimation.model.unscented import solve_upper, unit


class Moved(NamedTuple):
    """How a filter was propagated.

    Attributes:
        before: Square root of the covariance before, shape (n, n).
        after: Square root of the covariance afterwards, shape (n, n).
        linear: F `before` of the motion, shape (9, n).
        seconds: For how long.
    """

    before: FloatArray
    after: FloatArray
    linear: FloatArray
    seconds: float


class Corrected(NamedTuple):
    """How a filter was corrected by an image.

    Attributes:
        before: Square root of the covariance as predicted, shape (n, n).
        after: Likewise, of the corrected state, by the same errors.
        carried: What its columns are as errors of the corrected state, see `Reset`, shape (n, n).
        ways: The whitened corners by the ways in which the image can move, shape (m, w).
        innovation: Theirs, shape (m,).
        moves: Square root of how far what corners share, and then the state, move the image: (w, c).
    """

    before: FloatArray
    after: FloatArray
    carried: FloatArray
    ways: FloatArray
    innovation: FloatArray
    moves: FloatArray


def by_step(done: Moved | Corrected, drifts: Sequence[tuple[int, int]]) -> FloatArray:
    """Errors after a step by those before it, in columns of the roots, shape (n, n)."""
    if isinstance(done, Corrected):
        return np.asarray(solve_upper(done.before, done.after).T)  # 1 - K H = P+ P^-1
    carried = done.before.copy()
    carried[MOTION] = done.linear
    for shift, rate in drifts:
        carried[shift] += done.seconds * done.before[rate]
    return solve_upper(done.after, carried)


def said(image: Corrected) -> tuple[FloatArray, FloatArray]:
    """W' V^-1 W and W' V^-1 r, V = 1 + W moves moves' W', shapes (w, w) and (w,)."""
    ways, moves = image.ways, image.moves
    N = ways.T @ ways
    weighted = np.concatenate([N, (ways.T @ image.innovation)[:, None]], axis=1)
    inner = np.linalg.solve(unit(len(N)) + N @ (moves @ moves.T), weighted)
    return inner[:, :-1], inner[:, -1]


def smoothed(run: Sequence[Moved | Corrected], drifts: Sequence[tuple[int, int]]) -> list[FloatArray]:
    """Errors from the state predicted for each image to the likeliest by all images, each of shape (n,).

    Args:
        run: What was done to a filter that takes all errors as small.
        drifts: Where errors of a time shift and of its rate are.
    """
    n = len(run[0].before) if run else 0
    said_later, root, out = np.zeros(n), unit(n), list[FloatArray]()
    for done in reversed(run):
        after = done.carried if isinstance(done, Corrected) else done.after
        if after is not root:
            said_later = said_later @ solve_upper(root, after)
        said_later = said_later @ by_step(done, drifts)
        if isinstance(done, Corrected):
            said_later = said_later + said(done)[1] @ done.moves[:, -n:]
            out.append(done.before @ said_later)
        root = done.before
    return out[::-1]
