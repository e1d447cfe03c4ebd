"""How much less certain a window is because the errors of a track are alike.

What a landmark takes of the errors of its track is lost to the residuals, so their correlation in time, as
residuals show it, is too small; and how much it matters depends on the parameter. Tracks err independently
of each other, though. Each of them moves a parameter, as the window finds it, by some d, and the sum of d^2
is the variance that the pixels cause, whatever the errors of a track have in common. [Liang and Zeger,
"Longitudinal data analysis using generalized linear models", 1986; docs/math/target_free.md]
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.blas import dtrsm

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.smoother.normal import POSE, Normal, Problem, inverse_roots
from vical_daemon.estimation.smoother.window import Seen


def with_track_errors(
    covariance: FloatArray, problem: Problem, seen: Seen, normal: Normal, root: FloatArray
) -> FloatArray:
    """A window's covariance with the sigmas that its tracks show, and the same correlations.

    Those of lever arm, mounting and lens; none becomes smaller. Time shift and drift are left as they are:
    their errors nearly cancel at the window's end, and would not if each had a scale of its own.

    Args:
        covariance: Of the states from `Order.tail` on, with pixels that err as measured, shape (t, t).
        problem: Of an adjusted window.
        seen: The observations it used.
        normal: Its normal equations there.
        root: Cholesky factor of the states' matrix without landmarks, lower triangle.
    """
    order, J = problem.order(), normal.J
    layout, where = problem.carry.layout, problem.carry.layout.camera
    blocks = (where.position, where.rotation, where.intrinsics, where.distortion)
    at = order.constants[0] - layout.core + np.concatenate([np.r_[x] for x in blocks if x is not None])
    of_tail = at - order.tail
    X = np.zeros((order.size, len(at)))  # columns of the inverse
    head, tail = slice(None, order.tail), slice(order.tail, None)
    X[tail] = covariance[:, of_tail]
    X[head] = dtrsm(-1.0, root[head, head], root[tail, head].T @ X[tail], lower=1, trans_a=1)
    # by how much each pixel moves these numbers while its landmark stays,
    moved = J[:, :, problem.camera_columns()] @ X[order.camera]
    poses = X[order.frames[:, :6]]
    for frame, rows in zip(seen.frames_with, np.split(seen.by_frame, seen.frame_begin[1:]), strict=True):
        moved[rows] += J[rows, :, POSE] @ poses[frame]
    # and what the landmark takes of that
    inverse = inverse_roots(normal.V)
    taken = inverse @ (normal.W @ X[np.concatenate([order.frames[:, :6].ravel(), order.camera])])
    by_track = np.add.reduceat(np.vecmat(J[:, :, -1], moved), seen.begin)
    by_track -= np.vecmat(np.matvec(inverse, normal.gl), taken)
    shown, counted = (by_track**2).sum(axis=0), (moved**2).sum(axis=(0, 1)) - (taken**2).sum(axis=(0, 1))
    scale = np.ones(len(covariance))
    more = np.maximum(shown - counted, 0.0)  # of few tracks, less may be chance
    scale[of_tail] = np.sqrt(1.0 + more / np.diag(covariance)[of_tail])
    return covariance * np.outer(scale, scale)
