"""Rotations for the simulated truth: batched, numpy only.

Deliberately separate from the daemon's own rotation code: two sides that share one sign error agree with
each other. Rotation vectors `theta` map to matrices by the exponential map, `R = exp_so3(theta)`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

# Below this angle (rad) the series are exact to double precision and the closed forms are not.
_SMALL_RAD = 1e-2


def skew(v: npt.ArrayLike) -> FloatArray:
    """Return the matrices that do `skew(v) @ x = v x x`; shape (..., 3) to (..., 3, 3)."""
    a = np.asarray(v, dtype=np.float64)
    out = np.zeros((*a.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -a[..., 2], a[..., 1]
    out[..., 1, 0], out[..., 1, 2] = a[..., 2], -a[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -a[..., 1], a[..., 0]
    return out


def _coefficients(theta: FloatArray) -> tuple[FloatArray, ...]:
    """Return sin(x)/x, (1-cos x)/x^2, (x-sin x)/x^3 and the derivatives of the last two divided by x."""
    x2 = np.sum(theta * theta, axis=-1)
    x = np.sqrt(x2)
    small = x < _SMALL_RAD
    y = np.where(small, 1.0, x)
    s, c = np.sin(y), np.cos(y)
    sinc = np.where(small, 1 - x2 / 6 + x2**2 / 120, s / y)
    a = np.where(small, 0.5 - x2 / 24 + x2**2 / 720, (1 - c) / y**2)
    b = np.where(small, 1 / 6 - x2 / 120 + x2**2 / 5040, (y - s) / y**3)
    a_slope = np.where(small, -1 / 12 + x2 / 180 - x2**2 / 6720, (y * s - 2 * (1 - c)) / y**4)
    b_slope = np.where(small, -1 / 60 + x2 / 1260 - x2**2 / 60480, (3 * s - 2 * y - y * c) / y**5)
    return sinc, a, b, a_slope, b_slope


def exp_so3(theta: npt.ArrayLike) -> FloatArray:
    """Rotation matrices of rotation vectors (Rodrigues), shape (..., 3) to (..., 3, 3)."""
    th = np.asarray(theta, dtype=np.float64)
    sinc, a, *_ = _coefficients(th)
    k = skew(th)
    return np.asarray(np.eye(3) + sinc[..., None, None] * k + a[..., None, None] * (k @ k))


def log_so3(R: npt.ArrayLike) -> FloatArray:
    """Rotation vectors (angle in [0, pi]) of rotation matrices, shape (..., 3, 3) to (..., 3)."""
    q = quaternion_wxyz(R)
    norm = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2 * np.arctan2(norm, q[..., 0])
    factor = np.where(norm > 1e-12, angle / np.maximum(norm, 1e-300), 2.0)
    return np.asarray(factor[..., None] * q[..., 1:])


def quaternion_wxyz(R: npt.ArrayLike) -> FloatArray:
    """Hamilton unit quaternions, w >= 0, of rotation matrices (Shepperd)."""
    m = np.asarray(R, dtype=np.float64)
    trace = np.trace(m, axis1=-2, axis2=-1)
    off = np.stack(
        [m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], axis=-1
    )
    # Four equivalent rows, each 4 q_i q: the longest is the best conditioned.
    rows = np.empty((*m.shape[:-2], 4, 4))
    rows[..., 0, 0] = 1 + trace
    rows[..., 0, 1:] = rows[..., 1:, 0] = off
    rows[..., 1:, 1:] = m + np.swapaxes(m, -1, -2)
    for i in range(3):
        rows[..., i + 1, i + 1] = 1 - trace + 2 * m[..., i, i]
    best = np.argmax(np.sum(rows * rows, axis=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


def body_rate(theta: FloatArray, theta_dot: FloatArray) -> FloatArray:
    """Angular rate in the body frame of R(t) = exp(theta(t)): the right Jacobian times theta_dot, rad/s."""
    _, a, b, *_ = _coefficients(theta)
    first = np.cross(theta, theta_dot)
    return np.asarray(theta_dot - a[..., None] * first + b[..., None] * np.cross(theta, first))


def body_acceleration(theta: FloatArray, theta_dot: FloatArray, theta_ddot: FloatArray) -> FloatArray:
    """Time derivative of `body_rate`, in the body frame, rad/s^2 (product rule on the right Jacobian)."""
    _, _, b, a_slope, b_slope = _coefficients(theta)
    along = np.sum(theta * theta_dot, axis=-1)
    first = np.cross(theta, theta_dot)
    second = np.cross(theta, first)
    return np.asarray(
        body_rate(theta, theta_ddot)
        - (a_slope * along)[..., None] * first
        + (b_slope * along)[..., None] * second
        + b[..., None] * np.cross(theta_dot, first)
    )
