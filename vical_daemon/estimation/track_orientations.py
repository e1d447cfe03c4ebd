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
_STEPS = 8


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
    R = np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, dtype=np.float64)
    t = _direction(rays_1, rays_2 @ R.T, np.ones(len(rays_1)))
    J, weight = np.zeros((len(rays_1), 5)), np.ones(len(rays_1))
    for _ in range(_STEPS):
        turned = rays_2 @ R.T
        # noise of either ray moves the error along t x ray: dividing by its length makes the noise one
        a, b = np.cross(turned, t), np.cross(t, rays_1)
        length = np.sqrt(np.einsum("ij,ij->i", a, a) + np.einsum("ij,ij->i", b, b)) + 1e-9
        e = np.einsum("ij,ij->i", rays_1, np.cross(t, turned)) / length
        basis = np.linalg.svd(t[None])[2][1:]
        # d e / d (local rotation): ray_1 . (t x R (d x ray_2)) = d . (ray_2 x R' (ray_1 x t))
        J[:, :3] = np.cross(rays_2, np.cross(rays_1, t) @ R) / length[:, None]
        J[:, 3:] = (np.cross(turned, rays_1) @ basis.T) / length[:, None]
        scale = 3.0 * float(np.median(np.abs(e))) / 0.6745 + 1e-12
        weight = 1.0 / (1.0 + (e / scale) ** 2) ** 2
        A = (J * weight[:, None]).T @ J
        step = -np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(5), (J * weight[:, None]).T @ e)
        R = R @ so3.exp(step[:3])
        t = t + step[3:] @ basis
        t = t / np.linalg.norm(t)
        if np.abs(step[:3]).max() < 1e-9:
            break
    A = (J * weight[:, None]).T @ J + 1e-9 * np.eye(5)
    covariance = np.linalg.inv(A)[:3, :3]
    if not np.isfinite(covariance).all():
        return None
    return R, np.asarray(covariance, dtype=np.float64)


def _direction(rays_1: FloatArray, turned: FloatArray, weight: FloatArray) -> FloatArray:
    """Direction of translation for a given rotation: the normal to all epipolar normals."""
    n = np.cross(turned, rays_1)
    return np.asarray(np.linalg.eigh((n * weight[:, None]).T @ n)[1][:, 0], dtype=np.float64)
