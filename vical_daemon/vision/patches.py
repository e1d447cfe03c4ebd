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

RADIUS = 6
SIZE = 2 * RADIUS + 1
ITERATIONS = 3


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
        for _ in range(ITERATIONS):
            window = sample_windows(smooth, uv, RADIUS, warp).reshape(len(uv), SIZE**2)
            window = window - window.mean(axis=1, keepdims=True)
            power = np.sum(window * window, axis=1) + 1e-6
            match = np.sum(window * self.values, axis=1)
            error = window * np.clip(match / power, 0.3, 3.0)[:, None] - self.values
            right = np.stack([np.sum(self.gx * error, axis=1), np.sum(self.gy * error, axis=1)], axis=1)
            step = np.einsum("nij,njk,nk->ni", warp, self.inverse, right.astype(np.float64))
            length = np.linalg.norm(step, axis=1, keepdims=True)
            uv = uv - step * np.minimum(1.0, 0.7 / np.maximum(length, 1e-9))
        rest = np.linalg.norm(error, axis=1)
        spread = rest**2 / SIZE**2 * np.trace(self.inverse, axis1=1, axis2=2) / 2
        return uv, np.asarray(rest / strength, np.float64), np.sqrt(spread)


def no_templates() -> Templates:
    """An empty set."""
    empty = np.zeros((0, SIZE**2), np.float32)
    return Templates(empty, empty, empty, np.zeros((0, 2, 2)))


def sample_windows(
    smooth: Float32, centre_px: FloatArray, radius: int, warp: FloatArray | None = None
) -> Float32:
    """Windows of edge 2 radius + 1 around pixels, turned by `warp`, shape (n, edge, edge)."""
    span = np.arange(-radius, radius + 1, dtype=np.float32)
    edge, count = len(span), len(centre_px)
    if not count:
        return np.zeros((0, edge, edge), np.float32)
    centre = centre_px.astype(np.float32)
    W = np.broadcast_to(np.eye(2), (count, 2, 2)) if warp is None else warp
    along, across = W.astype(np.float32)[:, :, 0], W.astype(np.float32)[:, :, 1]
    offset = (
        along[:, None, None, :] * span[None, None, :, None]
        + across[:, None, None, :] * span[None, :, None, None]
    )
    places = centre[:, None, None, :] + offset
    rows = 32000 // edge
    parts = [
        cv2.remap(
            smooth,
            places[i : i + rows].reshape(-1, edge, 2),
            None,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for i in range(0, count, rows)
    ]
    return np.concatenate(parts).reshape(count, edge, edge)
