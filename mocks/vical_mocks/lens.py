"""The simulated lens: pinhole with radial-tangential or equidistant distortion, both directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_mocks.rotations import FloatArray


@dataclass(frozen=True)
class Lens:
    """A camera's intrinsics.

    Attributes:
        intrinsics: fx, fy, cx, cy, px (pixel centres at integers).
        distortion: 4 coefficients: radtan k1 k2 p1 p2 or equidistant k1 k2 k3 k4.
        resolution: Width, height, px.
        model: "radtan" or "equidistant".
        sixth_power: One more coefficient, of the sixth power of the radius (k3 of `plumb_bob`); radtan only.
    """

    intrinsics: tuple[float, float, float, float] = (520.0, 520.0, 320.0, 240.0)
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    resolution: tuple[int, int] = (640, 480)
    model: str = "radtan"
    sixth_power: float = 0.0

    def project(self, p_cam: npt.ArrayLike) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Project points of the camera frame.

        Args:
            p_cam: Points, m, shape (..., 3).

        Returns:
            uv_px of shape (..., 2), and whether each point is in front of the lens and inside the image.
            Points outside have meaningless pixels.
        """
        p = np.asarray(p_cam, np.float64)
        in_front = p[..., 2] > 1e-3
        z = np.where(in_front, p[..., 2], 1.0)
        xy = p[..., :2] / z[..., None]
        fx, fy, cx, cy = self.intrinsics
        uv = self._distort(xy) * np.array([fx, fy]) + np.array([cx, cy])
        width, height = self.resolution
        near = np.sum(xy * xy, axis=-1) < self._fold_squared() if self.model == "radtan" else in_front
        inside = (
            (uv[..., 0] >= 0) & (uv[..., 0] <= width - 1) & (uv[..., 1] >= 0) & (uv[..., 1] <= height - 1)
        )
        return uv, in_front & near & inside

    def unproject(self, uv_px: npt.ArrayLike) -> FloatArray:
        """Rays of pixels: x/z, y/z, 1 in the camera frame, shape (..., 3) (Newton on the distortion)."""
        fx, fy, cx, cy = self.intrinsics
        target = (np.asarray(uv_px, np.float64) - np.array([cx, cy])) / np.array([fx, fy])
        xy = target.copy()
        step_x, step_y = np.array([1e-6, 0.0]), np.array([0.0, 1e-6])
        for _ in range(12):
            error = self._distort(xy) - target
            dx = (self._distort(xy + step_x) - self._distort(xy - step_x)) / 2e-6
            dy = (self._distort(xy + step_y) - self._distort(xy - step_y)) / 2e-6
            det = dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0]
            xy = xy - np.stack(
                [
                    (dy[..., 1] * error[..., 0] - dy[..., 0] * error[..., 1]) / det,
                    (dx[..., 0] * error[..., 1] - dx[..., 1] * error[..., 0]) / det,
                ],
                axis=-1,
            )
        return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)

    def _fold_squared(self) -> float:
        """Square of the radius at which the polynomial turns back; no real lens shows what is beyond."""
        k1, k2 = self.distortion[:2]
        turns = np.polynomial.Polynomial([1.0, 3.0 * k1, 5.0 * k2, 7.0 * self.sixth_power]).roots()
        real = turns[np.abs(turns.imag) < 1e-12].real
        return float(min(real[real > 0.0], default=np.inf))

    def _distort(self, xy: FloatArray) -> FloatArray:
        """Distort normalised coordinates, shape (..., 2)."""
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        k1, k2, k3, k4 = self.distortion
        if self.model == "radtan":
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * self.sixth_power))
            tangential_x = 2 * k3 * x * y + k4 * (r2 + 2 * x * x)
            tangential_y = k3 * (r2 + 2 * y * y) + 2 * k4 * x * y
            return np.stack([radial * x + tangential_x, radial * y + tangential_y], axis=-1)
        if self.model != "equidistant":
            raise ValueError(f"distortion model {self.model!r} is not known; use 'radtan' or 'equidistant'")
        r = np.sqrt(np.maximum(r2, 1e-24))
        a = np.arctan(r)
        a2 = a * a
        scale = a * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / r
        return np.asarray(xy * scale[..., None])
