"""The start by one window: the first seconds are adjusted, and a filter takes their images about the result.

What the corners of an image share (late stamps, shifts of the whole image) is measured in the window, by
comparing each image with what all others say of it. [docs/math/filter.md, eq. (20) and (21)]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.linearised_filter import LinearisedFilter
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.board_window import BoardWindow, Frames, View
from vical_daemon.estimation.init.target_poses import TargetPose
from vical_daemon.estimation.measurements import FloatArray, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.priors import KNOWN_SIZE_SIGMA
from vical_daemon.estimation.model.state import State
from vical_daemon.estimation.noise.shared_errors import SharedErrors, shared_ways
from vical_daemon.estimation.significance import SURE_SIGMAS

_MOST_RATIO = 5.0  # of one image's squared innovation over its prediction
_FAR = 0.03  # a target so much larger or smaller is another one: its prior is too narrow

Step = Callable[[CalibrationFilter, PointsFrame, float], FrameReport | None]


class WindowStart(NamedTuple):
    """What a start by a window gave.

    Attributes:
        filter: Begins at the first image and is to take them all.
        size: How large the target is, relative to what it was taken to be, where that is surely and by far
            another size, or where the size in its file fits as well: to be started with anew. None: it fits.
    """

    filter: LinearisedFilter
    size: float | None


def window_start(
    state: State,
    poses: Sequence[TargetPose],
    frames: Frames,
    make: Callable[[State], CalibrationFilter],
    step: Step,
    buffer: ImuBuffer,
    target: FloatArray,
    stated: float = 1.0,
) -> WindowStart | None:
    """Adjust the first seconds; return a filter that takes their images.

    It begins with the prior about `state`, so that every image counts once. Another one like it takes the
    images first and measures their noise.

    Args:
        state: Where the closed form thinks the rig is, and its calibration.
        poses: Of images of all cameras, as the closed form used them.
        frames: (stamp in the camera's clock in s, points) of the start, in order.
        make: Builds a filter with the prior about a state.
        step: Propagates a filter to an image and corrects it.
        buffer: Inertial readings.
        target: Points of the target, m, shape (n, 3).
        stated: Size of the target in its file over the one that it is taken to have.

    Returns:
        The start, or None where the data do not hold together.
    """
    window = BoardWindow.begin(state, poses, frames, make(deepcopy(state)), buffer, target)
    if window is None or not window.solve():
        return None
    trial = window.filter(make(deepcopy(state)))
    try:
        trial.shared = shared_errors(window)
    except np.linalg.LinAlgError:  # an image that nothing else says anything of
        return None
    reports = [r for t, frame in frames if (r := step(trial, frame, t)) is not None]
    if 2 * sum(r.used for r in reports) < len(reports) or not trial.plain().plausible():
        return None
    out = window.filter(make(deepcopy(state)))
    out.corner_noise, out.shared, out.consistency = trial.corner_noise, trial.shared, trial.consistency
    for shared in out.shared.values():
        shared.begin()
    for consistency in out.consistency.values():
        consistency.settle()
    return WindowStart(out, _size(trial.plain(), stated))


def _size(f: CalibrationFilter, stated: float) -> float | None:
    """See `WindowStart.size`; the size in the file must be contradicted by data, not by the wider prior."""
    where = f.layout.target_scale
    if where is None:
        return None
    size, sigma = f.state.target_scale, float(f.sigmas()[where])
    data = max(sigma**-2 - KNOWN_SIZE_SIGMA**-2, 0.0)
    off = data * (stated - 1.0) - (size - 1.0) / sigma**2  # by the data alone: sigmas times their root
    if stated != 1.0 and abs(off) <= SURE_SIGMAS * np.sqrt(data):
        return stated
    return size if abs(size - 1.0) > max(_FAR, SURE_SIGMAS * sigma) else None


class _Apart(NamedTuple):
    """One image against all others, over its noise; see `SharedErrors.learn`.

    Attributes:
        innovation: Shape (2n,).
        by_shared: Shape (2n, 3).
        by_states: Shape (3, k).
        ratio: Squared innovation over its prediction, by degree of freedom.
    """

    innovation: FloatArray
    by_shared: FloatArray
    by_states: FloatArray
    ratio: float


def shared_errors(window: BoardWindow) -> dict[str, SharedErrors]:
    """What the corners of an image share, from how it differs from what all other images say of it."""
    out = {name: SharedErrors() for name in window.sigma_px}
    now = window.present()
    if now is None:
        return out
    H, _ = window.normal(now)
    P = cho_solve((cholesky(H, lower=True), True), np.eye(len(H)))
    seen: dict[str, list[_Apart]] = {name: [] for name in out}
    for view in now.views:
        seen[view.camera].append(_apart(window, view, P))
    for name, images in seen.items():
        # as in `Consistency`: where images of any kind miss, that in these ways is nothing of its own
        level = float(np.mean([min(x.ratio, _MOST_RATIO) for x in images] or [1.0]))
        for x in images:
            out[name].learn(x.innovation, x.by_shared, x.by_states, max(level, 1.0))
        out[name].begin()
    return out


def _apart(window: BoardWindow, view: View, P: FloatArray) -> _Apart:
    """An image against all others; `P`: covariance of all unknowns."""
    W, r = window.whitened(view)
    A, b = W.T @ W, W.T @ r
    at = window.places(view.node)
    spread = view.by_error @ P[at[:, None], at] @ view.by_error.T
    others = np.linalg.solve(np.eye(len(A)) - spread @ A, spread)  # (spread^-1 - A)^-1
    values, vectors = np.linalg.eigh(0.5 * (others + others.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    innovation = r + W @ (others @ b)
    node = window.nodes[view.node]
    by_shared = W @ view.by_error @ shared_ways(window.at(node, view.camera), window.layout, view.camera)
    moved, M = W.T @ innovation, A @ root
    explained, _, rank, _ = np.linalg.lstsq(A + M @ M.T, moved, rcond=None)
    ratio = float(moved @ explained) / max(int(rank), 1)
    return _Apart(innovation, by_shared, (by_shared.T @ W) @ root, ratio)
