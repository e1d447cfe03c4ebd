"""Pinhole cameras with radial-tangential or equidistant distortion: project, Jacobians (back: `camera_rays`).

Kalibr's names and OpenCV's numbers: `radtan` is k1 k2 p1 p2 (Brown-Conrady, OpenCV's first four),
`equidistant` is k1 k2 k3 k4 (Kannala-Brandt, OpenCV's fisheye). `plumb_bob` is ROS' name for radtan with one
more power of the radius, k1 k2 p1 p2 k3 (OpenCV's five). Intrinsics are fx fy cx cy in pixels; pixel centres
lie at integers. Everything is batched: points (..., 3) against intrinsics (..., 4) and distortion (..., d),
d = 4 or 5, whose leading axes broadcast, so that a filter projects all sigma points in one call.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

RADTAN = "radtan"
PLUMB_BOB = "plumb_bob"
EQUIDISTANT = "equidistant"
COEFFICIENTS = {
    RADTAN: ("k1", "k2", "p1", "p2"),
    PLUMB_BOB: ("k1", "k2", "p1", "p2", "k3"),
    EQUIDISTANT: ("k1", "k2", "k3", "k4"),
}
"""Names of each model's coefficients, in order."""

_TINY_RADIUS = 1e-9  # below it a ray is the optical axis, and theta / r is 1 to the last digit


def check_model(model: str) -> None:
    """Raise ValueError where there is no such distortion model."""
    if model not in COEFFICIENTS:
        raise ValueError(f"unknown distortion model {model!r}: use {' or '.join(COEFFICIENTS)}")


def coefficients_error(model: str, values: Sequence[float]) -> str:
    """Return the problem with the number of distortion coefficients, "" if none.

    Raises:
        ValueError: unknown model.
    """
    check_model(model)
    names = COEFFICIENTS[model]
    if len(values) == len(names):
        return ""
    five = f"; the model with these is {PLUMB_BOB}" if (model, len(values)) == (RADTAN, 5) else ""
    return f"expected {len(names)} values ({' '.join(names)} of {model}), found {len(values)}{five}"


def _front(z: FloatArray) -> FloatArray:
    """Depth, with not-a-number for points that a pinhole cannot see (on or behind the image plane)."""
    out: FloatArray = np.where(z > 0.0, z, np.nan)
    return out


def distort(xy: FloatArray, distortion: FloatArray) -> FloatArray:
    """Apply radtan distortion to normalised coordinates (Brown-Conrady, as OpenCV).

    Args:
        xy: Ideal coordinates X/Z, Y/Z, shape (..., 2).
        distortion: k1 k2 p1 p2 [k3], shape (..., 4) or (..., 5).

    Returns:
        Distorted normalised coordinates, shape (..., 2).
    """
    x, y = xy[..., 0], xy[..., 1]
    k1, k2, p1, p2 = (distortion[..., i] for i in range(4))
    x2, y2, xy2 = x * x, y * y, 2.0 * x * y
    r2 = x2 + y2
    upper = k2 * r2
    if distortion.shape[-1] == 5:
        upper += distortion[..., 4] * (r2 * r2)
    radial = 1.0 + r2 * (k1 + upper)
    out = np.empty((*radial.shape, 2))
    out[..., 0] = x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x2)
    out[..., 1] = y * radial + p1 * (r2 + 2.0 * y2) + p2 * xy2
    return out


def project(
    points_cam: FloatArray, intrinsics: FloatArray, distortion: FloatArray, model: str = RADTAN
) -> FloatArray:
    """Project points in the camera frame to pixels.

    Args:
        points_cam: x right, y down, z forward, m, shape (..., 3).
        intrinsics: fx fy cx cy, px, shape (..., 4).
        distortion: The model's coefficients, shape (..., d).
        model: radtan, plumb_bob or equidistant.

    Returns:
        Pixels u v, shape (..., 2); not-a-number where radtan has z <= 0 (a fisheye may look behind).

    Raises:
        ValueError: unknown model.
    """
    check_model(model)
    points = np.asarray(points_cam, dtype=np.float64)
    K = np.asarray(intrinsics, dtype=np.float64)
    D = np.asarray(distortion, dtype=np.float64)
    if model == EQUIDISTANT:
        uv = _equidistant(points, D) * K[..., :2]
    else:
        uv = distort(points[..., :2] / _front(points[..., 2:]), D) * K[..., :2]
    uv += K[..., 2:]
    return uv


def _equidistant(points: FloatArray, distortion: FloatArray) -> FloatArray:
    """Distorted normalised coordinates of the Kannala-Brandt model: theta_d along the image direction."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    r = np.hypot(x, y)
    theta = np.arctan2(r, z)
    t2 = theta * theta
    k1, k2, k3, k4 = (distortion[..., i] for i in range(4))
    theta_d = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    axis = r < _TINY_RADIUS * np.abs(z)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(axis & (z > 0.0), 1.0 / z, theta_d / r)
    out = np.empty((*scale.shape, 2))
    out[..., 0] = x * scale
    out[..., 1] = y * scale
    return out


def project_jacobians(
    points_cam: FloatArray, intrinsics: FloatArray, distortion: FloatArray, model: str = RADTAN
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Project and differentiate.

    Args:
        points_cam: Points in the camera frame, m, shape (..., 3).
        intrinsics: fx fy cx cy, px, shape (..., 4).
        distortion: The model's coefficients, shape (..., d).
        model: radtan, plumb_bob or equidistant.

    Returns:
        Pixels (..., 2); their derivatives by the point (..., 2, 3), px/m; by fx fy cx cy and the
        distortion coefficients (..., 2, 4 + d).

    Raises:
        ValueError: unknown model.
    """
    check_model(model)
    points = np.asarray(points_cam, dtype=np.float64)
    K = np.asarray(intrinsics, dtype=np.float64)
    D = np.asarray(distortion, dtype=np.float64)
    jacobians = _equidistant_jacobians if model == EQUIDISTANT else _radtan_jacobians
    d, d_point, d_distortion = jacobians(points, D)
    focal = K[..., :2]
    uv = d * focal + K[..., 2:]
    d_point *= focal[..., None]
    J_camera = np.zeros((*d.shape, 4 + D.shape[-1]))
    J_camera[..., 0, 0] = d[..., 0]
    J_camera[..., 1, 1] = d[..., 1]
    J_camera[..., 0, 2] = J_camera[..., 1, 3] = 1.0
    np.multiply(d_distortion, focal[..., None], out=J_camera[..., 4:])
    return uv, d_point, J_camera


def _radtan_jacobians(points: FloatArray, D: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    iz = 1.0 / _front(points[..., 2])
    xy = points[..., :2] * iz[..., None]
    x, y = xy[..., 0], xy[..., 1]
    xx, yy, xy2 = x * x, y * y, 2.0 * (x * y)
    r2 = xx + yy
    J_d = np.empty((*xy.shape, D.shape[-1]))  # the distortion is linear in its coefficients
    powers = r2[..., None] * xy
    J_d[..., 0] = powers
    for column in (1, 4)[: D.shape[-1] - 3]:
        powers = r2[..., None] * powers
        J_d[..., column] = powers
    J_d[..., 0, 2] = J_d[..., 1, 3] = xy2
    J_d[..., 1, 2], J_d[..., 0, 3] = r2 + 2.0 * yy, r2 + 2.0 * xx
    d = xy + (J_d @ D if D.ndim == 1 else np.matvec(J_d, D))
    a, b, c = radtan_derivative(x, y, r2, D)
    J = np.empty((*d.shape, 3))
    J[..., 0, 0], J[..., 0, 1], J[..., 1, 1] = a, b, c
    J[..., 1, 0] = b
    J[..., 2] = -(J[..., 0] * x[..., None] + J[..., 1] * y[..., None])
    J *= iz[..., None, None]
    return d, J, J_d


def radtan_derivative(
    x: FloatArray, y: FloatArray, r2: FloatArray, D: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the symmetric 2x2 derivative of `distort`: [[a, b], [b, c]]."""
    # plain numbers where all points have one lens: with numpy's, each product takes half as long again
    k1, k2, p1, p2 = D[:4].tolist() if D.ndim == 1 else (D[..., i] for i in range(4))
    radial = 1.0 + r2 * (k1 + k2 * r2)
    slope = 2.0 * k1 + (4.0 * k2) * r2
    if D.shape[-1] == 5:
        r4 = D[..., 4] * (r2 * r2)
        radial, slope = radial + r4 * r2, slope + 6.0 * r4
    px, py = (2.0 * p2) * x, (2.0 * p1) * y
    sx, sy = slope * x, slope * y
    a = radial + sx * x + py + 3.0 * px
    b = sx * y + (2.0 * p1) * x + (2.0 * p2) * y
    c = radial + sy * y + 3.0 * py + px
    return a, b, c


def _equidistant_jacobians(points: FloatArray, D: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    r2 = x * x + y * y
    r = np.sqrt(r2)
    axis = r < _TINY_RADIUS * np.abs(z)
    safe_r = np.where(axis, 1.0, r)
    theta = np.arctan2(r, z)
    t2 = theta * theta
    powers = np.stack((t2, t2 * t2, t2**3, t2**4), axis=-1)
    gain = 1.0 + np.sum(D * powers, axis=-1)
    slope = 1.0 + np.sum(D * powers * np.array([3.0, 5.0, 7.0, 9.0]), axis=-1)
    scale = np.where(axis, 1.0 / z, theta * gain / safe_r)
    # d(scale)/dr and d(scale)/dz; theta_r = z / rho^2, theta_z = -r / rho^2
    rho2 = r2 + z * z
    scale_r = np.where(axis, 0.0, (slope * z / rho2 - scale) / safe_r)
    scale_z = -slope / rho2
    ux, uy = np.where(axis, 0.0, x / safe_r), np.where(axis, 0.0, y / safe_r)
    J = np.empty((*scale.shape, 2, 3))
    J[..., 0, 0] = scale + x * scale_r * ux
    J[..., 0, 1] = x * scale_r * uy
    J[..., 1, 0] = y * scale_r * ux
    J[..., 1, 1] = scale + y * scale_r * uy
    J[..., 0, 2] = x * scale_z
    J[..., 1, 2] = y * scale_z
    d = np.stack((x * scale, y * scale), axis=-1)
    direction = np.stack((ux, uy), axis=-1)
    J_d = direction[..., :, None] * (theta[..., None] * powers)[..., None, :]
    return d, J, J_d
