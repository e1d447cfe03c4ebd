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

from vical_daemon.estimation import so3
from vical_daemon.estimation.free_window import IntArray, Window
from vical_daemon.estimation.inertial_links import Links
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.stamp_jitter import excess

_OPEN_S = 1.0  # as good as no prior, where a rig that stands still shows nothing
_MOST_S = 0.02  # beyond, the motion is no parabola


class Lateness:
    """The delays tau of the stamps of a window, given its motion; linear about the delays believed last.

    Positions are known to micrometres from one image to the next, and a tau^2 / 2 does not average out: the
    motion from exposure to stamp is a parabola.

    Args:
        window: Its motion; the delays found are kept in it.
        links: Between its images.
        sigma_s: Standard deviation of tau, s.
        rounds: Linearisations.
    """

    def __init__(self, window: Window, links: Links, sigma_s: float = _OPEN_S, rounds: int = 2) -> None:
        motion, change = _motion(window)
        F, knots = len(motion), window.knots()
        tau = np.zeros(F)
        tau[: len(window.late_s)] = window.late_s[:F]
        for _ in range(rounds):
            R, p, v = _moved_back(window, motion, change, tau)
            e, self.J = links.errors(R, p, v, window.bias[knots], window.gravity)
            speed = motion + change * tau[:, None]
            self._begin = -np.matmul(self.J[:, :, :9], speed[:-1, :, None])[..., 0]
            self._end = -np.matmul(self.J[:, :, 9:18], speed[1:, :, None])[..., 0]
            self.e = e - self._begin * tau[:-1, None] - self._end * tau[1:, None]
            # position at the stamp: p - v tau
            self.J[:, :, 6:9] -= tau[:-1, None, None] * self.J[:, :, 3:6]
            self.J[:, :, 15:18] -= tau[1:, None, None] * self.J[:, :, 12:15]
            self._eliminable(sigma_s)
            tau = np.clip(self.delays()[0], -_MOST_S, _MOST_S)
        window.late_s = tau

    def _eliminable(self, sigma_s: float) -> None:
        """Root of M = B'B + I / sigma^2, and B'e."""
        F = len(self.e) + 1
        M = np.diag(np.full(F, sigma_s**-2))
        k = np.arange(F - 1)
        M[k, k] += (self._begin**2).sum(axis=1)
        M[k + 1, k + 1] += (self._end**2).sum(axis=1)
        M[k, k + 1] = M[k + 1, k] = (self._begin * self._end).sum(axis=1)
        self._root = cholesky(M, lower=True)
        self._right = np.zeros(F)
        self._right[:-1] += (self._begin * self.e).sum(axis=1)
        self._right[1:] += (self._end * self.e).sum(axis=1)

    def explained(self) -> float:
        """By how much the sum of squares falls when the delays are free."""
        half = solve_triangular(self._root, self._right, lower=True)
        return float(half @ half)

    def delays(self) -> tuple[FloatArray, FloatArray]:
        """Most likely tau for these states, and their variances if the states were exact, shapes (F,)."""
        inverse = cho_solve((self._root, True), np.eye(len(self._root)))
        return -inverse @ self._right, inverse.diagonal().copy()

    def by_states(self, at: IntArray, size: int) -> FloatArray:
        """B'J over all states, shape (F, size); `at` (F - 1, c): where the columns of J live."""
        G = np.zeros((len(self._root), size))
        k = np.arange(len(at))[:, None]
        G[k, at] += np.einsum("mi,mic->mc", self._begin, self.J)
        G[k + 1, at] += np.einsum("mi,mic->mc", self._end, self.J)
        return G

    def eliminate(self, H: FloatArray, g: FloatArray, at: IntArray) -> None:
        """Take the delays out of normal equations that contain J'J and J'e, in place."""
        G = self.by_states(at, len(g))
        half = solve_triangular(self._root, np.column_stack([G, self._right]), lower=True)
        H -= half[:, :-1].T @ half[:, :-1]
        g -= half[:, :-1].T @ half[:, -1]

    def mean_square(self, at: IntArray, root: FloatArray) -> float:
        """Expected tau^2 with the states as uncertain as they are, s^2: one step of EM for sigma^2.

        Args:
            at: See `by_states`.
            root: Lower Cholesky factor of the normal matrix of the states.
        """
        tau, own = self.delays()
        G = self.by_states(at, len(root))
        gain = cho_solve((self._root, True), G)
        spread = solve_triangular(root, gain.T, lower=True)
        return float(np.mean(tau**2 + own + (spread**2).sum(axis=0)))


def first_guess(window: Window, links: Links) -> float:
    """Jitter, s, that errors of links show whose stamps were believed; 0 where it may be chance."""
    believed = window.late_s
    tau, variance = Lateness(window, links, rounds=1).delays()
    window.late_s = believed
    return excess(tau**2, variance)


def _motion(window: Window) -> tuple[FloatArray, FloatArray]:
    """[turning rate in the imu frame, velocity, acceleration in the world] at each image, and their changes.

    Velocities are those of the exposure, rates and accelerations those of the stamp: so the velocity changes
    by -acceleration on the way back.
    """
    t = np.array([s for s, _ in window.frames])
    rates, push = window.rates(), window.accelerations()
    motion = np.concatenate([rates, window.v, push], axis=1)
    turn, jerk = np.gradient(rates, t, axis=0), np.gradient(push, t, axis=0)
    return motion, np.concatenate([turn, -push, jerk], axis=1)


def _moved_back(
    window: Window, motion: FloatArray, change: FloatArray, tau: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Attitude, position and velocity at the stamps, to second order in tau."""
    step = motion * tau[:, None] + 0.5 * change * tau[:, None] ** 2
    return window.R @ so3.exp(-step[:, :3]), window.p - step[:, 3:6], window.v - step[:, 6:]
