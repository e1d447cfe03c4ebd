"""Sub-pixel saddle points: where two black and two white sectors meet, with a sigma for each.

Two steps. A quadratic surface fitted to the smoothed window gives the saddle (ROCHADE's condition
4ac - b^2 < 0) and a wide basin. Then the centre of point symmetry: four sectors between two straight edges
look the same after a half turn about their meeting point, under any perspective, any blur by a symmetric
kernel and any linear motion blur, so the centre c minimises sum w (I(c + d) - I(c - d))^2. With the edge
gradients G that is a two by two linear system, as efficient as fitting the true pattern, which need not be
known:

    delta = -M^-1 sum w G (I(d) - I(-d)) / 2,   M = sum w G G^T,   cov = s^2 M^-1 (sum w^2 G G^T) M^-1

with s the pixel noise. Motion blur flattens the gradients along its direction, so it widens the sigma.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray, Gray

Patches = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]

SMOOTHING_PX = 0.8
SMOOTHED_NOISE = 0.10
"""Variance of white pixel noise after the smoothing and an average bilinear look-up."""
GRID = 32
"""`cv2.remap` looks up on a grid of 1/32 px: centres are put on it, the rest is solved for."""
RADII = (2, 3, 4, 6)
SADDLE_STEPS = 4
NEAR_PX = 0.4
"""Saddle steps stop when all corners are this close; the symmetry steps do the rest."""
SYMMETRY_STEPS = 2
SIGMA_FLOOR_PX = 0.008
"""Errors that the residual does not show: edge curvature by distortion, interpolation."""
QUANTISATION_DN = 0.35


@dataclass(frozen=True, slots=True)
class Saddles:
    """Refined saddle points.

    Attributes:
        uv_px: Positions, shape (n, 2); the start where `ok` is False.
        sigma_px: One-sigma per axis, shape (n,); inf where `ok` is False.
        ok: A saddle was found within reach of the start.
    """

    uv_px: FloatArray
    sigma_px: FloatArray
    ok: BoolArray


class SaddleImage:
    """One picture, prepared once for any number of refinements."""

    def __init__(self, gray: Gray) -> None:
        self.shape = gray.shape
        self.smooth: npt.NDArray[np.float32] = cv2.GaussianBlur(gray.astype(np.float32), (5, 5), SMOOTHING_PX)
        self.noise_dn = pixel_noise(gray)

    def refine(
        self, uv_px: FloatArray, radius_px: FloatArray, max_shift_px: float | FloatArray = 3.0
    ) -> Saddles:
        """Refine saddle points near `uv_px`.

        Args:
            uv_px: Where to look, shape (n, 2).
            radius_px: Radius around each point within which nothing but its four sectors is seen, shape (n,).
            max_shift_px: Farthest allowed move, one or per point.
        """
        count = len(uv_px)
        found = Saddles(uv_px.copy(), np.full(count, np.inf), np.zeros(count, bool))
        bins = np.array(RADII)[np.searchsorted(RADII, np.clip(radius_px, RADII[0], None), side="right") - 1]
        limit = np.broadcast_to(np.asarray(max_shift_px, np.float64), (count,))
        for radius in RADII:
            chosen = np.flatnonzero((bins == radius) & self._inside(uv_px, radius))
            if len(chosen):
                uv, sigma, ok = self._refine_group(uv_px[chosen], radius, limit[chosen])
                found.uv_px[chosen[ok]] = uv[ok]
                found.sigma_px[chosen[ok]] = sigma[ok]
                found.ok[chosen] = ok
        return found

    def _inside(self, uv: FloatArray, radius: float) -> BoolArray:
        height, width = self.shape
        margin = radius + 1
        with np.errstate(invalid="ignore"):
            inside = (uv > margin) & (uv < np.array([width - 1, height - 1]) - margin)
        return np.asarray(inside.all(axis=1))

    def _refine_group(
        self, start: FloatArray, radius: int, limit: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        uv, ok = start.copy(), np.ones(len(start), bool)
        for _ in range(SADDLE_STEPS):
            step, saddle = _saddle_step(self._patches(uv, radius), radius)
            ok &= saddle
            uv = np.where(ok[:, None], uv + step, uv)
            ok &= (np.linalg.norm(uv - start, axis=1) <= limit) & self._inside(uv, radius)
            if not np.any(np.abs(step[ok]) > NEAR_PX):
                break
        sigma = np.full(len(start), np.inf)
        for _ in range(SYMMETRY_STEPS):
            centre = np.round(uv * GRID) / GRID
            step, sigma, solved = _symmetry_step(self._patches(centre, radius), radius, self.noise_dn)
            ok &= solved
            uv = np.where(ok[:, None], centre + step, uv)
            ok &= (np.linalg.norm(uv - start, axis=1) <= limit) & self._inside(uv, radius)
        return uv, sigma, ok

    def _patches(self, centre: FloatArray, radius: int) -> Patches:
        """Windows around `centre` with a rim for gradients, shape (n, 2 radius + 3, 2 radius + 3)."""
        span = np.arange(-radius - 1, radius + 2, dtype=np.float32)
        size, count = len(span), len(centre)
        c = (np.round(centre * GRID) / GRID).astype(np.float32)
        u = np.broadcast_to(c[:, 0, None, None] + span[None, None, :], (count, size, size))
        v = np.broadcast_to(c[:, 1, None, None] + span[None, :, None], (count, size, size))
        rows = 32000 // size
        parts = [
            cv2.remap(
                self.smooth,
                np.ascontiguousarray(u[i : i + rows]).reshape(-1, size),
                np.ascontiguousarray(v[i : i + rows]).reshape(-1, size),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            for i in range(0, count, rows)
        ]
        return np.concatenate(parts).reshape(count, size, size)


def pixel_noise(gray: Gray) -> float:
    """Noise of single pixels, grey levels: median of a second difference that flat parts and ramps cancel.

    A 3 x 3 kernel of second differences in both directions has the gain 6 for white noise.
    """
    strips = gray[:: 4 if gray.shape[0] > 200 else 1]
    kernel = np.array([1.0, -2.0, 1.0])
    along = cv2.sepFilter2D(strips.astype(np.float32), cv2.CV_32F, kernel, np.array([1.0]))
    spread = float(np.median(np.abs(along))) / 0.6745 / np.sqrt(6.0)
    return float(np.hypot(spread, QUANTISATION_DN))


@lru_cache(maxsize=16)
def _window(radius: int) -> tuple[FloatArray, npt.NDArray[np.float32]]:
    """Weights of the window, shape (size, size), and the rows of its quadratic fit, shape (5, size^2)."""
    span = np.arange(-radius, radius + 1, dtype=np.float64)
    x, y = np.meshgrid(span, span)
    r2 = x * x + y * y
    weight = np.exp(-r2 / (2 * (0.55 * radius + 0.4) ** 2)) * (r2 <= (radius + 0.5) ** 2)
    columns = [x * x, x * y, y * y, x, y, np.ones_like(x)]
    design = np.stack([c.ravel() for c in columns], axis=1)
    root = np.sqrt(weight.ravel())
    fit = np.linalg.pinv(design * root[:, None]) * root[None, :]
    return weight, fit[:5].astype(np.float32)


@lru_cache(maxsize=16)
def _half_window(radius: int) -> tuple[npt.NDArray[np.float32], float]:
    """Weight and its square for one pixel of each symmetric pair, shape (pairs, 2); sum of all weights."""
    weight, _ = _window(radius)
    half = weight.ravel()[: weight.size // 2]
    return np.stack([half, half * half], axis=1).astype(np.float32), float(weight.sum())


def _saddle_step(patches: Patches, radius: int) -> tuple[FloatArray, BoolArray]:
    """Step to the stationary point of the fitted quadratic, and whether that is a saddle."""
    _, fit = _window(radius)
    inner = patches[:, 1:-1, 1:-1].reshape(len(patches), -1)
    a, b, c, d, e = (inner @ fit.T).T.astype(np.float64)
    det = 4 * a * c - b * b
    saddle = det < -1e-6
    det = np.where(saddle, det, -1.0)
    step = np.stack([(b * e - 2 * c * d) / det, (b * d - 2 * a * e) / det], axis=1)
    length = np.linalg.norm(step, axis=1)
    shrink = np.minimum(1.0, 0.6 * radius / np.maximum(length, 1e-9))
    return step * shrink[:, None], saddle


def _symmetry_step(
    patches: Patches, radius: int, noise_dn: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Step to the centre of point symmetry, its sigma, and whether the system could be solved."""
    weights, total = _half_window(radius)
    gx = (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]).reshape(len(patches), -1)
    gy = (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]).reshape(len(patches), -1)
    level = patches[:, 1:-1, 1:-1].reshape(len(patches), -1)
    # Gradients and differences are odd about the centre: one half of the window says everything.
    half = len(weights)
    gx = (gx[:, :half] - gx[:, : -half - 1 : -1]) * np.float32(0.25)
    gy = (gy[:, :half] - gy[:, : -half - 1 : -1]) * np.float32(0.25)
    difference = level[:, :half] - level[:, : -half - 1 : -1]
    xx, xx2 = (2.0 * (gx * gx) @ weights).T.astype(np.float64)
    xy, xy2 = (2.0 * (gx * gy) @ weights).T.astype(np.float64)
    yy, yy2 = (2.0 * (gy * gy) @ weights).T.astype(np.float64)
    rx = -((gx * difference) @ weights[:, 0]).astype(np.float64)
    ry = -((gy * difference) @ weights[:, 0]).astype(np.float64)
    unlike = 2.0 * ((difference * difference) @ weights[:, 0]).astype(np.float64)
    det = xx * yy - xy * xy
    solved = det > 1e-9 * (xx + yy) ** 2 + 1e-9
    det = np.where(solved, det, 1.0)
    dx, dy = (yy * rx - xy * ry) / det, (xx * ry - xy * rx) / det
    # sum w (D + 2 G delta)^2 at the solution is sum w D^2 - 4 delta' right
    local = np.maximum(unlike - 4 * (dx * rx + dy * ry), 0.0) / (2 * total * SMOOTHED_NOISE)
    variance = np.maximum(local, noise_dn**2)
    # trace of M^-1 S M^-1 = sum over columns of M^-1 of their S-norm
    cov_x = (yy * yy * xx2 - 2 * yy * xy * xy2 + xy * xy * yy2) / det**2
    cov_y = (xy * xy * xx2 - 2 * xx * xy * xy2 + xx * xx * yy2) / det**2
    sigma = np.sqrt(variance * (cov_x + cov_y) / 2 + SIGMA_FLOOR_PX**2)
    step = np.stack([dx, dy], axis=1)
    step *= np.minimum(1.0, 1.0 / np.maximum(np.hypot(dx, dy), 1e-9))[:, None]
    return step, sigma, solved
