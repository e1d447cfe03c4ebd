"""Rotations, batched over leading axes: rotation vectors, matrices and Hamilton quaternions.

A rotation `R_a_b` maps vectors given in frame b into frame a. A rotation vector is axis times angle, rad.
Quaternions are Hamilton, unit, arrays w x y z. Errors are local (right): `R = R_mean @ exp(error)`.
Every function takes arrays with any leading axes and broadcasts them; there are no loops over the batch.
Formulas: Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), in our own notation.
"""

from __future__ import annotations

import math
from itertools import permutations, product

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

IDENTITY = np.eye(3)
"""The identity, not to be written to."""
_NO_ANGLE = 1e-40  # rad^2: keeps sin(a)/a defined at zero, and changes no digit of it anywhere
_SERIES_BELOW_RAD = 0.3  # below it the closed forms lose digits, and five terms of the series are exact

# vec(hat(v)) = v _SKEW
_SKEW = np.array(
    [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]],
    dtype=np.float64,
)


def hat(v: FloatArray) -> FloatArray:
    """Return the skew matrix with `hat(v) @ u == cross(v, u)`.

    Args:
        v: Vectors, shape (..., 3).

    Returns:
        Skew-symmetric matrices, shape (..., 3, 3).
    """
    v = np.asarray(v, dtype=np.float64)
    return np.asarray((v @ _SKEW).reshape(*v.shape, 3))


def polynomial(alpha: FloatArray, beta: FloatArray, gamma: FloatArray, v: FloatArray) -> FloatArray:
    """Return `alpha I + beta hat(v) + gamma v v'`, the form of all functions of hat(v)."""
    out = ((beta[..., None] * v) @ _SKEW).reshape(*v.shape, 3)
    out += (gamma[..., None] * v)[..., :, None] * v[..., None, :]
    out.reshape(*v.shape[:-1], 9)[..., ::4] += alpha[..., None]
    return out


def exp(rotvec: FloatArray) -> FloatArray:
    """Return the rotation matrices of rotation vectors (Rodrigues' formula).

    Args:
        rotvec: Axis times angle, rad, shape (..., 3).

    Returns:
        Rotation matrices, shape (..., 3, 3).
    """
    v = np.asarray(rotvec, dtype=np.float64)
    angle2 = np.vecdot(v, v)
    half = 0.5 * np.sqrt(angle2 + _NO_ANGLE)
    half_sinc = np.sin(half) / half
    gamma = 0.5 * half_sinc * half_sinc  # (1 - cos) / angle^2 without cancellation
    return polynomial(1.0 - gamma * angle2, half_sinc * np.cos(half), gamma, v)


def exp_one(rotvec: FloatArray) -> FloatArray:
    """`exp` of one rotation vector, shape (3,), in plain numbers: numpy takes ten times as long."""
    x, y, z = rotvec.tolist()
    angle2 = x * x + y * y + z * z
    half = 0.5 * math.sqrt(angle2 + _NO_ANGLE)
    half_sinc = math.sin(half) / half
    return rotation_one(x, y, z, math.sin(2.0 * half) / (2.0 * half), 0.5 * half_sinc * half_sinc)


def rotation_one(x: float, y: float, z: float, beta: float, gamma: float) -> FloatArray:
    """`polynomial` of one vector where it is a rotation: alpha = 1 - gamma v'v."""
    w = 1.0 - gamma * (x * x + y * y + z * z)
    return np.array(
        [
            [w + gamma * x * x, gamma * x * y - beta * z, gamma * x * z + beta * y],
            [gamma * x * y + beta * z, w + gamma * y * y, gamma * y * z - beta * x],
            [gamma * x * z - beta * y, gamma * y * z + beta * x, w + gamma * z * z],
        ]
    )


def log(R: FloatArray) -> FloatArray:
    """Return the rotation vectors (angle 0 to pi) of rotation matrices, accurate near 0 and near pi.

    Args:
        R: Rotation matrices, shape (..., 3, 3).

    Returns:
        Axis times angle, rad, shape (..., 3). At exactly pi either sign of the axis is right.
    """
    return rotvec_from_quat(quat_from_matrix(R))


def quat_from_rotvec(rotvec: FloatArray) -> FloatArray:
    """Return unit quaternions w x y z of rotation vectors (rad), shape (..., 4).

    The sign follows the angle: w < 0 for angles between pi and 3 pi.
    """
    v = np.asarray(rotvec, dtype=np.float64)
    angle = np.sqrt(np.vecdot(v, v))
    q = np.empty((*v.shape[:-1], 4))
    q[..., 0] = np.cos(0.5 * angle)
    q[..., 1:] = (0.5 * np.sinc(angle / (2.0 * np.pi)))[..., None] * v
    return q


def turn_between(q_a: FloatArray, q_b: FloatArray) -> FloatArray:
    """Return the rotation vectors (angle 0 to pi, rad) that lead from orientations to others, in their frame.

    Args:
        q_a: From, quaternions w x y z, shape (..., 4).
        q_b: To, likewise.
    """
    return rotvec_from_quat(quat_multiply(quat_conjugate(q_a), q_b))


def rotvec_from_quat(q: FloatArray) -> FloatArray:
    """Return rotation vectors (angle 0 to pi, rad) of quaternions w x y z; q and -q give the same.

    Args:
        q: Quaternions of unit length (small deviations do no harm), shape (..., 4).
    """
    q = np.asarray(q, dtype=np.float64)
    w = q[..., 0]
    v = q[..., 1:]
    norm = np.sqrt(np.vecdot(v, v))
    half = np.arctan2(norm, np.abs(w))
    # angle / sin(angle / 2): tends to 2 / |w| where the vector part vanishes
    small = norm < 1e-150
    scale = np.where(small, 2.0, 2.0 * half / np.where(small, 1.0, norm))
    out: FloatArray = np.where(w < 0.0, -scale, scale)[..., None] * v
    return out


def quat_multiply(p: FloatArray, q: FloatArray) -> FloatArray:
    """Return the Hamilton products `p * q` (rotation q first, then p), shape (..., 4)."""
    p = np.asarray(p, dtype=np.float64)
    q = np.asarray(q, dtype=np.float64)
    pw, px, py, pz = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    qw, qx, qy, qz = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    w = pw * qw - px * qx - py * qy - pz * qz
    out = np.empty((*np.shape(w), 4))
    out[..., 0] = w
    out[..., 1] = pw * qx + px * qw + py * qz - pz * qy
    out[..., 2] = pw * qy - px * qz + py * qw + pz * qx
    out[..., 3] = pw * qz + px * qy - py * qx + pz * qw
    return out


def quat_conjugate(q: FloatArray) -> FloatArray:
    """Return the inverse rotations of unit quaternions, shape (..., 4)."""
    out: FloatArray = np.asarray(q, dtype=np.float64) * np.array([1.0, -1.0, -1.0, -1.0])
    return out


def quat_normalise(q: FloatArray) -> FloatArray:
    """Return quaternions of unit length with w >= 0, shape (..., 4)."""
    q = np.asarray(q, dtype=np.float64)
    norm = np.sqrt(np.vecdot(q, q))
    out: FloatArray = q / np.where(q[..., 0] < 0.0, -norm, norm)[..., None]
    return out


def matrix_from_quat(q: FloatArray) -> FloatArray:
    """Return rotation matrices of unit quaternions w x y z, shape (..., 3, 3)."""
    q = np.asarray(q, dtype=np.float64)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    x2, y2, z2 = 2.0 * x, 2.0 * y, 2.0 * z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    out = np.empty((*np.shape(w), 3, 3))
    out[..., 0, 0] = 1.0 - (yy + zz)
    out[..., 0, 1] = xy - wz
    out[..., 0, 2] = xz + wy
    out[..., 1, 0] = xy + wz
    out[..., 1, 1] = 1.0 - (xx + zz)
    out[..., 1, 2] = yz - wx
    out[..., 2, 0] = xz - wy
    out[..., 2, 1] = yz + wx
    out[..., 2, 2] = 1.0 - (xx + yy)
    return out


def quat_from_matrix(R: FloatArray) -> FloatArray:
    """Return unit quaternions w x y z, w >= 0, of rotation matrices (Shepperd's method, batched).

    The matrix 4 q q' is linear in R; its column with the largest diagonal entry is q up to scale.

    Args:
        R: Rotation matrices, shape (..., 3, 3).

    Returns:
        Quaternions, shape (..., 4).
    """
    R = np.asarray(R, dtype=np.float64)
    r00, r11, r22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    N = np.empty((*R.shape[:-2], 4, 4))
    N[..., 0, 0] = 1.0 + r00 + r11 + r22
    N[..., 1, 1] = 1.0 + r00 - r11 - r22
    N[..., 2, 2] = 1.0 - r00 + r11 - r22
    N[..., 3, 3] = 1.0 - r00 - r11 + r22
    N[..., 0, 1] = N[..., 1, 0] = R[..., 2, 1] - R[..., 1, 2]
    N[..., 0, 2] = N[..., 2, 0] = R[..., 0, 2] - R[..., 2, 0]
    N[..., 0, 3] = N[..., 3, 0] = R[..., 1, 0] - R[..., 0, 1]
    N[..., 1, 2] = N[..., 2, 1] = R[..., 0, 1] + R[..., 1, 0]
    N[..., 1, 3] = N[..., 3, 1] = R[..., 0, 2] + R[..., 2, 0]
    N[..., 2, 3] = N[..., 3, 2] = R[..., 1, 2] + R[..., 2, 1]
    best = np.argmax(np.einsum("...ii->...i", N), axis=-1)
    q: FloatArray = np.take_along_axis(N, best[..., None, None], axis=-2)[..., 0, :]
    return quat_normalise(q)


def right_jacobian(rotvec: FloatArray) -> FloatArray:
    """Return Jr with `exp(v + d) ~ exp(v) @ exp(Jr(v) @ d)` for small d.

    Args:
        rotvec: Rotation vectors v, rad, shape (..., 3).

    Returns:
        Jacobians, shape (..., 3, 3); the left Jacobian is Jr(-v) = Jr(v)'.
    """
    v = np.asarray(rotvec, dtype=np.float64)
    a2 = np.vecdot(v, v)
    angle = np.sqrt(a2)
    half_sinc = np.sinc(angle / (2.0 * np.pi))
    sinc = np.sinc(angle / np.pi)
    small = angle < _SERIES_BELOW_RAD
    series = 1 / 6 + a2 * (-1 / 120 + a2 * (1 / 5040 + a2 * (-1 / 362880 + a2 / 39916800)))
    gamma = np.where(small, series, (1.0 - sinc) / np.where(small, 1.0, a2))
    return polynomial(sinc, -0.5 * half_sinc * half_sinc, gamma, v)


def right_jacobian_inverse(rotvec: FloatArray) -> FloatArray:
    """Return the inverse of `right_jacobian`: `log(exp(v) @ exp(d)) ~ v + Jr_inv(v) @ d`.

    Args:
        rotvec: Rotation vectors v, rad, shape (..., 3), shorter than 2 pi.

    Returns:
        Inverse Jacobians, shape (..., 3, 3).
    """
    v = np.asarray(rotvec, dtype=np.float64)
    a2 = np.vecdot(v, v)
    half = 0.5 * np.sqrt(a2)
    small = half < 0.5 * _SERIES_BELOW_RAD
    safe = np.where(small, 1.0, half)
    series = 1 / 12 + a2 * (1 / 720 + a2 * (1 / 30240 + a2 * (1 / 1209600 + a2 / 47900160)))
    alpha = np.where(small, 1.0 - series * a2, safe * np.cos(safe) / np.sin(safe))
    gamma = np.where(small, series, (1.0 - alpha) / np.where(small, 1.0, a2))
    return polynomial(alpha, np.full_like(alpha, 0.5), gamma, v)


def tangents(unit: FloatArray) -> FloatArray:
    """Two unit vectors across each unit vector, shape (n, 3, 2): a Householder frame of the nearer half."""
    x, y, z = unit[:, 0], unit[:, 1], unit[:, 2]
    sign = np.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    out = np.empty((len(unit), 3, 2))
    out[:, :, 0] = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    out[:, :, 1] = np.stack([b, sign + y * y * a, -y], axis=1)
    return out


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product over the last axis; a fifth of the time of numpy's for small batches."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotations R that maximise trace(R' M), shape (..., 3, 3) (orthogonal Procrustes, Wahba).

    For pairs of vectors a, b with a ~ R b, M is the sum of a b'.
    """
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt)


def signed_permutations() -> FloatArray:
    """Return all matrices that permute axes and change their signs, shape (48, 3, 3).

    Those with determinant 1 are the rotations of a cube: any rotation is within 63 degrees of one.
    """
    orders, signs = permutations(range(3)), list(product((1.0, -1.0), repeat=3))
    return np.array([np.diag(sign) @ np.eye(3)[list(order)] for order in orders for sign in signs])
