"""Where the points of a flat board appear: a homography and one lens coefficient, fitted to what was seen.

Good to a pixel or so with any common lens and needs no calibration: it predicts corners that were not found
yet, separates neighbours, and shows which detections do not belong. Undistorted and distorted image points
are related by the division model q_u = q_d / (1 + lens |q_d|^2), q from the image centre in half widths.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray, IntArray, median

_TOLERANCE_PX = 4.0  # at which the first, linear fit calls a point wrong

BoolArray = npt.NDArray[np.bool_]

CONVERGED = 2e-3
"""Change of the (dimensionless) parameters that moves corners by about a pixel: what the next step would
change is of second order in it."""
MAX_LENS = 1.5  # bound of the lens coefficient: three sigmas of its prior
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
        return np.asarray(_project(self.parameters, self._scaled(xy_m), self.shape))

    def refit(self, xy_m: FloatArray, uv_px: FloatArray, iterations: int = 6) -> GridModel:
        """Return the model fitted to new points, starting here; robust against a few wrong ones."""
        x, uv = self._scaled(xy_m), np.ascontiguousarray(uv_px.T)
        parameters = self.parameters
        for _ in range(iterations):
            before = parameters
            parameters = _gauss_newton_step(parameters, x, uv, self.shape, self.parameters[8])
            if np.max(np.abs(parameters - before)) < CONVERGED:
                break
        return GridModel(parameters, self.centre_m, self.scale_m, self.shape)

    def _scaled(self, xy_m: FloatArray) -> FloatArray:
        """Scaled board coordinates x, y, 1, shape (3, n)."""
        scaled = np.ones((3, len(xy_m)))
        scaled[:2] = (xy_m[:, :2] - self.centre_m).T / self.scale_m
        return scaled


def fit_grid(
    xy_m: FloatArray, uv_px: FloatArray, shape: tuple[int, int], lens: float = -0.1
) -> GridModel | None:
    """Fit a model to at least four points, some of which may be wrong.

    Args:
        xy_m: Board coordinates, shape (n, 2 or 3), m.
        uv_px: Their pixels, shape (n, 2).
        shape: Image height and width.
        lens: First guess of the lens coefficient (negative: barrel).
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
    H, _ = cv2.findHomography(x, undistorted, cv2.RANSAC, _TOLERANCE_PX / half, maxIters=400)
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
    residual = np.where(valid, residual_px.T, np.inf)
    if valid.sum() < 5:
        return np.asarray(valid & ~(np.hypot(*residual) < 3 * floor_px))
    around = np.sort(residual[:, neighbours], axis=2)
    count = valid[neighbours].sum(axis=1)
    middle = np.maximum(count - 1, 0) // 2
    usual = around[:, np.arange(len(valid)), middle]
    usual = np.where(count >= 2, usual, 0.0)
    with np.errstate(invalid="ignore"):  # where the model predicts a point and its neighbours at infinity
        odd = np.hypot(*np.where(valid, residual - usual, 0.0))
    limit = max(floor_px, 6 * median(odd[valid]))
    return np.asarray(valid & ~(odd < limit))


def _frame(shape: tuple[int, int]) -> tuple[float, FloatArray]:
    height, width = shape
    return max(height, width) / 2, np.array([(width - 1) / 2, (height - 1) / 2])


def _undistorted(parameters: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Homography of scaled board points (3, n): u, v in half widths, shape (2, n), and the divisor, (n,).

    Both are nan behind the camera.
    """
    H = np.ones(9)
    H[:8] = parameters[:8]
    uvw = H.reshape(3, 3) @ x
    depth = np.where(uvw[2] > 1e-6, uvw[2], np.nan)
    return uvw[:2] / depth, depth


def _root(lens: float, r2: FloatArray) -> FloatArray:
    """Root of lens r_u r_d^2 - r_d + r_u = 0, chosen such that r_d tends to r_u as lens tends to 0."""
    return np.asarray(np.sqrt(np.maximum(1 - 4 * lens * r2, 1e-6)))


# Trial parameters may be wild; points that then overflow are not finite, and no corner is looked for there.
_wild_guesses = np.errstate(over="ignore", invalid="ignore")


@_wild_guesses
def _project(parameters: FloatArray, x: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Pixels of scaled board points (3, n), shape (n, 2)."""
    half, middle = _frame(shape)
    q, _ = _undistorted(parameters, x)
    stretch = 2 * half / (1 + _root(parameters[8], q[0] * q[0] + q[1] * q[1]))
    return np.ascontiguousarray((q * stretch).T) + middle


@_wild_guesses
def _project_with_jacobian(
    parameters: FloatArray, x: FloatArray, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Pixels of scaled board points, shape (2, n), and their derivative by the parameters, (9, 2, n)."""
    half, middle = _frame(shape)
    q, depth = _undistorted(parameters, x)
    lens = parameters[8]
    r2 = q[0] * q[0] + q[1] * q[1]
    root = _root(lens, r2)
    stretch = 2 / (1 + root)
    per_lens = 4 / (root * (1 + root) ** 2)  # derivative of the stretch by lens r^2
    board = x * (half / depth)
    by_q = (2 * lens * per_lens * q)[:, None] * q  # derivative of the pixel by u and v, shape (2, 2, n)
    by_q[0, 0] += stretch
    by_q[1, 1] += stretch
    J = np.empty((9, 2, x.shape[1]))
    np.multiply(by_q[0], board[:, None], out=J[0:3])
    np.multiply(by_q[1], board[:, None], out=J[3:6])
    along = -(by_q[0] * q[0] + by_q[1] * q[1])
    np.multiply(along, board[:2, None], out=J[6:8])
    np.multiply(q, half * r2 * per_lens, out=J[8])
    return q * (half * stretch) + middle[:, None], J


def _gauss_newton_step(
    parameters: FloatArray, x: FloatArray, uv: FloatArray, shape: tuple[int, int], lens0: float
) -> FloatArray:
    """One step of Huber-weighted least squares; the homography alone with fewer than eight points.

    `x` is the scaled board points, shape (3, n), and `uv` their pixels, shape (2, n).
    """
    projected, J = _project_with_jacobian(parameters, x, shape)
    residual = uv - projected
    size = np.hypot(residual[0], residual[1])
    seen = np.isfinite(size)
    count = int(np.count_nonzero(seen))
    if count < 4:
        return parameters
    if count < len(seen):
        residual, J, size = residual[:, seen], J[:, :, seen], size[seen]
    knee = 1.5 * median(size) + 0.3
    weight = np.minimum(1.0, knee / np.maximum(size, 1e-9))
    J = J.reshape(9, -1)
    weighted = (J.reshape(9, 2, -1) * weight).reshape(9, -1)
    normal = weighted @ J.T
    right = weighted @ residual.ravel()
    prior = 1.0 / LENS_PRIOR**2 if count >= 8 else 1e12
    normal[8, 8] += prior
    right[8] += prior * (lens0 - parameters[8])
    normal.flat[::10] *= 1 + 1e-9
    normal.flat[::10] += 1e-12
    new = parameters + np.linalg.solve(normal, right)
    new[8] = min(max(new[8], -MAX_LENS), MAX_LENS)
    return np.asarray(new)
