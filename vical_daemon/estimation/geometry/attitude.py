"""More ways to write an attitude: modified Rodrigues parameters, GRP errors, yaw-pitch-roll, and time rates.

All describe the same `R_a_b` (maps b vectors into a) as `so3`, and all products read like matrix products:
`mrp_compose(s, t)` is `R(s) @ R(t)`. Rates take the angular velocity of b relative to a, written in b (what a
gyro fixed to b measures). Batched over leading axes.

Modified Rodrigues parameters (MRP): `s = axis tan(angle / 4)`. They are singular only at 360 degrees.
Their "shadow" set -s / |s|^2 names the same rotation by its other quaternion sign: switching to it where
|s| > 1 keeps |s| <= 1 for ever.
Equations: Schaub & Junkins; Crassidis & Markley (2003) for the generalised set (GRP).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3

FloatArray = npt.NDArray[np.float64]

_GIMBAL_COS = 1e-7  # cosine of pitch below which yaw and roll turn about one axis
_EYE = np.eye(3)


def _dot(u: FloatArray, v: FloatArray) -> FloatArray:
    out: FloatArray = np.einsum("...i,...i->...", u, v)
    return out


def _outer(u: FloatArray, v: FloatArray) -> FloatArray:
    out: FloatArray = u[..., :, None] * v[..., None, :]
    return out


# --- modified Rodrigues parameters ---


def mrp_from_quat(q: FloatArray) -> FloatArray:
    """Return the inner MRP set (|s| <= 1) of unit quaternions w x y z, shape (..., 3)."""
    q = np.asarray(q, dtype=np.float64)
    sign = np.where(q[..., 0] < 0.0, -1.0, 1.0)
    out: FloatArray = (sign / (1.0 + np.abs(q[..., 0])))[..., None] * q[..., 1:]
    return out


def quat_from_mrp(s: FloatArray) -> FloatArray:
    """Return unit quaternions of MRPs, shape (..., 4); w < 0 where |s| > 1."""
    s = np.asarray(s, dtype=np.float64)
    s2 = _dot(s, s)
    q = np.empty((*s.shape[:-1], 4))
    q[..., 0] = (1.0 - s2) / (1.0 + s2)
    q[..., 1:] = (2.0 / (1.0 + s2))[..., None] * s
    return q


def mrp_from_rotvec(rotvec: FloatArray) -> FloatArray:
    """Return the inner MRP set of rotation vectors (rad), shape (..., 3)."""
    return mrp_from_quat(so3.quat_from_rotvec(rotvec))


def rotvec_from_mrp(s: FloatArray) -> FloatArray:
    """Return rotation vectors (angle 0 to pi, rad) of MRPs of either set, shape (..., 3)."""
    return so3.rotvec_from_quat(quat_from_mrp(s))


def matrix_from_mrp(s: FloatArray) -> FloatArray:
    """Return rotation matrices (direction cosines) of MRPs, shape (..., 3, 3)."""
    return so3.matrix_from_quat(quat_from_mrp(s))


def mrp_shadow(s: FloatArray) -> FloatArray:
    """Return the other set of the same rotations, -s / |s|^2; s must not vanish. Shape (..., 3)."""
    s = np.asarray(s, dtype=np.float64)
    out: FloatArray = -s / _dot(s, s)[..., None]
    return out


def mrp_switch(s: FloatArray) -> FloatArray:
    """Return the set with |s| <= 1, switching to the shadow where needed, shape (..., 3)."""
    s = np.asarray(s, dtype=np.float64)
    s2 = _dot(s, s)[..., None]
    out: FloatArray = np.where(s2 > 1.0, -s / np.where(s2 > 1.0, s2, 1.0), s)
    return out


def mrp_shadow_jacobian(s: FloatArray) -> FloatArray:
    """Return d(shadow)/ds, which carries a covariance through the switch, shape (..., 3, 3)."""
    s = np.asarray(s, dtype=np.float64)
    s2 = _dot(s, s)[..., None, None]
    out: FloatArray = (2.0 * _outer(s, s) / s2 - _EYE) / s2
    return out


def mrp_compose(s: FloatArray, t: FloatArray) -> FloatArray:
    """Return the MRPs of `R(s) @ R(t)`.

    Singular only where the product is a whole turn in the sets given; compose through quaternions there.

    Args:
        s: MRPs of the left rotation, shape (..., 3).
        t: MRPs of the right rotation, shape (..., 3).
    """
    s2, t2 = _dot(s, s)[..., None], _dot(t, t)[..., None]
    numerator = (1.0 - t2) * s + (1.0 - s2) * t + 2.0 * np.cross(s, t)
    out: FloatArray = numerator / (1.0 + s2 * t2 - 2.0 * _dot(s, t)[..., None])
    return out


def mrp_compose_jacobians(s: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of `mrp_compose(s, t)` by s and by t, each (..., 3, 3)."""
    s2, t2 = _dot(s, s)[..., None], _dot(t, t)[..., None]
    D = (1.0 + s2 * t2 - 2.0 * _dot(s, t)[..., None])[..., None]
    c = mrp_compose(s, t)
    by_s = (
        (1.0 - t2)[..., None] * _EYE
        - 2.0 * _outer(t, s)
        - 2.0 * so3.hat(t)
        - _outer(c, 2.0 * t2 * s - 2.0 * t)
    )
    by_t = (
        (1.0 - s2)[..., None] * _EYE
        - 2.0 * _outer(s, t)
        + 2.0 * so3.hat(s)
        - _outer(c, 2.0 * s2 * t - 2.0 * s)
    )
    return by_s / D, by_t / D


def mrp_rate_matrix(s: FloatArray) -> FloatArray:
    """Return B / 4 with ds/dt = (B / 4) w, w in the b frame, rad/s; shape (..., 3, 3)."""
    s = np.asarray(s, dtype=np.float64)
    s2 = _dot(s, s)[..., None, None]
    out: FloatArray = 0.25 * ((1.0 - s2) * _EYE + 2.0 * so3.hat(s) + 2.0 * _outer(s, s))
    return out


def mrp_rate(s: FloatArray, rate_rps: FloatArray) -> FloatArray:
    """Return ds/dt for the angular velocity of b in a, written in b (rad/s), shape (..., 3)."""
    out: FloatArray = np.einsum("...ij,...j->...i", mrp_rate_matrix(s), rate_rps)
    return out


def mrp_rate_jacobian(s: FloatArray, rate_rps: FloatArray) -> FloatArray:
    """Return the derivative of `mrp_rate` by s, 1/s, (..., 3, 3); by the rate it is `mrp_rate_matrix`."""
    s, w = np.asarray(s, dtype=np.float64), np.asarray(rate_rps, dtype=np.float64)
    out: FloatArray = 0.5 * (_outer(s, w) - _outer(w, s) - so3.hat(w) + _dot(s, w)[..., None, None] * _EYE)
    return out


def mrp_tangent(s: FloatArray) -> FloatArray:
    """Return d(local rotation)/ds: `R(s + ds) = R(s) exp(mrp_tangent(s) ds)`, shape (..., 3, 3).

    The inverse of `mrp_rate_matrix`: 16 (B/4)' / (1 + |s|^2)^2.
    """
    s = np.asarray(s, dtype=np.float64)
    s2 = _dot(s, s)[..., None, None]
    out: FloatArray = 16.0 / (1.0 + s2) ** 2 * np.swapaxes(mrp_rate_matrix(s), -1, -2)
    return out


def mrp_rotate_jacobian(s: FloatArray, v: FloatArray) -> FloatArray:
    """Return d(R(s) v)/ds, shape (..., 3, 3)."""
    out: FloatArray = -matrix_from_mrp(s) @ so3.hat(np.asarray(v, dtype=np.float64)) @ mrp_tangent(s)
    return out


# --- generalised Rodrigues parameters: the attitude error of the unscented quaternion estimator ---


def grp_from_quat(q: FloatArray, a: float = 1.0) -> FloatArray:
    """Return GRP errors f d / (a + w) of error quaternions; f = 2 (a + 1) makes small ones rotation vectors.

    Args:
        q: Error quaternions w x y z; the sign with w >= 0 is taken, shape (..., 4).
        a: 0 gives twice Gibbs' vector (singular at 180 deg), 1 four times the MRP (singular at 360 deg).

    Returns:
        Errors, rad for small angles, shape (..., 3).
    """
    q = np.asarray(q, dtype=np.float64)
    sign = np.where(q[..., 0] < 0.0, -1.0, 1.0)
    f = 2.0 * (a + 1.0)
    out: FloatArray = (f * sign / (a + np.abs(q[..., 0])))[..., None] * q[..., 1:]
    return out


def quat_from_grp(p: FloatArray, a: float = 1.0) -> FloatArray:
    """Return unit error quaternions of GRP errors with f = 2 (a + 1), shape (..., 4)."""
    p = np.asarray(p, dtype=np.float64)
    f = 2.0 * (a + 1.0)
    p2 = _dot(p, p)
    w = (-a * p2 + f * np.sqrt(f * f + (1.0 - a * a) * p2)) / (f * f + p2)
    q = np.empty((*p.shape[:-1], 4))
    q[..., 0] = w
    q[..., 1:] = ((a + w) / f)[..., None] * p
    return q


# --- yaw, pitch, roll ---


def matrix_from_ypr(ypr: FloatArray) -> FloatArray:
    """Return Rz(yaw) Ry(pitch) Rx(roll) of angles in rad, shape (..., 3) to (..., 3, 3)."""
    ypr = np.asarray(ypr, dtype=np.float64)
    cy, cp, cr = (np.cos(ypr[..., i]) for i in range(3))
    sy, sp, sr = (np.sin(ypr[..., i]) for i in range(3))
    R = np.empty((*ypr.shape, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = -sp, cp * sr, cp * cr
    return R


def ypr_from_matrix(R: FloatArray) -> FloatArray:
    """Return yaw, pitch, roll (rad) of rotation matrices, pitch in [-90, 90] deg, shape (..., 3).

    At pitch = +-90 deg only one of yaw and roll is determined: roll is set to 0 there.
    """
    R = np.asarray(R, dtype=np.float64)
    cp = np.hypot(R[..., 0, 0], R[..., 1, 0])
    locked = cp < _GIMBAL_COS
    out = np.empty(R.shape[:-1])
    out[..., 0] = np.where(
        locked, np.arctan2(-R[..., 0, 1], R[..., 1, 1]), np.arctan2(R[..., 1, 0], R[..., 0, 0])
    )
    out[..., 1] = np.arctan2(-R[..., 2, 0], cp)
    out[..., 2] = np.where(locked, 0.0, np.arctan2(R[..., 2, 1], R[..., 2, 2]))
    return out


def ypr_rate_matrix(ypr: FloatArray) -> FloatArray:
    """Return E with w = E d(ypr)/dt, w the angular velocity written in b; shape (..., 3, 3).

    Its inverse (singular at pitch = +-90 deg) gives the angles' rates.
    """
    ypr = np.asarray(ypr, dtype=np.float64)
    cp, sp = np.cos(ypr[..., 1]), np.sin(ypr[..., 1])
    cr, sr = np.cos(ypr[..., 2]), np.sin(ypr[..., 2])
    E = np.zeros((*ypr.shape, 3))
    E[..., 0, 0], E[..., 0, 2] = -sp, 1.0
    E[..., 1, 0], E[..., 1, 1] = cp * sr, cr
    E[..., 2, 0], E[..., 2, 1] = cp * cr, -sr
    return E


def ypr_rate(ypr: FloatArray, rate_rps: FloatArray) -> FloatArray:
    """Return d(ypr)/dt, rad/s, for the angular velocity written in b; undefined at pitch = +-90 deg."""
    E = ypr_rate_matrix(ypr)
    rate = np.asarray(rate_rps, dtype=np.float64)[..., None]
    return np.asarray(np.linalg.solve(E, rate)[..., 0], dtype=np.float64)


# --- time rates of matrices and quaternions ---


def matrix_rate(R: FloatArray, rate_rps: FloatArray) -> FloatArray:
    """Return dR_a_b/dt = R hat(w), w written in b, rad/s; shape (..., 3, 3)."""
    out: FloatArray = np.asarray(R, dtype=np.float64) @ so3.hat(rate_rps)
    return out


def quat_rate(q: FloatArray, rate_rps: FloatArray) -> FloatArray:
    """Return dq_a_b/dt = 1/2 q * (0, w), w written in b, rad/s; shape (..., 4)."""
    w = np.asarray(rate_rps, dtype=np.float64)
    pure = np.concatenate((np.zeros_like(w[..., :1]), w), axis=-1)
    return 0.5 * so3.quat_multiply(q, pure)
