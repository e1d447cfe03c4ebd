"""Camera orientations without a target: relative rotations from tracked features, strung together.

Between two frames a feature's rays obey `ray_1 . (t x R ray_2) = 0`, whatever its depth; rotation R and
direction of translation t are found from all features by Gauss-Newton on that (normalised) error, robustly.
Errors of the chain grow like a random walk; `td_icp` allows for slow errors and measures how large they are.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.planar_pose import TOGETHER
from vical_daemon.estimation.measurements import IMAGE_GAP_S, FloatArray, PointsFrame
from vical_daemon.estimation.model.camera_rays import unproject
from vical_daemon.estimation.robust import MEDIAN_ABSOLUTE, geman_mcclure_weight
from vical_daemon.estimation.temporal.camera_orientations import Orientations

MIN_FEATURES = 12  # that two images share: below, they do not show how the camera turned
_STEPS = 12  # Gauss-Newton steps of one pair of images; outliers are put aside in the second half

Pair = tuple[FloatArray, FloatArray]


class _Rays(NamedTuple):
    """Unit rays of one frame, by id."""

    t_ns: int
    ids: npt.NDArray[np.int64]
    rays: FloatArray


def track_orientations(
    frames: Iterable[PointsFrame],
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str = "radtan",
    corner_sigma_px: float = 1.0,
) -> list[Orientations]:
    """Turn tracks of unknown points into camera orientations; the world is the first frame of each chain.

    Args:
        frames: Tracks in order of time; an id names the same point in all frames.
        intrinsics: fx fy cx cy, px, shape (4,).
        distortion: Four coefficients, shape (4,).
        model: radtan or equidistant.
        corner_sigma_px: Noise of a feature per axis, px (scales the covariances only).

    Returns:
        Chains of orientations in order of time; a new one starts where too few features carry over.
    """
    sigma = corner_sigma_px / float(np.mean(intrinsics[:2]))
    seen: list[_Rays] = []
    for frame in frames:
        rays, ok = unproject(frame.uv_px, intrinsics, distortion, model)
        order = np.argsort(frame.ids[ok])
        seen.append(_Rays(frame.t_cam_ns, frame.ids[ok][order], rays[ok][order]))
    pairs = [_matched(before, now) for before, now in pairwise(seen)]
    steps = iter(relative_rotations([pair for pair in pairs if pair is not None]))
    chains: list[list[tuple[int, FloatArray, FloatArray]]] = [
        [(x.t_ns, np.eye(3), np.eye(3))] for x in seen[:1]
    ]
    for now, pair in zip(seen[1:], pairs, strict=True):
        step = None if pair is None else next(steps)
        if step is None:
            chains.append([(now.t_ns, np.eye(3), np.eye(3))])
        else:
            R, covariance = step
            chains[-1].append((now.t_ns, chains[-1][-1][1] @ R, covariance * sigma**2))
    return [_orientations(chain) for chain in chains if len(chain) > 2]


def _orientations(chain: list[tuple[int, FloatArray, FloatArray]]) -> Orientations:
    covariance = np.stack([c for _, _, c in chain])
    covariance[0] = covariance[1:].mean(axis=0)
    return Orientations(np.array([t for t, _, _ in chain]), np.stack([R for _, R, _ in chain]), covariance)


def _matched(before: _Rays, now: _Rays) -> Pair | None:
    """Rays of what both frames see; None where the chain breaks."""
    if not 0 < now.t_ns - before.t_ns < 1e9 * IMAGE_GAP_S:
        return None
    _, i, j = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
    return (before.rays[i], now.rays[j]) if len(i) >= MIN_FEATURES else None


def relative_rotations(pairs: list[Pair]) -> list[tuple[FloatArray, FloatArray] | None]:
    """Rotations between pairs of views of unknown points, many at once: alone each takes 10 ms of overhead.

    Args:
        pairs: Unit rays of the same points in the first and in the second camera frame, shape (n, 3) each,
            n >= 12.

    Returns:
        For each pair R_1_2 (maps vectors of the second frame into the first), and the covariance of its local
        error for rays with unit noise, shape (3, 3); None where the points do not determine it.
    """
    out: list[tuple[FloatArray, FloatArray] | None] = []
    for k in range(0, len(pairs), TOGETHER):
        out += _adjusted(pairs[k : k + TOGETHER])
    return out


def _adjusted(pairs: list[Pair]) -> list[tuple[FloatArray, FloatArray] | None]:
    """`relative_rotations` for some pairs, filled up to the same number of rays."""
    count = np.array([len(first) for first, _ in pairs])
    rays_1, rays_2 = np.zeros((2, len(pairs), count.max(), 3))
    for k, (first, second) in enumerate(pairs):
        rays_1[k, : count[k]], rays_2[k, : count[k]] = first, second
    turned = so3.nearest_rotation(np.swapaxes(rays_1, 1, 2) @ rays_2)
    # a turn explains most of what a small translation does: its direction is tried along every axis
    R, t = np.repeat(turned, 3, axis=0), np.tile(np.eye(3), (len(pairs), 1))
    rays_1, rays_2, count = (np.repeat(x, 3, axis=0) for x in (rays_1, rays_2, count))
    there = np.arange(rays_1.shape[1]) < count[:, None]
    weight = there.astype(np.float64)
    for i in range(_STEPS):
        e, J, basis = _linearise(R, t, rays_1, rays_2)
        cost = _middle(np.where(there, np.abs(e), np.inf), count)
        if i >= _STEPS // 2:
            scale = 3.0 * cost[:, None] / MEDIAN_ABSOLUTE + 1e-9
            weight = there * geman_mcclure_weight((e / scale) ** 2)
        Jt = np.swapaxes(J * weight[..., None], 1, 2)
        A = Jt @ J
        A = A + np.eye(5) * (1e-7 * np.einsum("cii->c", A) / 5.0 + 1e-12)[:, None, None]
        step = -np.linalg.solve(A, Jt @ e[..., None])[..., 0]
        step *= np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(axis=1), 1e-12))[:, None]
        R = R @ so3.exp(step[:, :3])
        t = t + (step[:, None, 3:] @ basis)[:, 0]
        t = t / np.linalg.norm(t, axis=1, keepdims=True)
    best = 3 * np.arange(len(pairs)) + np.argmin(cost.reshape(-1, 3), axis=1)
    Jw = J[best] * weight[best][..., None]
    covariance = np.linalg.inv(np.swapaxes(Jw, 1, 2) @ J[best] + 1e-9 * np.eye(5))[:, :3, :3]
    return [(R[k], C) if np.isfinite(C).all() else None for k, C in zip(best, covariance, strict=True)]


def _middle(values: FloatArray, count: npt.NDArray[np.int64]) -> FloatArray:
    """Median of the first `count` smallest of each row (the rest is infinite), shape (c,)."""
    ordered, rows = np.sort(values, axis=1), np.arange(len(values))
    return np.asarray(0.5 * (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]))


def _linearise(
    R: FloatArray, t: FloatArray, rays_1: FloatArray, rays_2: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return normalised epipolar errors (c, n), their derivatives (c, n, 5), tangents of t (c, 2, 3).

    Rays have shape (c, n, 3).
    """
    turned = rays_2 @ np.swapaxes(R, 1, 2)
    across = t[:, None, :]
    # noise of either ray moves the error along t x ray: dividing by its length makes the noise one
    a, b = so3.cross(turned, across), so3.cross(across, rays_1)
    length = np.sqrt(np.sum(a * a, axis=-1) + np.sum(b * b, axis=-1)) + 1e-9
    e = np.sum(rays_1 * -a, axis=-1) / length
    basis = np.linalg.svd(t[:, None, :])[2][:, 1:]
    J = np.empty((*e.shape, 5))
    # d e / d (local rotation): ray_1 . (t x R (d x ray_2)) = d . (ray_2 x R' (ray_1 x t))
    J[..., :3] = so3.cross(rays_2, -b @ R)
    J[..., 3:] = so3.cross(turned, rays_1) @ np.swapaxes(basis, 1, 2)
    return e, J / length[..., None], basis
