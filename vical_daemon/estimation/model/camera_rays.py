"""From pixels back to rays, for the lenses of `camera_model`, by Newton's method."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry.camera_model import (
    EQUIDISTANT,
    RADTAN,
    check_model,
    distort,
    radtan_derivative,
)
from vical_daemon.estimation.measurements import COLUMNS, BoolArray, FloatArray
from vical_daemon.estimation.robust import MOST_STEPS

PATCHES = (8, 6)  # across and down: a lens is close to its linearisation within each
_NEWTON_DONE = 1e-9
"""Step in normalised units (focal lengths), a millionth of a pixel. What is left after it is its square."""


def unproject(
    uv_px: FloatArray, intrinsics: FloatArray, distortion: FloatArray, model: str = RADTAN
) -> tuple[FloatArray, BoolArray]:
    """Return the unit rays of pixels, found by Newton's method, with a mask of where that succeeded.

    Args:
        uv_px: Raw distorted pixels, shape (..., 2).
        intrinsics: fx fy cx cy, px, shape (..., 4).
        distortion: The model's coefficients, shape (..., d).
        model: radtan, plumb_bob or equidistant.

    Returns:
        Unit rays in the camera frame (..., 3), not-a-number where not ok; ok (...): converged, and on the
        branch where the distortion is still monotonic (beyond it two rays share a pixel).

    Raises:
        ValueError: unknown model.
    """
    check_model(model)
    K = np.asarray(intrinsics, dtype=np.float64)
    D = np.asarray(distortion, dtype=np.float64)
    d = (np.asarray(uv_px, dtype=np.float64) - K[..., 2:]) / K[..., :2]
    if model != EQUIDISTANT:
        xy, ok = _undistort_radtan(d, D)
        rays = np.concatenate((xy, np.ones_like(xy[..., :1])), axis=-1)
        rays /= np.sqrt(np.vecdot(rays, rays))[..., None]
        return rays, ok
    theta_d = np.hypot(d[..., 0], d[..., 1])
    theta, ok = _undistort_theta(theta_d, D)
    sine_ratio = np.where(theta_d > 0.0, np.sin(theta) / np.where(theta_d > 0.0, theta_d, 1.0), 1.0)
    rays = np.concatenate((d * sine_ratio[..., None], np.cos(theta)[..., None]), axis=-1)
    return rays, ok


def read_share(uv_px: FloatArray, resolution: tuple[int, int], axis: str) -> FloatArray:
    """Return when points of a rolling shutter are read, in readouts: -1/2 (first) to 1/2 (last).

    Args:
        uv_px: Pixels, shape (..., 2).
        resolution: width, height, px.
        axis: `ROWS` or `COLUMNS`; empty is rows.
    """
    k = 0 if axis == COLUMNS else 1
    return np.asarray(uv_px[..., k] / resolution[k] - 0.5)


def rays_over_image(
    intrinsics: FloatArray, distortion: FloatArray, model: str, resolution: tuple[int, int]
) -> FloatArray:
    """Return rays through the centres of eight by six patches of an image, where they exist, shape (n, 3)."""
    rays, ok = unproject(patch_centres(resolution), intrinsics, distortion, model)
    return np.asarray(rays[ok])


def patch_centres(resolution: tuple[int, int]) -> FloatArray:
    """Pixels of the centres of eight by six patches of an image, row by row, shape (48, 2)."""
    u, v = ((np.arange(n) + 0.5) * (size / n) for n, size in zip(PATCHES, resolution, strict=True))
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def patches_seen(uv_px: FloatArray, resolution: tuple[int, int]) -> BoolArray:
    """Which of these patches have pixels in them; uv_px shape (n, 2); shape (48,)."""
    columns, rows = PATCHES
    at = (uv_px * (np.array(PATCHES) / resolution)).astype(np.intp).clip(0, np.array(PATCHES) - 1)
    return np.bincount(at[:, 1] * columns + at[:, 0], minlength=columns * rows) > 0


def undistort(
    uv_px: FloatArray, intrinsics: FloatArray, distortion: FloatArray, model: str = RADTAN
) -> tuple[FloatArray, BoolArray]:
    """Return ideal normalised coordinates X/Z, Y/Z (..., 2) of pixels and where they are defined.

    As `unproject`; rays at or behind the image plane (fisheye beyond 90 degrees) are not ok.
    """
    rays, ok = unproject(uv_px, intrinsics, distortion, model)
    front = rays[..., 2] > 1e-6
    ok = ok & front
    xy: FloatArray = np.where(
        ok[..., None], rays[..., :2] / np.where(front, rays[..., 2], 1.0)[..., None], np.nan
    )
    return xy, ok


def valid_radius(distortion: FloatArray) -> FloatArray:
    """Return the normalised radius up to which radtan's radial part grows (...,), inf where for ever.

    First positive root of d/dr [r (1 + k1 r^2 + k2 r^4 + k3 r^6)] = 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3 with
    s = r^2.
    Beyond it a projected point folds back towards the image centre and means nothing.
    """
    D = np.asarray(distortion, dtype=np.float64)
    if D.shape[-1] == 5 and D[..., 4].any():
        return _valid_radius_cubic(D)
    a, b = 5.0 * D[..., 1], 3.0 * D[..., 0]
    discriminant = b * b - 4.0 * a
    with np.errstate(divide="ignore", invalid="ignore"):
        # the smallest positive root, written without cancellation and good for a = 0
        s = 2.0 / (-b + np.sqrt(discriminant))
    other: FloatArray = np.where((discriminant >= 0.0) & (s > 0.0), s, np.inf)
    out: FloatArray = np.sqrt(other)
    return out


def _valid_radius_cubic(D: FloatArray) -> FloatArray:
    out = np.empty(D.shape[:-1])
    for at in np.ndindex(out.shape):
        k1, k2, _, _, k3 = D[at]
        roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
        out[at] = np.sqrt(real.min()) if len(real) else np.inf
    return out


def _undistort_radtan(d: FloatArray, D: FloatArray) -> tuple[FloatArray, BoolArray]:
    shape = np.broadcast_shapes(d.shape[:-1], D.shape[:-1])
    limit = valid_radius(D)
    target = np.broadcast_to(d, (*shape, 2))
    # a start inside the monotonic range: from the far side Newton would land on the wrong branch
    r_d = np.hypot(target[..., 0], target[..., 1])
    start = np.minimum(1.0, 0.9 * limit / np.maximum(r_d, 1e-300))
    xy = target * start[..., None]
    error = np.full(shape, np.inf)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        beyond = r_d > _reach(D, limit)
        for _ in range(MOST_STEPS):
            x, y = xy[..., 0], xy[..., 1]
            e = distort(xy, D) - target
            a, b, c = radtan_derivative(x, y, x * x + y * y, D)
            det = a * c - b * b
            step = np.empty(xy.shape)
            step[..., 0], step[..., 1] = c * e[..., 0] - b * e[..., 1], a * e[..., 1] - b * e[..., 0]
            step /= det[..., None]
            xy = xy - step
            error = np.where(beyond, np.inf, np.abs(step).max(axis=-1))
            if not np.any((error > _NEWTON_DONE) & ~beyond):
                break
        ok = (error <= _NEWTON_DONE) & (np.hypot(xy[..., 0], xy[..., 1]) < limit) & (det > 0.0)
    return np.where(ok[..., None], xy, np.nan), ok


def _reach(D: FloatArray, limit: FloatArray) -> FloatArray:
    """Largest radius, in normalised units, at which a radtan lens may show a ray within `valid_radius`."""
    s, k3 = limit * limit, D[..., 4] if D.shape[-1] == 5 else 0.0
    tangential = 3.0 * (np.abs(D[..., 2]) + np.abs(D[..., 3])) * s
    reach = limit * (1.0 + s * (D[..., 0] + s * (D[..., 1] + s * k3))) + tangential
    return np.where(np.isfinite(limit), reach, np.inf)


def _undistort_theta(theta_d: FloatArray, D: FloatArray) -> tuple[FloatArray, BoolArray]:
    shape = np.broadcast_shapes(theta_d.shape, D.shape[:-1])
    target = np.broadcast_to(theta_d, shape)
    theta = np.minimum(target, np.pi / 2)
    k1, k2, k3, k4 = (D[..., i] for i in range(4))
    error = np.full(shape, np.inf)
    slope = np.ones(shape)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(MOST_STEPS):
            t2 = theta * theta
            value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
            slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
            step = np.clip((value - target) / slope, -0.5, 0.5)
            theta = theta - step
            error = np.abs(step)
            if not np.any(error > _NEWTON_DONE):
                break
        ok = (error <= _NEWTON_DONE) & (slope > 0.0) & (theta >= 0.0) & (theta < np.pi)
    return np.where(ok, theta, np.nan), ok
