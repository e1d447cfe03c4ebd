"""Where the points of a flat board appear: a homography and one lens coefficient, fitted to what was seen.

Good to a pixel or so with any common lens and needs no calibration: it predicts corners that were not found
yet, tells neighbours apart, and shows which detections do not belong. Undistorted and distorted image points
are related by the division model q_u = q_d / (1 + lens |q_d|^2), q from the image centre in half widths.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray

BoolArray = npt.NDArray[np.bool_]

STEPS = np.full(9, 1e-6)
MAX_LENS = 1.5
LENS_PRIOR = 0.5
"""One-sigma of the lens coefficient around its start: keeps few points from inventing a lens."""


@dataclass(frozen=True)
class GridModel:
    """Board plane to image.

    Attributes:
        parameters: Homography (first eight entries, the ninth is 1) of scaled board coordinates, then the
            lens coefficient, shape (9,).
        centre_m: Board coordinates taken as origin, m.
        scale_m: Board length taken as one, m.
        shape: Image height and width, px.
    """

    parameters: FloatArray
    centre_m: FloatArray
    scale_m: float
    shape: tuple[int, int]

    def predict(self, xy_m: FloatArray) -> FloatArray:
        """Pixels of board points, shape (n, 2); nan where a point lies behind the camera."""
        x = (xy_m[:, :2] - self.centre_m) / self.scale_m
        return np.asarray(_project(self.parameters[None], x, self.shape)[0])

    def axes_px(self, xy_m: FloatArray) -> FloatArray:
        """Pixels per metre along the board's x and y at each point, shape (n, 2, 2): [:, 0] is d(uv)/dx."""
        h = 1e-3 * self.scale_m
        dx = (self.predict(xy_m[:, :2] + [h, 0]) - self.predict(xy_m[:, :2] - [h, 0])) / (2 * h)
        dy = (self.predict(xy_m[:, :2] + [0, h]) - self.predict(xy_m[:, :2] - [0, h])) / (2 * h)
        return np.stack([dx, dy], axis=1)

    def refit(self, xy_m: FloatArray, uv_px: FloatArray, iterations: int = 4) -> GridModel:
        """Return the model fitted to new points, starting here; robust against a few wrong ones."""
        x = (xy_m[:, :2] - self.centre_m) / self.scale_m
        parameters = self.parameters
        for _ in range(iterations):
            parameters = _gauss_newton_step(parameters, x, uv_px, self.shape, self.parameters[8])
        return GridModel(parameters, self.centre_m, self.scale_m, self.shape)


def fit_grid(
    xy_m: FloatArray, uv_px: FloatArray, shape: tuple[int, int], lens: float = -0.1, tolerance_px: float = 4.0
) -> GridModel | None:
    """Fit a model to at least four points, some of which may be wrong.

    Args:
        xy_m: Board coordinates, shape (n, 2 or 3), m.
        uv_px: Their pixels, shape (n, 2).
        shape: Image height and width.
        lens: First guess of the lens coefficient (negative: barrel).
        tolerance_px: Distance at which the first, linear fit calls a point wrong.
    """
    if len(xy_m) < 4:
        return None
    centre = xy_m[:, :2].mean(axis=0)
    scale = float(max(np.ptp(xy_m[:, 0]), np.ptp(xy_m[:, 1]), 1e-9)) / 2
    x = (xy_m[:, :2] - centre) / scale
    half, middle = _frame(shape)
    q = (uv_px - middle) / half
    undistorted = q / (1 + lens * np.sum(q * q, axis=1, keepdims=True))
    cv2.setRNGSeed(1)
    H, _ = cv2.findHomography(x, undistorted, cv2.RANSAC, tolerance_px / half, maxIters=400)
    if H is None or abs(H[2, 2]) < 1e-12:
        return None
    parameters = np.append((H / H[2, 2]).ravel()[:8], lens)
    return GridModel(parameters, centre, scale, shape).refit(xy_m, uv_px, iterations=8)


def outliers(model: GridModel, xy_m: FloatArray, uv_px: FloatArray, floor_px: float = 0.6) -> BoolArray:
    """Tell which points disagree with the model *and* with how their neighbours disagree.

    The model misses the lens' finer shape by a smooth amount, which neighbours share; a wrong corner stands
    out from their median. `floor_px` is the distance that is always allowed.
    """
    residual = uv_px - model.predict(xy_m)
    if len(xy_m) < 5:
        return np.asarray(~(np.linalg.norm(residual, axis=1) < 3 * floor_px))
    apart = np.linalg.norm(xy_m[:, None, :2] - xy_m[None, :, :2], axis=2)
    near = np.argsort(apart, axis=1)[:, 1 : min(9, len(xy_m))]
    odd = np.linalg.norm(residual - np.median(residual[near], axis=1), axis=1)
    limit = max(floor_px, 6 * float(np.nanmedian(odd)))
    return np.asarray(~(odd < limit))


def _frame(shape: tuple[int, int]) -> tuple[float, FloatArray]:
    height, width = shape
    return max(height, width) / 2, np.array([(width - 1) / 2, (height - 1) / 2])


def _project(parameters: FloatArray, x: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Pixels for a batch of parameter vectors (m, 9) and scaled board points (n, 2): shape (m, n, 2)."""
    half, middle = _frame(shape)
    h = parameters[:, :, None]
    depth = h[:, 6] * x[:, 0] + h[:, 7] * x[:, 1] + 1.0
    depth = np.where(depth > 1e-6, depth, np.nan)
    u = (h[:, 0] * x[:, 0] + h[:, 1] * x[:, 1] + h[:, 2]) / depth
    v = (h[:, 3] * x[:, 0] + h[:, 4] * x[:, 1] + h[:, 5]) / depth
    # lens r_u r_d^2 - r_d + r_u = 0, the root that tends to r_u as lens tends to 0
    root = np.sqrt(np.maximum(1 - 4 * h[:, 8] * (u * u + v * v), 0.0))
    stretch = 2 / (1 + root) * half
    return np.stack([u * stretch + middle[0], v * stretch + middle[1]], axis=-1)


def _gauss_newton_step(
    parameters: FloatArray, x: FloatArray, uv: FloatArray, shape: tuple[int, int], lens0: float
) -> FloatArray:
    """One step of Huber-weighted least squares; the homography alone with fewer than eight points."""
    batch = np.vstack([parameters, parameters + np.diag(STEPS)])
    predicted = _project(batch, x, shape)
    seen = np.isfinite(predicted[0]).all(axis=1)
    if seen.sum() < 4:
        return parameters
    residual = (uv - predicted[0])[seen]
    J = ((predicted[1:] - predicted[:1])[:, seen] / STEPS[:, None, None]).reshape(9, -1).T
    size = np.linalg.norm(residual, axis=1)
    knee = 1.5 * float(np.median(size)) + 0.3
    weight = np.repeat(np.minimum(1.0, knee / np.maximum(size, 1e-9)), 2)
    normal = (J * weight[:, None]).T @ J
    right = (J * weight[:, None]).T @ residual.ravel()
    prior = 1.0 / LENS_PRIOR**2 if seen.sum() >= 8 else 1e12
    normal[8, 8] += prior
    right[8] += prior * (lens0 - parameters[8])
    normal[np.diag_indices(9)] += 1e-9 * np.diag(normal) + 1e-12
    new = parameters + np.linalg.solve(normal, right)
    new[8] = np.clip(new[8], -MAX_LENS, MAX_LENS)
    return np.asarray(new)
