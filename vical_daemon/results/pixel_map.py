"""What a difference of two calibrations means: how far apart they project a point, over the image.

A point fixed to the imu is seen by both. Where it lies is chosen by the pixel of camera A and a distance. Two
maps: of the difference as it is, and of the least that the sigmas allow. [docs/math/verify.md, eq. (6)]
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import project, project_jacobians
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.camera_rays import rays_over_image, unproject
from vical_daemon.estimation.significance import chi_square_limit
from vical_daemon.results.compare import FALSE_ALARM
from vical_daemon.results.difference import Difference
from vical_daemon.results.known import LENS, KnownCamera

GRID = (9, 7)  # columns and rows, corners of the image included
_STEP = 1e-3  # of a sigma: for derivatives
_BISECTIONS = 60


@dataclass(frozen=True, slots=True)
class PixelMap:
    """How far apart two calibrations project points at one distance.

    Attributes:
        distance_m: From camera A.
        uv_px: Where camera A sees them, shape (rows, columns, 2).
        apart_px: How far from there camera B sees them, shape (rows, columns); NaN: not at all.
        least_px: The same for the smallest difference that sigmas allow.
    """

    distance_m: float
    uv_px: FloatArray
    apart_px: FloatArray
    least_px: FloatArray


def pixel_map(difference: Difference, distance_m: float) -> PixelMap | None:
    """Return the map of one distance; None where lens or image size are not known."""
    a, b = difference.a, difference.b
    size = a.resolution or b.resolution
    if a.lens is None or b.lens is None or size is None:
        return None
    u, v = (np.linspace(0.0, n - 1.0, k) for n, k in zip(size, GRID, strict=True))
    uv = np.stack(np.meshgrid(u, v), axis=-1)
    rays, seen = unproject(uv, a.lens[:4], a.lens[4:], a.model)
    p_imu = distance_m * rays @ a.R_imu_cam.T + a.p_imu_cam
    apart = _seen(b, p_imu) - uv
    least = _least(difference, p_imu)
    shape = uv.shape[:2]
    apart_px = np.where(seen, np.linalg.norm(apart, axis=-1), np.nan)
    least_px = np.where(seen, np.linalg.norm(least.reshape(*shape, 2), axis=-1), np.nan)
    return PixelMap(distance_m, uv, apart_px, least_px)


def _seen(camera: KnownCamera, p_imu: FloatArray) -> FloatArray:
    assert camera.lens is not None
    p_cam = (p_imu - camera.p_imu_cam) @ camera.R_imu_cam
    return project(p_cam, camera.lens[:4], camera.lens[4:], camera.model)


def _least(difference: Difference, p_imu: FloatArray) -> FloatArray:
    """Displacements (px) of the smallest change that both calibrations allow.

    Of all changes x with (x - d)' S^-1 (x - d) <= q, the one with the smallest |J x|^2; q is the bound of the
    test, so that the least difference is zero exactly where the verdict is `same`.
    """
    base = difference.a if difference.model == difference.a.model else difference.b
    S, d = difference.covariance, difference.d
    scale = np.sqrt(np.diag(S))
    J = np.stack([_moved(base, p_imu, k, _STEP * scale[k]) for k in range(len(d))], axis=-1) / _STEP
    J = np.nan_to_num(J)
    inverse = np.linalg.inv(S / np.outer(scale, scale) + 1e-12 * np.eye(len(d)))
    e, bound = d / scale, chi_square_limit(len(d), FALSE_ALARM)
    if e @ inverse @ e <= bound:
        return np.zeros(len(J))
    H = J.T @ J
    low, high = -20.0, 20.0  # of log10 of the weight of the pixels
    x = e
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        x = np.linalg.solve(inverse + 10.0**middle * H, inverse @ e)
        if (x - e) @ inverse @ (x - e) <= bound:
            low = middle
        else:
            high = middle
    return np.asarray(J @ x)


def _moved(camera: KnownCamera, p_imu: FloatArray, k: int, step: float) -> FloatArray:
    """How far points move in the image when one error of a camera takes a step, px, shape (2 n,)."""
    assert camera.lens is not None
    e = np.zeros(7 + len(camera.lens))
    e[k] = step
    lens = camera.lens + e[7:]
    moved = replace(
        camera, p_imu_cam=camera.p_imu_cam + e[:3], R_imu_cam=camera.R_imu_cam @ so3.exp(e[3:6]), lens=lens
    )
    return np.asarray((_seen(moved, p_imu) - _seen(camera, p_imu)).ravel())


def lens_displacement_px(camera: KnownCamera, moved: FloatArray, P: FloatArray) -> tuple[float, float]:
    """How far a lens that has changed projects points from where it did, RMS over the image, and its sigma.

    Args:
        camera: With its lens.
        moved: Errors of the lens, shape (n,).
        P: Their covariance, shape (n, n).
    """
    J = _lens_slopes(camera)[:, : len(moved)]
    apart = J @ moved
    rms = float(np.linalg.norm(apart))
    slope = J.T @ apart / max(rms, 1e-300)
    return rms, float(np.sqrt(slope @ P @ slope))


def lens_error_px(camera: KnownCamera) -> float:
    """How far a lens is expected to project points from where they appear, by its covariance, RMS, px."""
    J = _lens_slopes(camera)
    return float(np.sqrt(np.einsum("ij,jk,ik->", J, camera.covariance[LENS, LENS], J)))


def _lens_slopes(camera: KnownCamera) -> FloatArray:
    """Derivatives of n pixels over the image by the lens, over the root of n: squares are means."""
    lens = camera.lens
    assert lens is not None
    size = camera.resolution or (round(2.0 * lens[2]), round(2.0 * lens[3]))
    rays = rays_over_image(lens[:4], lens[4:], camera.model, size)
    J = project_jacobians(rays, lens[:4], lens[4:], camera.model)[2].reshape(2 * len(rays), -1)
    return np.asarray(J / np.sqrt(len(rays)))
