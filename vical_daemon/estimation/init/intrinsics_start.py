"""A lens adjusted to views of a planar target, with a pose each: for the start of the filter, and for TD-ICP.

[Zhang, "A flexible new technique for camera calibration", 2000, section 3]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import project, project_jacobians
from vical_daemon.estimation.geometry.planar_pose import MIN_POINTS, inliers, planar_poses
from vical_daemon.estimation.init.target_poses import ideal_views
from vical_daemon.estimation.measurements import FloatArray, PointsFrame
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.noise.corner_noise import median_noise
from vical_daemon.estimation.robust import MOST_STEPS
from vical_daemon.estimation.significance import LIKELY_SIGMAS

_MOST_VIEWS = 24  # spread over places, sizes and slants; the filter refines the lens
_EVEN_VIEWS = 60  # of a recording: the board is then seen in many places; takes half a second
_FEWEST = 6  # views
_Poses = list[tuple[FloatArray, FloatArray]]
# relative to fx for the first four; four for the distortion, and radtan's fifth
_PRIOR = np.array([0.3, 0.3, 0.1, 0.1, 0.5, 0.5, 0.05, 0.05, 0.2])


def estimate_intrinsics(lens: CameraState, frames: list[PointsFrame], target: FloatArray) -> LensFit | None:
    """Improve a lens in place by views that are spread evenly over a recording.

    They are like the views whose poses the lens is for. No lens model fits exactly, so a lens adjusted to
    those that differ most would be that of the edge of the image. For the same reason all views have one
    noise: corners beyond it, which a blurred image or the edge of the lens displaces, are left out.

    Args:
        lens: Start values; overwritten.
        frames: Views of the target.
        target: Its points, m, shape (n, 3).

    Returns:
        The fit; None when too few views show a pose (the lens is then left alone).
    """
    views = [f for f in frames if len(f.ids) >= MIN_POINTS]
    views = views[:: max(1, -(-len(views) // _EVEN_VIEWS))]
    fit = fit_lens(views, lens, target)
    for _ in range(MOST_STEPS):
        if fit is None:
            return None
        views = _of_one_noise(fit, lens.distortion_model, target)
        if sum(len(v.ids) for v in views) == sum(len(v.ids) for v in fit.views):
            break
        fit = fit_lens(views, lens, target)
    if fit is not None:
        fit.take_into(lens)
    return fit


def _of_one_noise(fit: LensFit, model: str, target: FloatArray) -> list[PointsFrame]:
    """The views with the corners within four sigma of the noise of all; those that keep half of them."""
    far = [
        np.linalg.norm(
            v.uv_px - project(target[v.ids] @ R.T + p, fit.theta[:4], fit.theta[4:], model), axis=1
        )
        for v, (R, p) in zip(fit.views, fit.poses, strict=True)
    ]
    most = LIKELY_SIGMAS * median_noise(np.concatenate(far), len(far))
    fine = [size <= most for size in far]
    return [
        view.only(good)
        for view, good in zip(fit.views, fine, strict=True)
        if 2 * good.sum() >= max(len(good), 2 * MIN_POINTS)
    ]


class LensFit(NamedTuple):
    """A lens and poses adjusted to views.

    Attributes:
        theta: fx fy cx cy and the distortion, shape (4 + d,).
        poses: R_cam_target and p_cam_target, m, of each view that shows one.
        rms_px: RMS residual, px.
        views: These views, with the corners that belong.
        which: Their places among the views given.
    """

    theta: FloatArray
    poses: _Poses
    rms_px: float
    views: list[PointsFrame]
    which: list[int]

    def take_into(self, lens: CameraState) -> None:
        """Overwrite a lens, unless the fit has gone astray."""
        if np.isfinite(self.rms_px) and 0.3 * lens.intrinsics[0] < self.theta[0] < 3.0 * lens.intrinsics[0]:
            lens.intrinsics, lens.distortion = self.theta[:4], self.theta[4:]

    @property
    def numbers(self) -> int:
        """How many residuals there are."""
        return 2 * sum(len(v.ids) for v in self.views)

    @property
    def squares(self) -> float:
        """Sum of the squared residuals, px^2."""
        return self.rms_px**2 * self.numbers

    @property
    def corner_sigma_px(self) -> float:
        """Noise of a corner per axis, px: the residuals without what lens and poses have taken up."""
        free = max(self.numbers - 6 * len(self.views) - len(self.theta), 1)
        return float(self.rms_px * np.sqrt(self.numbers / free))


def fit_lens(views: list[PointsFrame], lens: CameraState, target: FloatArray) -> LensFit | None:
    """Adjust lens and poses to chosen views, then to their corners that belong; None: too few show a pose."""
    which, poses = _poses(views, lens, target)
    if len(which) < _FEWEST:
        return None
    views = [views[k] for k in which]
    theta, poses, rms_px = adjusted(views, poses, lens, target)
    cleaned = [
        _without_outliers(v, *pose, target, theta, lens.distortion_model)
        for v, pose in zip(views, poses, strict=True)
    ]
    if any(len(new.ids) < len(old.ids) for new, old in zip(cleaned, views, strict=True)):
        theta, poses, rms_px = adjusted(cleaned, poses, lens, target)
    return LensFit(theta, poses, rms_px, cleaned, which)


def adjusted(
    views: list[PointsFrame], poses: _Poses, lens: CameraState, target: FloatArray
) -> tuple[FloatArray, _Poses, float]:
    """Lens (4 + d,), poses and RMS residual in px after the adjustment, from a lens and poses."""
    theta = np.concatenate([lens.intrinsics, lens.distortion])
    scale = _scale(lens)
    prior, cost, damping = theta.copy(), np.inf, 1e-3
    best = (theta, poses)
    for _ in range(MOST_STEPS):
        normal = _normal(views, poses, target, theta, lens.distortion_model)
        if normal is None:
            break
        new_cost = float(normal.squares[0, 0]) + float((((theta - prior) / scale) ** 2).sum())
        if new_cost < cost:
            done = cost - new_cost < 1e-6 * new_cost
            best, cost, damping = (theta, poses), new_cost, damping * 0.3
            if done:
                break
            last = normal
        else:
            damping *= 10.0
        dtheta, dposes = last.solve((prior - best[0]) / scale**2, 1.0 / scale**2, damping)
        theta = best[0] + dtheta
        turns = so3.exp(dposes[:, 3:])
        poses = [(R @ T, p + d[:3]) for (R, p), T, d in zip(best[1], turns, dposes, strict=True)]
    count = sum(2 * len(v.ids) for v in views)
    return best[0], best[1], float(np.sqrt(cost / max(count, 1)))


def _scale(lens: CameraState) -> FloatArray:
    """How far the numbers of a lens may be off, shape (4 + d,)."""
    n = 4 + len(lens.distortion)
    scale: FloatArray = np.concatenate([np.full(4, lens.intrinsics[0]), np.ones(n - 4)]) * _PRIOR[:n]
    return scale


def along(
    fit: LensFit, lens: CameraState, target: FloatArray, moves: Sequence[FloatArray]
) -> list[tuple[float, float]]:
    """How the squared residuals change if all corners move, and lens and poses follow them.

    Args:
        fit: Of the corners where they are.
        lens: As it was before the fit.
        target: Points of the target, m, shape (n, 3).
        moves: Ways in which the corners of all its views, one after the other, move, px, shape (n, 2).

    Returns:
        For each way, half the first and half the second derivative of their sum by the share of it, px^2;
        zeros where a corner lies behind its camera.
    """
    normal = _normal(fit.views, fit.poses, target, fit.theta, lens.distortion_model, moves)
    if normal is None:
        return [(0.0, 0.0)] * len(moves)
    out = []
    for k in range(1, len(moves) + 1):
        of_lens, of_poses = normal.solve(np.zeros(len(fit.theta)), _scale(lens) ** -2.0, 1e-9, k)
        taken = float(of_lens @ normal.b[:, k]) + float((of_poses * normal.c[..., k]).sum())
        out.append((float(normal.squares[0, k]), float(normal.squares[k, k]) - taken))
    return out


def _without_outliers(
    view: PointsFrame, R: FloatArray, p: FloatArray, target: FloatArray, theta: FloatArray, model: str
) -> PointsFrame:
    """The view without the corners that do not belong."""
    uv = project(target[view.ids] @ R.T + p, theta[:4], theta[4:], model)
    far = np.linalg.norm(view.uv_px - uv, axis=1)
    good = inliers(far)
    if good.all() or good.sum() < MIN_POINTS:
        return view
    return view.only(good)


def spread(frames: list[PointsFrame], lens: CameraState) -> list[int]:
    """Choose views with many points that differ most in where the board lies in the image."""
    usable = [k for k, f in enumerate(frames) if len(f.ids) >= MIN_POINTS]
    if len(usable) <= _MOST_VIEWS:
        return usable
    good = [frames[k] for k in usable]
    width, height = lens.resolution
    features = np.array(
        [np.concatenate([f.uv_px.mean(0), f.uv_px.std(0) * 2, f.uv_px[-1] - f.uv_px[0]]) for f in good]
    ) / np.array([width, height, width, height, width, height])
    chosen = [int(np.argmax([len(f.ids) for f in good]))]
    distance = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < _MOST_VIEWS:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return sorted(usable[i] for i in chosen)


def _poses(views: list[PointsFrame], lens: CameraState, target: FloatArray) -> tuple[list[int], _Poses]:
    """Which views show a pose, and these."""
    seen = ideal_views(views, lens, target)
    found = planar_poses([points for points, _ in seen], [xy for _, xy in seen])
    which = [k for k, poses in enumerate(found) if poses.candidates]
    best = [found[k].candidates[0] for k in which]
    return which, [(pose.R_cam_target, pose.p_cam_target) for pose in best]


class _Normal(NamedTuple):
    """Normal equations of a lens and m poses, for residuals and k ways in which corners move.

    Attributes:
        A, b: Of the lens, and its right sides, shapes (n, n), (n, 1 + k).
        P, C, c: Of each pose, with the lens, and its right sides; shapes (m, 6, 6), (m, 6, n), (m, 6, 1 + k).
        squares: Sums of squares and products, px^2, shape (1 + k, 1 + k).
    """

    A: FloatArray
    b: FloatArray
    P: FloatArray
    C: FloatArray
    c: FloatArray
    squares: FloatArray

    def solve(
        self, b0: FloatArray, a0: FloatArray, damping: float, side: int = 0
    ) -> tuple[FloatArray, FloatArray]:
        """Steps of the lens, shape (n,), and of the poses, shape (m, 6), by Schur complement."""
        A = self.A + np.diag(a0)
        A += damping * np.diag(np.diag(A))
        diagonals = np.eye(6) * np.einsum("mii->mi", self.P)[:, None]
        inverse = np.linalg.inv(self.P + damping * diagonals)
        reduced = np.matmul(inverse, self.C)
        A -= np.tensordot(self.C, reduced, axes=((0, 1), (0, 1)))
        b, c = self.b[:, side] + b0, self.c[..., side]
        d = np.asarray(np.linalg.solve(A, b - np.tensordot(reduced, c, axes=((0, 1), (0, 1)))), np.float64)
        return d, np.matvec(inverse, c - self.C @ d)


def _normal(
    views: list[PointsFrame],
    poses: _Poses,
    target: FloatArray,
    theta: FloatArray,
    model: str,
    moves: Sequence[FloatArray] = (),
) -> _Normal | None:
    """All corners at once, summed up by view; None: some lie behind their camera."""
    n = len(theta)
    X = target[np.concatenate([v.ids for v in views])]
    ends = np.cumsum([len(v.ids) for v in views])
    each = [slice(end - len(v.ids), end) for v, end in zip(views, ends, strict=True)]
    x = np.concatenate([X[at] @ R.T + p for at, (R, p) in zip(each, poses, strict=True)])
    uv, J_point, J_lens = project_jacobians(x, theta[:4], theta[4:], model)
    if not np.isfinite(uv).all():
        return None
    rows = np.empty((len(X), 2, 7 + n + len(moves)))
    rows[..., :3] = J_point
    turned = np.concatenate([J_point[at] @ R for at, (R, _) in zip(each, poses, strict=True)])
    rows[..., 3:6] = so3.cross(X[:, None], turned)  # j' R (d x X) = (X x R' j)' d
    rows[..., 6 : 6 + n] = J_lens
    rows[..., 6 + n] = np.concatenate([v.uv_px for v in views]) - uv
    for k, move in enumerate(moves):
        rows[..., 7 + n + k] = move
    sums = np.array([(w := rows[at].reshape(-1, rows.shape[2])).T @ w for at in each])
    whole = sums[:, 6:, 6:].sum(axis=0)
    return _Normal(
        whole[:n, :n],
        whole[:n, n:],
        sums[:, :6, :6],
        sums[:, :6, 6 : 6 + n],
        sums[:, :6, 6 + n :],
        whole[n:, n:],
    )
