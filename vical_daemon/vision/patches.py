"""Alignment of small windows with how they looked when first seen, so that errors do not add up along tracks.

Inverse compositional Lucas-Kanade by translation, batched over features: with template T, its gradient G and
the window I at the current place, delta = M^-1 sum G (I - T), M = sum G G^T; the feature moves by -W delta.
W, the linear part of the flow since the template was cut, turns and scales the window with the picture.
Both windows have their means taken off and I its contrast matched, which vignetting and exposure change.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray

BoolArray = npt.NDArray[np.bool_]
Float32 = npt.NDArray[np.float32]

RADIUS = 6  # px of the window around a feature
SIZE = 2 * RADIUS + 1
ITERATIONS = 3  # Gauss-Newton steps, from a place that is predicted to a pixel or so


@dataclass(frozen=True)
class Templates:
    """Windows around features as they were first seen.

    Attributes:
        values: Grey levels without their mean, shape (n, SIZE^2).
        gx: Gradient along u, shape (n, SIZE^2).
        gy: Gradient along v.
        inverse: M^-1, shape (n, 2, 2).
    """

    values: Float32
    gx: Float32
    gy: Float32
    inverse: FloatArray

    @classmethod
    def cut(cls, smooth: Float32, uv_px: FloatArray) -> Templates:
        """Cut windows out of a slightly smoothed picture."""
        windows = sample_windows(smooth, uv_px, RADIUS + 1)
        gx = ((windows[:, 1:-1, 2:] - windows[:, 1:-1, :-2]) * np.float32(0.5)).reshape(len(uv_px), SIZE**2)
        gy = ((windows[:, 2:, 1:-1] - windows[:, :-2, 1:-1]) * np.float32(0.5)).reshape(len(uv_px), SIZE**2)
        inner = windows[:, 1:-1, 1:-1].reshape(len(uv_px), SIZE**2)
        xx, yy = np.sum(gx * gx, axis=1) + 1e-3, np.sum(gy * gy, axis=1) + 1e-3
        xy = np.sum(gx * gy, axis=1)
        det = np.maximum((xx * yy - xy * xy).astype(np.float64), 1e-6)
        inverse = np.stack([np.stack([yy, -xy], -1), np.stack([-xy, xx], -1)], -2) / det[:, None, None]
        return cls(inner - inner.mean(axis=1, keepdims=True), gx, gy, inverse)

    def take(self, index: npt.NDArray[np.intp] | BoolArray) -> Templates:
        """Some of them."""
        return Templates(self.values[index], self.gx[index], self.gy[index], self.inverse[index])

    def joined(self, other: Templates) -> Templates:
        """These and others."""
        return Templates(
            np.concatenate([self.values, other.values]),
            np.concatenate([self.gx, other.gx]),
            np.concatenate([self.gy, other.gy]),
            np.concatenate([self.inverse, other.inverse]),
        )

    def align(
        self, smooth: Float32, uv_px: FloatArray, warp: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Find the templates near `uv_px`.

        Args:
            smooth: Slightly smoothed picture.
            uv_px: Where to look, shape (n, 2).
            warp: W of each feature, shape (n, 2, 2).

        Returns:
            Places, shape (n, 2); unlikeness, 0 equal to 1 unrelated, shape (n,); sigma per axis, px, (n,).
        """
        uv = uv_px.copy()
        strength = np.linalg.norm(self.values, axis=1) + 1e-6
        error = np.zeros_like(self.values)
        places, gain = window_places(RADIUS, warp), warp @ self.inverse
        for _ in range(ITERATIONS):
            window = _look(smooth, uv, places)
            window -= window.mean(axis=1, keepdims=True)
            power = _dot(window, window) + 1e-6
            match = _dot(window, self.values)
            error = window * np.clip(match / power, 0.3, 3.0)[:, None] - self.values
            right = np.stack([_dot(self.gx, error), _dot(self.gy, error)], axis=1)
            step = (gain @ right[:, :, None].astype(np.float64))[:, :, 0]
            length = np.linalg.norm(step, axis=1, keepdims=True)
            uv = uv - step * np.minimum(1.0, 0.7 / np.maximum(length, 1e-9))
        rest = np.linalg.norm(error, axis=1)
        spread = rest**2 / SIZE**2 * np.trace(self.inverse, axis1=1, axis2=2) / 2
        return uv, np.asarray(rest / strength, np.float64), np.sqrt(spread)


def no_templates() -> Templates:
    """An empty set."""
    empty = np.zeros((0, SIZE**2), np.float32)
    return Templates(empty, empty, empty, np.zeros((0, 2, 2)))


def window_places(radius: int, warp: FloatArray) -> tuple[Float32, Float32]:
    """Where pixels of windows lie about their centres, turned by `warp` (n, 2, 2): u, v, (n, edge^2) each."""
    span = np.arange(-radius, radius + 1, dtype=np.float32)
    right, down = np.tile(span, len(span)), np.repeat(span, len(span))
    W = warp.astype(np.float32)[:, :, :, None]
    u, v = W[:, 0, 0] * right + W[:, 0, 1] * down, W[:, 1, 0] * right + W[:, 1, 1] * down
    return u, v


def sample_windows(smooth: Float32, centre_px: FloatArray, radius: int) -> Float32:
    """Windows of edge 2 radius + 1 around pixels, shape (n, edge, edge)."""
    edge, count = 2 * radius + 1, len(centre_px)
    upright = np.broadcast_to(np.eye(2), (count, 2, 2))
    return _look(smooth, centre_px, window_places(radius, upright)).reshape(count, edge, edge)


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
