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

from vical_daemon.vision.detection import FloatArray, Gray, sample

Patches = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]

AROUND_PX = 40.0
"""Of the places a board is expected at: search, windows, and what an expectation is off by."""
SMOOTHING_PX = 0.8  # sigma of the Gaussian before derivatives are taken: lenses blur by about as much
SMOOTHED_NOISE = 0.10
"""Variance of white pixel noise after the smoothing and an average bilinear look-up."""
GRID = 32
"""`cv2.remap` looks up on a grid of 1/32 px: centres are put on it, the rest is solved for."""
RADII = (2, 3, 4, 6)  # px of the windows: the largest that fits into the squares is taken
_MARGIN_PX = np.array(RADII) + 1.0
_KERNEL = cv2.getGaussianKernel(5, SMOOTHING_PX, cv2.CV_32F)
SADDLE_STEPS = 4  # at most, of Newton
NEAR_PX = 0.4
"""A corner's saddle steps stop when it is this close; the symmetry steps do the rest."""
SYMMETRY_STEPS = 2  # likewise
STILL_PX = 0.03
"""A symmetry step shorter than this needs no second one; the error (RMS) is unchanged to 0.2 %."""
NOISE_SAMPLES = 8000
"""Pixels from which the noise is estimated: to about 1.5 %."""
SIGMA_FLOOR_PX = 0.008
"""Errors that the residual does not show: edge curvature by distortion, interpolation."""
QUANTISATION_DN = 0.35  # grey levels: 0.29 of rounding, and of what a camera's processing adds


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
    """One picture, or the part of it with the board, prepared once for any number of refinements.

    Args:
        gray: The picture.
        around_px: Places in it, shape (n, 2), finite; only the part around them is prepared, and corners are
            found only there. None: the whole picture.

    Attributes:
        shape: Height and width of the picture, px.
        smooth: The part, smoothed.
        noise_dn: Noise of single pixels, grey levels.
    """

    def __init__(self, gray: Gray, around_px: FloatArray | None = None) -> None:
        self.shape = gray.shape
        rows, columns = slice(0, gray.shape[0]), slice(0, gray.shape[1])
        if around_px is not None:
            (left, top), (right, bottom) = around_px.min(axis=0).tolist(), around_px.max(axis=0).tolist()
            rows, columns = _around(top, bottom, rows.stop), _around(left, right, columns.stop)
        part = gray[rows, columns]
        self._low = np.array([columns.start, rows.start], np.float64)  # first pixel of the part, u and v
        self._high = self._low + part.shape[::-1] - 1.0
        # From uint8 straight to float: a fifth of the time of a conversion and cv2.GaussianBlur.
        self.smooth: Patches = np.asarray(
            cv2.sepFilter2D(part, cv2.CV_32F, _KERNEL, _KERNEL, borderType=cv2.BORDER_REFLECT_101), np.float32
        )
        self.noise_dn = pixel_noise(gray)

    def levels(self, uv_px: FloatArray) -> FloatArray:
        """Grey levels of the smoothed picture at (finite) pixels, shape (..., 2) -> (...,)."""
        return sample(self.smooth, uv_px - self._low)

    def refine(
        self, uv_px: FloatArray, radius_px: FloatArray, max_shift_px: float | FloatArray = 3.0
    ) -> Saddles:
        """Refine saddle points near `uv_px`, all in one batch.

        Args:
            uv_px: Where to look, shape (n, 2).
            radius_px: Radius around each point within which nothing but its four sectors is seen, shape (n,).
            max_shift_px: Farthest allowed move, one or per point.
        """
        count = len(uv_px)
        found = Saddles(uv_px.copy(), np.full(count, np.inf), np.zeros(count, bool))
        kind = np.searchsorted(RADII, np.maximum(radius_px, RADII[0]), side="right") - 1
        limit = np.broadcast_to(np.asarray(max_shift_px, np.float64), (count,))
        chosen = np.flatnonzero(self._inside(uv_px, kind))
        if len(chosen):
            uv, sigma, ok = self._refine(uv_px[chosen], kind[chosen], limit[chosen])
            kept = chosen[ok]
            found.uv_px[kept], found.sigma_px[kept], found.ok[kept] = uv[ok], sigma[ok], True
        return found

    def _inside(self, uv: FloatArray, kind: npt.NDArray[np.intp]) -> BoolArray:
        margin = _MARGIN_PX[kind]
        (left, top), (right, bottom) = self._low.tolist(), self._high.tolist()
        u, v = uv[:, 0], uv[:, 1]
        across = (u > left + margin) & (u < right - margin)
        return np.asarray(across & (v > top + margin) & (v < bottom - margin))

    def _refine(
        self, start: FloatArray, kind: npt.NDArray[np.intp], limit: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Step all points, then only those whose last step was long; a point out of reach is given up."""
        uv, ok, sigma = start.copy(), np.ones(len(start), bool), np.full(len(start), np.inf)
        windows = _windows(int(kind.max()))
        moving = np.arange(len(start))
        for method, steps, near_px in (
            ("saddle", SADDLE_STEPS, NEAR_PX),
            ("symmetry", SYMMETRY_STEPS, STILL_PX),
        ):
            moving = np.flatnonzero(ok)
            for _ in range(steps):
                if not len(moving):
                    break
                patches, centre = self._patches(uv[moving], windows.radius)
                if method == "saddle":
                    step, fine = _saddle_step(patches, windows, kind[moving])
                else:
                    step, sigma[moving], fine = _symmetry_step(patches, windows, kind[moving], self.noise_dn)
                moved = centre + step
                fine &= _length(moved - start[moving]) <= limit[moving]
                fine &= self._inside(moved, kind[moving])
                ok[moving] = fine
                uv[moving[fine]] = moved[fine]
                moving = moving[fine & (_length(step) > near_px)]
        return uv, sigma, ok

    def _patches(self, uv: FloatArray, radius: int) -> tuple[Patches, FloatArray]:
        """Windows with a rim for gradients, shape (n, 2 radius + 3, 2 radius + 3), and their centres."""
        right, down = _offsets(radius)
        centre = np.round(uv * GRID) / GRID
        at = (centre - self._low).astype(np.float32)
        flat = cv2.remap(
            self.smooth,
            at[:, :1] + right,
            at[:, 1:] + down,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(flat).reshape(len(uv), 2 * radius + 3, 2 * radius + 3), centre


def _around(low: float, high: float, size: int) -> slice:
    """Pixels of one side of a picture that lie around places between two bounds, px; at least one."""
    first, last = (int(min(max(x, 0.0), size - 1.0)) for x in (low - AROUND_PX, high + AROUND_PX))
    return slice(first, last + 1)


def pixel_noise(gray: Gray) -> float:
    """Noise of single pixels, grey levels: median of a second difference that flat parts and ramps cancel.

    The kernel 1 -2 1 along rows amplifies the standard deviation of white noise by the root of 6. About
    `NOISE_SAMPLES` evenly spread pixels take part.
    """
    every = max(1, round((gray.size / NOISE_SAMPLES) ** 0.5))
    left, middle, right = (
        gray[::every, k : gray.shape[1] - 2 + k : every].astype(np.int16) for k in range(3)
    )
    up_to = np.cumsum(np.bincount(np.abs(left - 2 * middle + right).ravel()))  # samples of at most each size
    # The median of whole numbers, interpolated within its step.
    half = left.size / 2
    level = int(np.searchsorted(up_to, int(half), side="right"))
    below = int(up_to[level - 1]) if level else 0
    share = (half - below) / max(int(up_to[level]) - below, 1)
    spread = max(level - 0.5 + share, 0.0)
    return float(np.hypot(spread / 0.6745 / np.sqrt(6.0), QUANTISATION_DN))


@dataclass(frozen=True)
class _Windows:
    """Weights of the windows of several radii, all laid out in the largest.

    Attributes:
        radius: Of the largest, px.
        fit: Rows of the quadratic fits, shape ((2 radius + 1)^2, 5 kinds).
        half: Weight and squared weight of one pixel of each symmetric pair, the upper half with the centre
            row, shape ((radius + 1) (2 radius + 1), 2 kinds).
        total: Sum of all weights of each kind.
    """

    radius: int
    fit: Patches
    half: Patches
    total: FloatArray


@lru_cache(maxsize=8)
def _windows(largest: int) -> _Windows:
    """Windows of the first `largest` + 1 of `RADII`."""
    radius = RADII[largest]
    span = np.arange(-radius, radius + 1, dtype=np.float64)
    x, y = np.meshgrid(span, span)
    r2 = x * x + y * y
    first_of_pair = ((y < 0) | ((y == 0) & (x < 0)))[: radius + 1]
    fits, halves, totals = [], [], []
    design = np.stack([c.ravel() for c in (x * x, x * y, y * y, x, y, np.ones_like(x))], axis=1)
    for r in RADII[: largest + 1]:
        weight = np.exp(-r2 / (2 * (0.55 * r + 0.4) ** 2)) * (r2 <= (r + 0.5) ** 2)
        root = np.sqrt(weight.ravel())
        fits.append((np.linalg.pinv(design * root[:, None]) * root)[:5].T)
        halves.append((weight[: radius + 1] * first_of_pair).ravel())
        totals.append(weight.sum())
    half = np.stack(halves + [h * h for h in halves], axis=1)
    return _Windows(
        radius, np.concatenate(fits, axis=1).astype(np.float32), half.astype(np.float32), np.array(totals)
    )


@lru_cache(maxsize=8)
def _offsets(radius: int) -> tuple[Patches, Patches]:
    """Where the pixels of a window with its rim lie about its centre: u and v, shape (1, size^2) each."""
    span = np.arange(-radius - 1, radius + 2, dtype=np.float32)
    return np.tile(span, len(span))[None], np.repeat(span, len(span))[None]


def _length(vector: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(vector[:, 0], vector[:, 1]))


def _saddle_step(
    patches: Patches, windows: _Windows, kind: npt.NDArray[np.intp]
) -> tuple[FloatArray, BoolArray]:
    """Step to the stationary point of the fitted quadratic, and whether that is a saddle."""
    count = len(patches)
    inner = patches[:, 1:-1, 1:-1].reshape(count, -1)
    fitted = (inner @ windows.fit).reshape(count, -1, 5)[np.arange(count), kind]
    a, b, c, d, e = fitted.T.astype(np.float64)
    det = 4 * a * c - b * b
    saddle = det < -1e-6
    det = np.where(saddle, det, -1.0)
    step = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], axis=1) / det[:, None]
    radius = np.array(RADII)[kind]
    shrink = np.minimum(1.0, 0.6 * radius / np.maximum(_length(step), 1e-9))
    return step * shrink[:, None], saddle


def _symmetry_step(
    patches: Patches, windows: _Windows, kind: npt.NDArray[np.intp], noise_dn: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Step to the centre of point symmetry, its sigma, and whether the system could be solved."""
    # Gradients and differences are odd about the centre: the upper half of the window says everything.
    r = windows.radius
    turned = patches[:, ::-1, ::-1]
    even = patches[:, : r + 3] + turned[:, : r + 3]
    terms = np.empty((3, len(patches), r + 1, 2 * r + 1), np.float32)
    gx, gy, odd = terms
    np.subtract(even[:, 1 : r + 2, 2:], even[:, 1 : r + 2, :-2], out=gx)
    np.subtract(even[:, 2 : r + 3, 1:-1], even[:, : r + 1, 1:-1], out=gy)
    np.subtract(patches[:, 1 : r + 2, 1:-1], turned[:, 1 : r + 2, 1:-1], out=odd)
    gx *= np.float32(0.25)
    gy *= np.float32(0.25)
    products = np.empty((6, *gx.shape), np.float32)
    np.multiply(gx, terms, out=products[:3])
    np.multiply(gy, terms[1:], out=products[3:5])
    np.multiply(odd, odd, out=products[5])
    sums = products.reshape(6, len(patches), -1) @ windows.half
    kinds, row = len(windows.total), np.arange(len(patches))
    xx, xy, rx, yy, ry, unlike = 2.0 * sums[:, row, kind].astype(np.float64)
    xx2, xy2, _, yy2, _, _ = 2.0 * sums[:, row, kinds + kind].astype(np.float64)
    rx, ry = -0.5 * rx, -0.5 * ry
    det = xx * yy - xy * xy
    solved = det > 1e-9 * (xx + yy) ** 2 + 1e-9
    det = np.where(solved, det, 1.0)
    dx, dy = (yy * rx - xy * ry) / det, (xx * ry - xy * rx) / det
    # sum w (D + 2 G delta)^2 at the solution is sum w D^2 - 4 delta' right
    local = np.maximum(unlike - 4 * (dx * rx + dy * ry), 0.0) / (2 * windows.total[kind] * SMOOTHED_NOISE)
    variance = np.maximum(local, noise_dn**2)
    # trace of M^-1 S M^-1 = sum over columns of M^-1 of their S-norm
    trace = (xx2 * (yy * yy + xy * xy) + yy2 * (xx * xx + xy * xy) - 2 * xy2 * xy * (xx + yy)) / det**2
    sigma = np.sqrt(variance * trace / 2 + SIGMA_FLOOR_PX**2)
    step = np.stack([dx, dy], axis=1)
    return step * np.minimum(1.0, 1.0 / np.maximum(_length(step), 1e-9))[:, None], sigma, solved
