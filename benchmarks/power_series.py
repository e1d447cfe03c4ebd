"""Arithmetic on truncated power series in time: arrays whose first axis is the order of the coefficient.

Complex numbers, so that derivatives by what enters can be taken with the complex step.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

ComplexArray = npt.NDArray[np.complex128]


def mul(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    """Product of two series; further axes broadcast."""
    out = np.zeros((len(a), *np.broadcast_shapes(a.shape[1:], b.shape[1:])), dtype=np.complex128)
    for i in range(len(a)):
        out[i:] += a[i] * b[: len(a) - i]
    return out


def div(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    """Quotient of two series."""
    out = np.zeros((len(a), *np.broadcast_shapes(a.shape[1:], b.shape[1:])), dtype=np.complex128)
    for k in range(len(a)):
        rest = a[k] - sum((out[i] * b[k - i] for i in range(k)), start=np.zeros_like(out[0]))
        out[k] = rest / b[0]
    return out


def matmul(A: ComplexArray, b: ComplexArray) -> ComplexArray:
    """Matrix series (K, 3, 3) times vector series (K, ..., 3)."""
    out = np.zeros_like(b)
    for i in range(len(A)):
        out[i:] += np.einsum("ij,k...j->k...i", A[i], b[: len(A) - i])
    return out


def trajectory(
    R0: ComplexArray, v0: ComplexArray, p0: ComplexArray, g: ComplexArray, w: ComplexArray, f: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Series of attitude and position: R' = R hat(w), v' = R f + g, p' = v."""
    K = len(w)
    R = np.zeros((K, 3, 3), dtype=np.complex128)
    v, p = np.zeros((K, 3), dtype=np.complex128), np.zeros((K, 3), dtype=np.complex128)
    R[0], v[0], p[0] = R0, v0, p0
    S = np.zeros((K, 3, 3), dtype=np.complex128)
    S[:, 2, 1], S[:, 0, 2], S[:, 1, 0] = w[:, 0], w[:, 1], w[:, 2]
    S -= np.swapaxes(S, 1, 2)
    for k in range(K - 1):
        R[k + 1] = sum(R[i] @ S[k - i] for i in range(k + 1)) / (k + 1)
    a = matmul(R, f)
    a[0] += g
    for k in range(K - 1):
        v[k + 1] = a[k] / (k + 1)
        p[k + 1] = v[k] / (k + 1)
    return R, p


def shift(series: ComplexArray, delay: ComplexArray) -> ComplexArray:
    """Series of y(t + delay(t)) about t, to first order in the delay (its nominal value is zero)."""
    slope = np.zeros_like(series)
    slope[:-1] = series[1:] * np.arange(1, len(series)).reshape(-1, *([1] * (series.ndim - 1)))
    return series + mul(delay, slope)


def exp(v: ComplexArray) -> ComplexArray:
    """Return the rotation matrix of a vector that is real of any size or imaginary and tiny."""
    S = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    angle2 = complex(v @ v)
    if abs(angle2) < 1e-40:
        return np.asarray(np.eye(3) + S, dtype=np.complex128)
    angle = np.sqrt(angle2)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * S + (1 - np.cos(angle)) / angle2 * S @ S)
