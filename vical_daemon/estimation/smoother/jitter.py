"""Stamps that jitter, in a window: images were taken a little before or after the instants of their stamps.

The states of a window belong to the exposures, the inertial links to the stamps. Image k was exposed tau_k
late, so the link between k and k + 1 sees its states moved back along their motion, x_k - tau_k dx_k/dt:

    e = e_0 + B tau,   tau ~ N(0, sigma^2)

Pixels know nothing of tau, and a link contains two of them. So they are eliminated at once: with
M = B'B + I / sigma^2, which is tridiagonal, J'J becomes J'J - J'B M^-1 B'J. [docs/math/target_free.md, (2)]
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.noise.stamp_jitter import excess
from vical_daemon.estimation.smoother.window import IntArray, Window

_OPEN_S = 1.0  # as good as no prior, where a rig that stands still shows nothing


class StampOffsets:
    """The delays tau of the stamps of a window, given its motion.

    Args:
        window: Its motion.
        e: Whitened errors of the links, shape (F - 1, 9).
        J: Their derivatives by [turn, p, v] of both ends, and more, shape (F - 1, 9, >= 18).
        sigma_s: Standard deviation of tau, s.
    """

    def __init__(self, window: Window, e: FloatArray, J: FloatArray, sigma_s: float = _OPEN_S) -> None:
        motion = _motion(window)
        self._begin = -np.matmul(J[:, :, :9], motion[:-1, :, None])[..., 0]
        self._end = -np.matmul(J[:, :, 9:18], motion[1:, :, None])[..., 0]
        F = len(motion)
        M = np.diag(np.full(F, sigma_s**-2))
        k = np.arange(F - 1)
        M[k, k] += (self._begin**2).sum(axis=1)
        M[k + 1, k + 1] += (self._end**2).sum(axis=1)
        M[k, k + 1] = M[k + 1, k] = (self._begin * self._end).sum(axis=1)
        self._root = cholesky(M, lower=True)
        self._right = np.zeros(F)
        self._right[:-1] += (self._begin * e).sum(axis=1)
        self._right[1:] += (self._end * e).sum(axis=1)

    def explained(self) -> float:
        """By how much the sum of squares falls when the delays are free."""
        half = solve_triangular(self._root, self._right, lower=True)
        return float(half @ half)

    def delays(self) -> tuple[FloatArray, FloatArray]:
        """Most likely tau for these states, and their variances if the states were exact, shapes (F,)."""
        inverse = cho_solve((self._root, True), np.eye(len(self._root)))
        return -inverse @ self._right, inverse.diagonal().copy()

    def alike(self) -> float:
        """Correlation of neighbouring delays: 0 for jitter, near 1 if the time shift has changed."""
        tau = self.delays()[0]
        size = float(tau @ tau)
        return float(tau[1:] @ tau[:-1]) / size if size else 0.0  # 0: at rest nothing shows delays

    def by_states(self, J: FloatArray, at: IntArray, size: int) -> FloatArray:
        """B'J over all states, shape (F, size); `at` (F - 1, c): where the columns of J live."""
        G = np.zeros((len(self._root), size))
        k = np.arange(len(at))[:, None]
        G[k, at] += np.einsum("mi,mic->mc", self._begin, J)
        G[k + 1, at] += np.einsum("mi,mic->mc", self._end, J)
        return G

    def eliminate(self, H: FloatArray, g: FloatArray, J: FloatArray, at: IntArray) -> None:
        """Take the delays out of normal equations that contain J'J and J'e, in place."""
        G = self.by_states(J, at, len(g))
        half = solve_triangular(self._root, np.column_stack([G, self._right]), lower=True)
        H -= half[:, :-1].T @ half[:, :-1]
        g -= half[:, :-1].T @ half[:, -1]

    def mean_square(self, J: FloatArray, at: IntArray, root: FloatArray) -> float:
        """Expected tau^2 with the states as uncertain as they are, s^2: one step of EM for sigma^2.

        Args:
            J: See above.
            at: See above.
            root: Lower Cholesky factor of the normal matrix of the states.
        """
        tau, own = self.delays()
        G = self.by_states(J, at, len(root))
        gain = cho_solve((self._root, True), G)
        spread = solve_triangular(root, gain.T, lower=True)
        return float(np.mean(tau**2 + own + (spread**2).sum(axis=0)))


def first_guess(window: Window, e: FloatArray, J: FloatArray) -> float:
    """Jitter, s, that errors of links show whose stamps were believed; 0 where it may be chance."""
    tau, variance = StampOffsets(window, e, J).delays()
    return excess(tau**2, variance)


def _motion(window: Window) -> FloatArray:
    """[turning rate in the imu frame, velocity, acceleration in the world] at each image, shape (F, 9)."""
    t = np.array([s for s, _ in window.frames])
    return np.concatenate([window.rates(), window.v, np.gradient(window.v, t, axis=0)], axis=1)
