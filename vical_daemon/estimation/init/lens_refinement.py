"""Better intrinsics from many views of the target: a robust bundle adjustment, all views in one array.

Camera orientations are no better than the lens: a principal point 5 px off turns every view by 0.6 deg, and
by different amounts as the board moves through the image, which looks like a delay. Where a recording shows
the board in many places it says more about the lens than a data sheet does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import EQUIDISTANT, project_jacobians
from vical_daemon.estimation.geometry.planar_pose import planar_pose
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.model.camera_rays import undistort, valid_radius

FloatArray = npt.NDArray[np.float64]

_STEPS = 25
_WIDTH = 4.0
_DONE = 1e-7  # relative gain of a step below which nothing changes any more
_MIN_VIEWS = 8
_MIN_POINTS = 12
# One-sigma of the start values: focal lengths and centre relative to the focal length, then k1 k2 p1 p2 k3
_PRIOR = np.array([0.2, 0.2, 0.1, 0.1, 0.5, 0.5, 0.02, 0.02, 0.2])


@dataclass(frozen=True)
class LensFit:
    """A refined lens.

    Attributes:
        intrinsics: fx fy cx cy, px, shape (4,).
        distortion: The model's d coefficients, shape (d,).
        sigma: Standard deviations of all these, from the residuals, shape (4 + d,).
        corner_sigma_px: Robust noise of a corner per axis, px.
        views: Views that took part; 0: too few, and the start values are returned.
    """

    intrinsics: FloatArray
    distortion: FloatArray
    sigma: FloatArray
    corner_sigma_px: float
    views: int


@dataclass
class _Views:
    """Views in one array: uv (v, n, 2) with a mask (v, n), and poses R (v, 3, 3), p (v, 3)."""

    uv: FloatArray
    seen: npt.NDArray[np.bool_]
    R: FloatArray
    p: FloatArray

    def moved(self, step: FloatArray) -> _Views:
        """The views with their poses stepped by [p, local rotation], shape (v, 6)."""
        return _Views(self.uv, self.seen, self.R @ so3.exp(step[:, 3:]), self.p + step[:, :3])


def _settle(
    views: _Views, points_m: FloatArray, lens: FloatArray, model: str, sigma: float, width: float
) -> _Views:
    """Let the poses follow a changed lens: depth and focal length trade places far from linearly."""
    for _ in range(2):
        system = _System.build(views, points_m, lens, model, sigma, width)
        P = system.P + np.eye(6) * (1e-6 * np.einsum("vii->vi", system.P) + 1e-9)[:, None, :]
        views = views.moved(np.linalg.solve(P, system.c[..., None])[..., 0])
    return views


def refine_lens(
    frames: Sequence[PointsFrame],
    points_m: FloatArray,
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str = "radtan",
    max_views: int = 60,
) -> LensFit:
    """Adjust the lens to views of a planar target, spread evenly over the recording.

    Levenberg-Marquardt with the poses eliminated, corners weighted by Geman and McClure's function of their
    residual over the median residual.

    Args:
        frames: Views; ids index `points_m`.
        points_m: Target points, m, shape (n, 3).
        intrinsics: Start, fx fy cx cy, px; within some 20 %.
        distortion: Start, the model's coefficients.
        model: radtan, plumb_bob or equidistant.
        max_views: How many views to use.

    Returns:
        The lens; the start values with `views` 0 where fewer than 8 views can be used.
    """
    lens = np.concatenate((intrinsics, distortion)).astype(np.float64)
    views = _collect(frames, points_m, lens, model, max_views)
    if views is None:
        return LensFit(lens[:4], lens[4:], np.full(len(lens), np.nan), float("nan"), 0)
    scale = np.concatenate((np.full(4, lens[0]), np.ones(len(lens) - 4))) * _PRIOR[: len(lens)]
    start, damping = lens.copy(), 1e-8
    measured: float | None = None
    sigma = 1.0
    for i in range(_STEPS):
        # far from the minimum large residuals are news, not outliers: the gate closes step by step
        width = max(_WIDTH, 10.0 * _WIDTH * 0.4**i)
        system = _System.build(views, points_m, lens, model, measured, width)
        # one corner noise for both costs that are compared; the measured one is for the next round
        sigma, measured = measured or system.sigma, system.sigma
        cost = system.cost + float((((lens - start) / scale) ** 2).sum())
        moved = False
        while damping < 1e6 and not moved:
            d_lens, d_pose = system.solve((start - lens) / scale**2, scale**-2, damping)
            trial = _settle(views.moved(d_pose), points_m, lens + d_lens, model, sigma, width)
            new = _System.build(trial, points_m, lens + d_lens, model, sigma, width, cost_only=True)
            new_cost = new.cost + float((((lens + d_lens - start) / scale) ** 2).sum())
            moved = bool(new_cost < cost)
            damping *= 0.1 if moved else 10.0
        if not moved and width == _WIDTH:
            break
        damping = min(damping, 1.0)
        if not moved:
            continue
        views, lens = trial, lens + d_lens
        if width == _WIDTH and cost - new_cost < _DONE * cost:
            break
    final = _System.build(views, points_m, lens, model, sigma, _WIDTH)
    covariance = np.linalg.inv(final.reduced(scale**-2, 0.0)[0])
    return LensFit(lens[:4], lens[4:], np.sqrt(np.diagonal(covariance)), final.sigma, len(views.R))


def _collect(
    frames: Sequence[PointsFrame], points_m: FloatArray, lens: FloatArray, model: str, max_views: int
) -> _Views | None:
    """Choose views with many points, evenly in time, and find their poses with the lens at hand."""
    enough = max(_MIN_POINTS, 0.5 * float(np.median([len(f.ids) for f in frames]))) if frames else 0
    good = [f for f in frames if len(f.ids) >= enough]
    if len(good) > max_views:
        good = [good[i] for i in np.linspace(0, len(good) - 1, max_views).round().astype(int)]
    uv = np.full((len(good), len(points_m), 2), np.nan)
    R, p, kept = [], [], []
    for i, frame in enumerate(good):
        known = (frame.ids >= 0) & (frame.ids < len(points_m))
        xy, ok = undistort(frame.uv_px[known], lens[:4], lens[4:], model)
        found = planar_pose(points_m[frame.ids[known][ok]], xy[ok])
        if found.candidates and not found.ambiguous:
            uv[i, frame.ids[known]] = frame.uv_px[known]
            R.append(found.candidates[0].R_cam_target)
            p.append(found.candidates[0].p_cam_target)
            kept.append(i)
    if len(kept) < _MIN_VIEWS:
        return None
    uv = uv[kept]
    return _Views(np.nan_to_num(uv), np.isfinite(uv[..., 0]), np.stack(R), np.stack(p))


@dataclass
class _System:
    """Normal equations: lens (n, n), poses (v, 6, 6), and between (v, 6, n); gradients; robust cost."""

    A: FloatArray
    P: FloatArray
    C: FloatArray
    b: FloatArray
    c: FloatArray
    cost: float
    sigma: float

    @classmethod
    def build(
        cls,
        views: _Views,
        points_m: FloatArray,
        lens: FloatArray,
        model: str,
        sigma: float | None,
        width: float,
        cost_only: bool = False,
    ) -> _System:
        """Linearise; corners off by more than `width` times `sigma` (None: these residuals') hardly count."""
        q = points_m @ np.swapaxes(views.R, 1, 2) + views.p[:, None]
        uv, J_point, J_lens = project_jacobians(q, lens[:4], lens[4:], model)
        inside = views.seen & np.isfinite(uv).all(axis=-1)
        if model != EQUIDISTANT:
            inside &= np.hypot(q[..., 0], q[..., 1]) < valid_radius(lens[4:]) * q[..., 2]
        r = np.where(inside[..., None], views.uv - np.nan_to_num(uv), 0.0)
        r2 = np.einsum("vni,vni->vn", r, r)
        measured = float(np.sqrt(np.median(r2[inside]) / 1.386)) if inside.any() else 1.0
        scale2 = (width * max(sigma or measured, 1e-3)) ** 2
        # what is lost from sight costs as much as a gross outlier, so that no step gains by losing it
        cost = float(np.where(inside, r2 / (1.0 + r2 / scale2), np.where(views.seen, scale2, 0.0)).sum())
        cost /= max(sigma or measured, 1e-3) ** 2
        empty = np.zeros(0)
        if cost_only:
            return cls(empty, empty, empty, empty, empty, cost, measured)
        weight = np.where(inside, 1.0 / (1.0 + r2 / scale2) ** 2, 0.0) / max(sigma or measured, 1e-3) ** 2
        v = len(views.R)
        # d(point)/d(local rotation) = -R hat(X)
        J_turn = -(J_point @ (views.R[:, None] @ so3.hat(points_m)))
        root = np.sqrt(weight)[..., None, None]
        Jp = np.nan_to_num(np.concatenate((J_point, J_turn), axis=-1) * root).reshape(v, -1, 6)
        Jl = np.nan_to_num(J_lens * root).reshape(v, -1, len(lens))
        e = (r * root[..., 0]).reshape(v, -1, 1)
        Jpt, Jlt = np.swapaxes(Jp, 1, 2), np.swapaxes(Jl, 1, 2)
        return cls(
            (Jlt @ Jl).sum(axis=0),
            Jpt @ Jp,
            Jpt @ Jl,
            (Jlt @ e).sum(axis=0)[:, 0],
            (Jpt @ e)[..., 0],
            cost,
            measured,
        )

    def reduced(self, prior: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
        """Information of the lens with the poses eliminated (n, n), and the poses' inverses (v, 6, 6)."""
        diagonal = np.einsum("vii->vi", self.P)
        P_inverse = np.linalg.inv(self.P + np.eye(6) * (damping * diagonal + 1e-9)[:, None, :])
        A = self.A + np.diag(prior) + damping * np.diag(np.diagonal(self.A))
        out: FloatArray = A - np.einsum("vpl,vpq,vqm->lm", self.C, P_inverse, self.C)
        return out, np.asarray(P_inverse, dtype=np.float64)

    def solve(self, pull: FloatArray, prior: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
        """Steps of the lens (n,) and of the poses (v, 6)."""
        S, P_inverse = self.reduced(prior, damping)
        b = self.b + pull - np.einsum("vpl,vpq,vq->l", self.C, P_inverse, self.c)
        d_lens = np.linalg.solve(S, b)
        d_pose = np.einsum("vpq,vq->vp", P_inverse, self.c - self.C @ d_lens)
        return np.asarray(d_lens, dtype=np.float64), np.asarray(d_pose, dtype=np.float64)
