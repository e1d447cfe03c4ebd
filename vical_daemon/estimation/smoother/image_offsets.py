"""What moves a whole image of a window: a stamp that jitters, a camera or detector that shakes.

The states of a window are those that the pixels show; the inertial links belong to the stamps. Image k was
exposed tau_k late, and lies s_k px to the side and down. So the link between k and k + 1 sees its states
moved back, along their motion and by the turn of the camera that moves the image as much:

    e = e_0 + B o,   o = [tau, s] of each image ~ N(0, diag(sigma^2))

Pixels know nothing of o, and a link contains two of them. So they are eliminated at once: with
M = B'B + 1 / sigma^2, which is block-tridiagonal, J'J becomes J'J - J'B M^-1 B'J.
[docs/math/target_free.md, (2)]
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.smoother.window import IntArray, Window

LATE, SHIFTED = slice(0, 1), slice(1, 3)
"""The ways in which an image may be off: late (s); to the side and down (px)."""
FLOORS = np.array([2e-5, 2e-2, 2e-2])  # s, px, px: less is none; with a board the grid of shifts begins there


class ImageOffsets:
    """What the images of a window are off by, given its motion.

    Args:
        window: Its motion.
        e: Whitened errors of the links, shape (F - 1, 9).
        J: Their derivatives by [turn, p, v] of both ends, and more, shape (F - 1, 9, >= 18).
        sigmas: Standard deviation in each way, s, px, px, shape (3,); ways with zeros are left out.
    """

    def __init__(self, window: Window, e: FloatArray, J: FloatArray, sigmas: FloatArray) -> None:
        self.ways = np.flatnonzero(sigmas)
        moves = window.moves[:, :, self.ways]
        self._begin = -np.matmul(J[:, :, :9], moves[:-1])
        self._end = -np.matmul(J[:, :, 9:18], moves[1:])
        F, n = len(moves), len(self.ways)
        M = self._with(self)
        self._information = M.diagonal().copy()
        self._prior = sigmas[self.ways] ** -2.0
        M[np.diag_indices(F * n)] += np.tile(self._prior, F)
        self._root = cholesky(M, lower=True)
        right = np.zeros((F, n))
        right[:-1] += np.matvec(np.swapaxes(self._begin, 1, 2), e)
        right[1:] += np.matvec(np.swapaxes(self._end, 1, 2), e)
        self._right = right.ravel()

    def _with(self, other: ImageOffsets) -> FloatArray:
        """B'B with the B of other ways, shape (F n, F m)."""
        F, n, m = len(self._begin) + 1, len(self.ways), len(other.ways)
        out = np.zeros((F, n, F, m))
        k = np.arange(F - 1)
        begin, end = np.swapaxes(self._begin, 1, 2), np.swapaxes(self._end, 1, 2)
        out[k, :, k, :] += begin @ other._begin
        out[k + 1, :, k + 1, :] += end @ other._end
        out[k, :, k + 1, :] = begin @ other._end
        out[k + 1, :, k, :] = end @ other._begin
        return out.reshape(F * n, F * m)

    def explained(self) -> float:
        """By how much the sum of squares falls when the offsets are free."""
        half = solve_triangular(self._root, self._right, lower=True)
        return float(half @ half)

    def likely(self) -> tuple[FloatArray, FloatArray]:
        """Most likely offsets for these states, and their variances if those were exact, shapes (F, n)."""
        inverse = cho_solve((self._root, True), np.eye(len(self._root)))
        shape = -1, len(self.ways)
        return (-inverse @ self._right).reshape(shape), inverse.diagonal().reshape(shape).copy()

    def left(self, e: FloatArray) -> FloatArray:
        """Errors of the links without the most likely offsets, shape (F - 1, 9)."""
        o = self.likely()[0]
        return np.asarray(e + np.matvec(self._begin, o[:-1]) + np.matvec(self._end, o[1:]))

    def shown(self, by_pixels: FloatArray, allowed: ImageOffsets | None) -> tuple[FloatArray, FloatArray]:
        """Squared offsets that errors show which nothing has allowed for, and their variances by chance.

        An image that is off is torn between its links and its pixels. Once the states are adjusted both pull
        alike, by o / (1 / a + 1 / b) with their information a and b about its offset o. (Its neighbours count
        as exact: the variances are at least so large.)

        Args:
            by_pixels: Information of the pixels of each image about its offsets in all ways, shape (F, 3, 3).
            allowed: Offsets in other ways, if some are allowed for; the errors are then those `left` by them.

        Returns:
            Both of shape (m,), m at most F n: images of which links or pixels know nothing say nothing.
        """
        of_pixels = by_pixels[:, self.ways[:, None], self.ways]
        by_links = self._information
        if allowed is not None:
            taken = solve_triangular(allowed._root, allowed._with(self), lower=True)
            by_links = by_links - (taken**2).sum(axis=0)
            held = allowed.likely()[1] * allowed._prior  # of links about the states in the ways allowed for
            of_allowed = by_pixels[:, allowed.ways[:, None], allowed.ways].copy()
            k = np.arange(len(allowed.ways))
            of_allowed[:, k, k] += allowed._prior * (1.0 - held)
            both = by_pixels[:, allowed.ways[:, None], self.ways]
            of_pixels = of_pixels - np.swapaxes(both, 1, 2) @ np.linalg.solve(of_allowed, both)
        pixels = np.diagonal(of_pixels, axis1=1, axis2=2).ravel()
        least = 1e-6 * by_pixels[:, self.ways, self.ways].ravel()
        known = (by_links > 1e-6 * self._information) & (pixels > least)  # more than rounding
        usual = 1.0 / by_links[known] + 1.0 / pixels[known]
        return (self._right[known] * usual) ** 2, usual

    def alike(self) -> float:
        """Correlation of neighbouring delays: 0 for jitter, near 1 if the time shift has changed."""
        if 0 not in self.ways:
            return 0.0
        tau = self.likely()[0][:, 0]
        size = float(tau @ tau)
        return float(tau[1:] @ tau[:-1]) / size if size else 0.0  # 0: at rest nothing shows delays

    def by_states(self, J: FloatArray, at: IntArray, size: int) -> FloatArray:
        """B'J over all states, shape (F n, size); `at` (F - 1, c): where the columns of J live."""
        F, n = len(at) + 1, len(self.ways)
        G = np.zeros((F, n, size))
        k, way = np.arange(F - 1)[:, None, None], np.arange(n)[None, :, None]
        G[k, way, at[:, None, :]] += np.swapaxes(self._begin, 1, 2) @ J
        G[k + 1, way, at[:, None, :]] += np.swapaxes(self._end, 1, 2) @ J
        return G.reshape(F * n, size)

    def eliminate(self, H: FloatArray, g: FloatArray, J: FloatArray, at: IntArray) -> None:
        """Take the offsets out of normal equations that contain J'J and J'e, in place."""
        G = self.by_states(J, at, len(g))
        half = solve_triangular(self._root, np.column_stack([G, self._right]), lower=True)
        H -= half[:, :-1].T @ half[:, :-1]
        g -= half[:, :-1].T @ half[:, -1]

    def mean_squares(self, J: FloatArray, at: IntArray, root: FloatArray) -> FloatArray:
        """Expected squares with the states as uncertain as they are: one step of EM for sigma^2, shape (3,).

        Args:
            J: See above.
            at: See above.
            root: Lower Cholesky factor of the normal matrix of the states.
        """
        likely, own = self.likely()
        G = self.by_states(J, at, len(root))
        gain = cho_solve((self._root, True), G)
        spread = (solve_triangular(root, gain.T, lower=True) ** 2).sum(axis=0).reshape(own.shape)
        out = np.zeros(3)
        out[self.ways] = np.mean(likely**2 + own + spread, axis=0)
        return out


def moves(window: Window) -> FloatArray:
    """[turn, p, v] of each image by the second and by the px to the side and down, shape (F, 9, 3).

    By the second: turning rate in the imu frame, velocity, acceleration in the world.
    """
    late = np.concatenate([window.rates(), window.v, window.accelerations()[1]], axis=1)
    out = np.zeros((len(late), 9, 3))
    out[:, :, 0] = late
    camera = window.camera
    out[:, :3, 1] = -camera.R_imu_cam[:, 1] / camera.intrinsics[0]
    out[:, :3, 2] = camera.R_imu_cam[:, 0] / camera.intrinsics[1]
    return out
