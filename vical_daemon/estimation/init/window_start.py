"""The start by one window: the first seconds are adjusted, and a filter takes their images about the result.

What the corners of an image share (late stamps, shifts of the whole image) is measured in the window.
[docs/math/filter.md, eq. (12), (20) and (21)]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.linearised_filter import LinearisedFilter
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.board_window import BoardWindow, Present, Whitened
from vical_daemon.estimation.init.target_poses import TargetPose
from vical_daemon.estimation.measurements import FloatArray, Frames, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.priors import KNOWN_SIZE_SIGMA
from vical_daemon.estimation.model.state import State
from vical_daemon.estimation.model.unscented import root, solve_lower
from vical_daemon.estimation.noise.shared_errors import JITTERS_S, SHIFTS_PX, WAYS, SharedErrors
from vical_daemon.estimation.noise.variance_components import of_window
from vical_daemon.estimation.significance import SURE_SIGMAS

_FAR = 0.03  # a target so much larger or smaller is another one: its prior is too narrow
Step = Callable[[CalibrationFilter, PointsFrame, float], FrameReport | None]


class WindowStart(NamedTuple):
    """What a start by a window gave.

    Attributes:
        filter: Begins at the first image and is to take them all.
        size: How large the target is, relative to what it was taken to be, where that is surely and by far
            another size, or where the size in its file fits as well: start again with it. None: it fits.
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
    now = None if window is None else window.present()
    if window is None or now is None:
        return None
    try:  # as if corners were independent a shift of the image would count as motion
        before = shared_errors(window, now, window.whitened(now))
        window.shared = {name: shared.sigmas for name, shared in before.items()}
        solved = window.solve(now)
        if solved is None:
            return None
        shared = shared_errors(window, *solved)
    except np.linalg.LinAlgError:  # an image that nothing else says anything of
        return None
    trial = window.filter(make(deepcopy(state)))
    trial.agreement = {}  # what it says of the lens is not kept
    trial.shared = {name: old if (old := trial.shared[name]).images else new for name, new in shared.items()}
    reports = [r for t, frame in frames if (r := step(trial, frame, t)) is not None]
    few = not trial.seen or 2 * sum(r.used for r in reports) < len(reports)
    if few or not trial.plain().finite():
        return None
    out = window.filter(make(deepcopy(state)), trial.smoothed())
    out.corner_noise, out.shared, out.consistency = trial.corner_noise, trial.shared, trial.consistency
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


def shared_errors(window: BoardWindow, now: Present, images: list[Whitened]) -> dict[str, SharedErrors]:
    """What the corners of an image share, by the likelihood of all images of the window together.

    With u what they share (three errors an image), the normal equations are extended by u, and motion and
    constants are eliminated from them: S u = s + noise of covariance S. [docs/math/filter.md, eq. (12)]
    """
    out = {name: SharedErrors() for name in window.sigma_px}
    S, s = _shared_information(window, now, images)
    camera = np.repeat([list(out).index(view.camera) for view in now.views], WAYS)
    for _ in range(2 if len(out) > 1 else 1):  # each camera with what the others were found to have
        for k, (name, shared) in enumerate(out.items()):
            own, others = camera == k, camera != k
            if not own.any():
                continue
            sigmas = np.concatenate([list(out.values())[c].sigmas for c in camera[others][::WAYS]] or [[]])
            T = S[np.ix_(own, others)] * sigmas
            A = np.eye(len(sigmas)) + sigmas[:, None] * S[np.ix_(others, others)] * sigmas
            known = np.linalg.solve(A, np.column_stack([T.T, sigmas * s[others]]))
            information, right = S[np.ix_(own, own)] - T @ known[:, :-1], s[own] - T @ known[:, -1]
            last_s = max(t for node in window.nodes for t, f in node.frames if f.camera == name)
            shared.begin(of_window(information, right, JITTERS_S, SHIFTS_PX), last_s)
    return out


def _shared_information(
    window: BoardWindow, now: Present, images: list[Whitened]
) -> tuple[FloatArray, FloatArray]:
    """Information on what corners share in each image, and right side; motion and constants eliminated."""
    H, g = window.normal(now, images, together=False)
    n = WAYS * len(now.views)
    across, own, right = np.zeros((n, len(H))), np.zeros((n, n)), np.zeros(n)
    for k, (view, (W, _, r, *_)) in enumerate(zip(now.views, images, strict=True)):
        ways = W @ view.by_shared
        here = slice(WAYS * k, WAYS * k + WAYS)
        across[here, window.places(view.node)] = (ways.T @ W) @ view.by_error
        own[here, here], right[here] = ways.T @ ways, ways.T @ r
    taken = solve_lower(root(H), np.column_stack([across.T, g]))
    return own - taken[:, :-1].T @ taken[:, :-1], right - taken[:, :-1].T @ taken[:, -1]
