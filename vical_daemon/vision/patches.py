"""Alignment of small windows with how they looked when first seen, so that errors do not add up along tracks.

Inverse compositional Lucas-Kanade by affine maps (Baker and Matthews 2004), batched over features. Pixel x of
a template T is looked for at uv + W x. With J the derivatives of T by a move d and a change of shape A,
and the window I at the present place,

    [d, A] = (J^T J + P)^-1 J^T (I - T),    W <- W (1 - A),    uv <- uv - W d.

Mean and contrast of I are matched to T, which vignetting and exposure change, and J is without what they
explain. P keeps the shape near what is foretold, see `SHAPE_PX`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray
from vical_daemon.vision.saddle import SMOOTHING_PX

BoolArray = npt.NDArray[np.bool_]
Float32 = npt.NDArray[np.float32]

RADIUS = 6  # px of the window around a feature
SIZE = 2 * RADIUS + 1
ITERATIONS = 2  # Gauss-Newton steps, from a place that is predicted to a pixel or so
SHAPE_PX = 2.0
"""Standard deviation of a feature's place over that of its W in one step, px: what a window tells of a place,
0.04 px, and 2 % by which the flow around a feature in the next image differs from the mean flow."""
_ALIKE_PX = 4.0 * math.pi * SMOOTHING_PX**2  # pixels over which smoothing makes the noise of a picture alike
_FARTHEST_PX = 0.7  # largest step: farther from it the picture is not linear
_MOST_BENT = 0.1  # largest change of shape in a step
_NO_CONTRAST = 1e-3  # squared grey levels, keeps the sums of a plain window invertible


@dataclass(frozen=True)
class Templates:
    """Windows around features as they were first seen.

    Attributes:
        values: Grey levels without their mean, shape (n, SIZE^2).
        slopes: J^T, without mean and contrast, shape (n, 6, SIZE^2).
        inverse: (J^T J + P)^-1, shape (n, 6, 6).
    """

    values: Float32
    slopes: Float32
    inverse: FloatArray

    @classmethod
    def cut(cls, smooth: Float32, uv_px: FloatArray) -> Templates:
        """Cut windows out of a slightly smoothed picture."""
        count = len(uv_px)
        windows = sample_windows(smooth, uv_px, RADIUS + 1)
        half = np.float32(0.5)
        gx = ((windows[:, 1:-1, 2:] - windows[:, 1:-1, :-2]) * half).reshape(count, SIZE**2)
        gy = ((windows[:, 2:, 1:-1] - windows[:, :-2, 1:-1]) * half).reshape(count, SIZE**2)
        values = windows[:, 1:-1, 1:-1].reshape(count, SIZE**2)
        values = values - values.mean(axis=1, keepdims=True)
        x, y = _offsets(RADIUS)
        slopes = np.stack([gx, gy, gx * x, gx * y, gy * x, gy * y], axis=1)
        slopes -= slopes.mean(axis=2, keepdims=True)
        contrast = (slopes @ values[:, :, None]) / (_dot(values, values) + _NO_CONTRAST)[:, None, None]
        slopes -= contrast * values[:, None, :]
        normal = (slopes @ slopes.transpose(0, 2, 1)).astype(np.float64)
        diagonal = np.arange(6)
        normal[:, diagonal, diagonal] += _NO_CONTRAST
        place = (normal[:, 0, 0] + normal[:, 1, 1]) / 2
        normal[:, diagonal[2:], diagonal[2:]] += SHAPE_PX**2 * place[:, None]
        return cls(values, slopes, np.asarray(np.linalg.inv(normal), np.float64))

    def take(self, index: npt.NDArray[np.intp] | BoolArray) -> Templates:
        """Some of them."""
        return Templates(self.values[index], self.slopes[index], self.inverse[index])

    def joined(self, other: Templates) -> Templates:
        """These and others."""
        pairs = [(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)]
        return Templates(*[np.concatenate(pair) for pair in pairs])

    def align(
        self, smooth: Float32, uv_px: FloatArray, warp: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Find the templates near `uv_px`.

        Args:
            smooth: Slightly smoothed picture.
            uv_px: Where to look, shape (n, 2).
            warp: W of each feature as foretold, shape (n, 2, 2).

        Returns:
            Places, shape (n, 2); W, shape (n, 2, 2); unlikeness, 0 equal to 1 unrelated, shape (n,); sigma
            per axis, px, (n,).
        """
        uv, W = uv_px, warp
        strength = np.linalg.norm(self.values, axis=1) + 1e-6
        error = np.zeros_like(self.values)
        for _ in range(ITERATIONS):
            window = _look(smooth, uv, window_places(RADIUS, W))
            window -= window.mean(axis=1, keepdims=True)
            power = _dot(window, window) + 1e-6
            match = _dot(window, self.values)
            error = window * np.clip(match / power, 0.3, 3.0)[:, None] - self.values
            step = self.inverse @ (self.slopes @ error[:, :, None]).astype(np.float64)
            W = W @ (np.eye(2) - _at_most(step[:, 2:, 0], _MOST_BENT).reshape(-1, 2, 2))
            uv = uv - _at_most((W @ step[:, :2])[:, :, 0], _FARTHEST_PX)
        rest = np.linalg.norm(error, axis=1)
        spread = _ALIKE_PX * rest**2 / SIZE**2 * (self.inverse[:, 0, 0] + self.inverse[:, 1, 1]) / 2
        return uv, W, np.asarray(rest / strength, np.float64), np.sqrt(spread)


def no_templates() -> Templates:
    """An empty set."""
    return Templates(
        np.zeros((0, SIZE**2), np.float32), np.zeros((0, 6, SIZE**2), np.float32), np.zeros((0, 6, 6))
    )


def window_places(radius: int, warp: FloatArray) -> tuple[Float32, Float32]:
    """Where pixels of windows lie about their centres, mapped by `warp` (n, 2, 2): u, v, (n, edge^2) each."""
    right, down = _offsets(radius)
    W = warp.astype(np.float32)[:, :, :, None]
    u, v = W[:, 0, 0] * right + W[:, 0, 1] * down, W[:, 1, 0] * right + W[:, 1, 1] * down
    return u, v


def sample_windows(smooth: Float32, centre_px: FloatArray, radius: int) -> Float32:
    """Windows of edge 2 radius + 1 around pixels, shape (n, edge, edge)."""
    edge, count = 2 * radius + 1, len(centre_px)
    upright = np.broadcast_to(np.eye(2), (count, 2, 2))
    return _look(smooth, centre_px, window_places(radius, upright)).reshape(count, edge, edge)


@cache
def _offsets(radius: int) -> tuple[Float32, Float32]:
    """Pixels of a window about its centre: right and down, row by row, shape (edge^2,) each."""
    span = np.arange(-radius, radius + 1, dtype=np.float32)
    return np.tile(span, len(span)), np.repeat(span, len(span))


def _at_most(steps: FloatArray, length: float) -> FloatArray:
    """Steps, shape (n, k), none of them longer than `length`."""
    size = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, length / np.maximum(size, 1e-9)))


def _look(smooth: Float32, centre_px: FloatArray, places: tuple[Float32, Float32]) -> Float32:
    """Grey levels of windows, bilinear, (n, edge^2); u and v apart, as numpy is slow on pairs."""
    if not len(centre_px):
        return np.zeros(places[0].shape, np.float32)
    centre = centre_px.astype(np.float32)
    u, v = places[0] + centre[:, :1], places[1] + centre[:, 1:]
    return np.asarray(cv2.remap(smooth, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _dot(a: Float32, b: Float32) -> Float32:
    """Row by row."""
    return np.asarray(np.einsum("ni,ni->n", a, b))
