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

from vical_daemon.vision.detection import FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]

CONVERGED = 2e-5
"""Change of the (dimensionless) parameters that moves no corner by more than about 0.01 px."""
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
        return np.asarray(_project(self.parameters, x, self.shape))

    def axes_px(self, xy_m: FloatArray) -> FloatArray:
        """Pixels per metre along the board's x and y at each point, shape (n, 2, 2): [:, 0] is d(uv)/dx."""
        h = 1e-3 * self.scale_m
        dx = (self.predict(xy_m[:, :2] + [h, 0]) - self.predict(xy_m[:, :2] - [h, 0])) / (2 * h)
        dy = (self.predict(xy_m[:, :2] + [0, h]) - self.predict(xy_m[:, :2] - [0, h])) / (2 * h)
        return np.stack([dx, dy], axis=1)

    def refit(self, xy_m: FloatArray, uv_px: FloatArray, iterations: int = 6) -> GridModel:
        """Return the model fitted to new points, starting here; robust against a few wrong ones."""
        x = (xy_m[:, :2] - self.centre_m) / self.scale_m
        parameters = self.parameters
        for _ in range(iterations):
            before = parameters
            parameters = _gauss_newton_step(parameters, x, uv_px, self.shape, self.parameters[8])
            if np.max(np.abs(parameters - before)) < CONVERGED:
                break
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


def neighbour_table(xy_m: FloatArray) -> IntArray:
    """The nearest other points of each board point, nearest first, shape (n, up to 16)."""
    apart = np.linalg.norm(xy_m[:, None, :2] - xy_m[None, :, :2], axis=2)
    return np.argsort(apart, axis=1, kind="stable")[:, 1:17].astype(np.int64)


def outliers(
    residual_px: FloatArray, valid: BoolArray, neighbours: IntArray, floor_px: float = 0.6
) -> BoolArray:
    """Tell which points disagree with the model *and* with how their neighbours disagree.

    The model misses the lens' finer shape by a smooth amount, which neighbours share; a wrong corner stands
    out from their median.

    Args:
        residual_px: Found minus predicted, shape (n, 2).
        valid: Points that take part, shape (n,).
        neighbours: From `neighbour_table`.
        floor_px: Distance that is always allowed.

    Returns:
        True for valid points that are wrong, shape (n,).
    """
    residual = np.where(valid[:, None], residual_px, np.inf)
    if valid.sum() < 5:
        return np.asarray(valid & ~(np.linalg.norm(residual, axis=1) < 3 * floor_px))
    around = np.sort(residual[neighbours], axis=1)
    count = valid[neighbours].sum(axis=1)
    middle = np.maximum(count - 1, 0) // 2
    median = np.take_along_axis(around, middle[:, None, None], axis=1)[:, 0]
    median = np.where((count >= 2)[:, None], median, 0.0)
    odd = np.linalg.norm(np.where(valid[:, None], residual - median, 0.0), axis=1)
    limit = max(floor_px, 6 * float(np.median(odd[valid])))
    return np.asarray(valid & ~(odd < limit))


def _frame(shape: tuple[int, int]) -> tuple[float, FloatArray]:
    height, width = shape
    return max(height, width) / 2, np.array([(width - 1) / 2, (height - 1) / 2])


def _undistorted(parameters: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Homography of scaled board points: u, v in half widths, and the divisor (nan behind the camera)."""
    h = parameters
    depth = h[6] * x[:, 0] + h[7] * x[:, 1] + 1.0
    depth = np.where(depth > 1e-6, depth, np.nan)
    u = (h[0] * x[:, 0] + h[1] * x[:, 1] + h[2]) / depth
    v = (h[3] * x[:, 0] + h[4] * x[:, 1] + h[5]) / depth
    return u, v, depth


def _root(lens: float, u: FloatArray, v: FloatArray) -> FloatArray:
    """Root of lens r_u r_d^2 - r_d + r_u = 0, chosen such that r_d tends to r_u as lens tends to 0."""
    return np.asarray(np.sqrt(np.maximum(1 - 4 * lens * (u * u + v * v), 1e-6)))


# Trial parameters may be wild; points that then overflow are not finite, and no corner is looked for there.
_wild_guesses = np.errstate(over="ignore", invalid="ignore")


@_wild_guesses
def _project(parameters: FloatArray, x: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Pixels of scaled board points (n, 2), shape (n, 2)."""
    half, middle = _frame(shape)
    u, v, _ = _undistorted(parameters, x)
    stretch = 2 * half / (1 + _root(parameters[8], u, v))
    return np.stack([u * stretch + middle[0], v * stretch + middle[1]], axis=-1)


@_wild_guesses
def _jacobian(parameters: FloatArray, x: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Derivative of `_project` by the nine parameters, shape (n, 2, 9)."""
    half, _ = _frame(shape)
    u, v, depth = _undistorted(parameters, x)
    lens = parameters[8]
    root = _root(lens, u, v)
    stretch = 2 / (1 + root)
    per_lens = 4 / (root * (1 + root) ** 2)  # derivative of the stretch by lens r^2
    r2 = u * u + v * v
    a, b, d = stretch + 2 * lens * per_lens * u * u, 2 * lens * per_lens * u * v, stretch
    d = d + 2 * lens * per_lens * v * v
    X, Y, one = x[:, 0] / depth, x[:, 1] / depth, 1 / depth
    J = np.empty((len(x), 2, 9))
    for row, (by_u, by_v) in enumerate(((a, b), (b, d))):
        J[:, row, 0], J[:, row, 1], J[:, row, 2] = by_u * X, by_u * Y, by_u * one
        J[:, row, 3], J[:, row, 4], J[:, row, 5] = by_v * X, by_v * Y, by_v * one
        along = -(by_u * u + by_v * v)
        J[:, row, 6], J[:, row, 7] = along * X, along * Y
    J[:, 0, 8], J[:, 1, 8] = u * r2 * per_lens, v * r2 * per_lens
    return np.asarray(J * half)


def _gauss_newton_step(
    parameters: FloatArray, x: FloatArray, uv: FloatArray, shape: tuple[int, int], lens0: float
) -> FloatArray:
    """One step of Huber-weighted least squares; the homography alone with fewer than eight points."""
    residual = uv - _project(parameters, x, shape)
    seen = np.isfinite(residual[:, 0])
    count = int(seen.sum())
    if count < 4:
        return parameters
    J = _jacobian(parameters, x, shape)
    if count < len(seen):
        residual, J = residual[seen], J[seen]
    J = J.reshape(-1, 9)
    size = np.linalg.norm(residual, axis=1)
    knee = 1.5 * float(np.partition(size, count // 2)[count // 2]) + 0.3
    weighted = J * np.repeat(np.minimum(1.0, knee / np.maximum(size, 1e-9)), 2)[:, None]
    normal = weighted.T @ J
    right = weighted.T @ residual.ravel()
    prior = 1.0 / LENS_PRIOR**2 if count >= 8 else 1e12
    normal[8, 8] += prior
    right[8] += prior * (lens0 - parameters[8])
    normal.flat[::10] *= 1 + 1e-9
    normal.flat[::10] += 1e-12
    new = parameters + np.linalg.solve(normal, right)
    new[8] = min(max(new[8], -MAX_LENS), MAX_LENS)
    return np.asarray(new)
