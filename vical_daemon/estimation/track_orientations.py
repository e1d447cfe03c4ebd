"""Camera orientations without a target: relative rotations from tracked features, strung together.

Between two frames a feature's rays obey `ray_1 . (t x R ray_2) = 0`, whatever its depth; rotation R and
direction of translation t are found from all features by Gauss-Newton on that (normalised) error, robustly.
Errors of the chain grow like a random walk; `td_icp` allows for slow errors and measures how large they are.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation import so3
from vical_daemon.estimation.camera_model import unproject
from vical_daemon.estimation.camera_orientations import Orientations
from vical_daemon.estimation.measurements import PointsFrame

FloatArray = npt.NDArray[np.float64]

_MIN_FEATURES = 12
_MAX_GAP_NS = 400_000_000
_STEPS = 12
_PLAIN_STEPS = 6  # before outliers are put aside


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
    chains: list[list[tuple[int, FloatArray, FloatArray]]] = []
    before: tuple[int, npt.NDArray[np.int64], FloatArray] | None = None
    for frame in frames:
        rays, ok = unproject(frame.uv_px, intrinsics, distortion, model)
        order = np.argsort(frame.ids[ok])
        now = (frame.t_cam_ns, frame.ids[ok][order], rays[ok][order])
        step = _step(before, now)
        if step is None:
            chains.append([(frame.t_cam_ns, np.eye(3), np.eye(3))])
        else:
            R, covariance = step
            chains[-1].append((frame.t_cam_ns, chains[-1][-1][1] @ R, covariance * sigma**2))
        before = now
    return [_orientations(chain) for chain in chains if len(chain) > 2]


def _orientations(chain: list[tuple[int, FloatArray, FloatArray]]) -> Orientations:
    covariance = np.stack([c for _, _, c in chain])
    covariance[0] = covariance[1:].mean(axis=0)
    return Orientations(np.array([t for t, _, _ in chain]), np.stack([R for _, R, _ in chain]), covariance)


def _step(
    before: tuple[int, npt.NDArray[np.int64], FloatArray] | None,
    now: tuple[int, npt.NDArray[np.int64], FloatArray],
) -> tuple[FloatArray, FloatArray] | None:
    """Relative rotation and its covariance per unit of ray noise; None where the chain breaks."""
    if before is None or not 0 < now[0] - before[0] < _MAX_GAP_NS:
        return None
    _, i, j = np.intersect1d(before[1], now[1], assume_unique=True, return_indices=True)
    if len(i) < _MIN_FEATURES:
        return None
    return relative_rotation(before[2][i], now[2][j])


def relative_rotation(rays_1: FloatArray, rays_2: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Rotation between two views of unknown points.

    Args:
        rays_1: Unit rays in the first camera frame, shape (n, 3), n >= 12.
        rays_2: Rays of the same points in the second, shape (n, 3).

    Returns:
        R_1_2 (maps vectors of the second frame into the first), and the covariance of its local error for
        rays with unit noise, shape (3, 3); None where the points do not determine it.
    """
    U, _, Vt = np.linalg.svd(rays_1.T @ rays_2)
    start = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    # a turn explains most of what a small translation does: its direction is tried along every axis
    R, t = np.tile(start, (3, 1, 1)), np.eye(3)
    weight = np.ones((3, len(rays_1)))
    cost = np.full(3, np.inf)
    for i in range(_STEPS):
        e, J, basis = _linearise(R, t, rays_1, rays_2)
        if i >= _PLAIN_STEPS:
            scale = 3.0 * np.median(np.abs(e), axis=1, keepdims=True) / 0.6745 + 1e-9
            weight = 1.0 / (1.0 + (e / scale) ** 2) ** 2
        cost = np.median(np.abs(e), axis=1)
        Jt = np.swapaxes(J * weight[..., None], 1, 2)
        A = Jt @ J
        A = A + np.eye(5) * (1e-7 * np.einsum("cii->c", A) / 5.0 + 1e-12)[:, None, None]
        step = -np.linalg.solve(A, Jt @ e[..., None])[..., 0]
        step *= np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(axis=1), 1e-12))[:, None]
        R = R @ so3.exp(step[:, :3])
        t = t + (step[:, None, 3:] @ basis)[:, 0]
        t = t / np.linalg.norm(t, axis=1, keepdims=True)
    best = int(np.argmin(cost))
    Jw = J[best] * weight[best][:, None]
    covariance = np.linalg.inv(Jw.T @ J[best] + 1e-9 * np.eye(5))[:3, :3]
    if not np.isfinite(covariance).all():
        return None
    return np.asarray(R[best], dtype=np.float64), np.asarray(covariance, dtype=np.float64)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product over the last axis; numpy's own is slow on small arrays."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=-1)


def _linearise(
    R: FloatArray, t: FloatArray, rays_1: FloatArray, rays_2: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return normalised epipolar errors (c, n), their derivatives (c, n, 5), tangents of t (c, 2, 3)."""
    turned = rays_2 @ np.swapaxes(R, 1, 2)
    across = t[:, None, :]
    # noise of either ray moves the error along t x ray: dividing by its length makes the noise one
    a, b = _cross(turned, across), _cross(across, rays_1[None])
    length = np.sqrt(np.sum(a * a, axis=-1) + np.sum(b * b, axis=-1)) + 1e-9
    e = np.sum(rays_1 * -a, axis=-1) / length
    basis = np.linalg.svd(t[:, None, :])[2][:, 1:]
    J = np.empty((*e.shape, 5))
    # d e / d (local rotation): ray_1 . (t x R (d x ray_2)) = d . (ray_2 x R' (ray_1 x t))
    J[..., :3] = _cross(rays_2[None], -b @ R)
    J[..., 3:] = _cross(turned, rays_1[None]) @ np.swapaxes(basis, 1, 2)
    return e, J / length[..., None], basis
