"""The inertial side of a window: links between images, biases that walk, images that are off.

A stamp jitters, a camera or detector shakes: both move a whole image. The states of a window are those that
the pixels show; the inertial links belong to the stamps. Image k was exposed tau_k late, and lies s_k px to
the side and down. So the link between k and k + 1 sees its states moved back, along their motion and by the
turn of the camera that moves the image as much:

    e = e_0 + B o,   o = [tau, s] of each image ~ N(0, diag(sigma^2))

Pixels know nothing of o, and a link contains two of them. So they are eliminated at once: with
M = B'B + 1 / sigma^2, which is block-tridiagonal, J'J becomes J'J - J'B M^-1 B'J.
[docs/math/target_free.md, (2)]
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.noise.shared_errors import JITTERS_S, SHIFTS_PX
from vical_daemon.estimation.robust import MEDIAN_CHI2, MOST_STEPS
from vical_daemon.estimation.significance import SURE_SIGMAS
from vical_daemon.estimation.smoother.window import KNOT_S, IntArray, Window

LATE, SHIFTED = slice(0, 1), slice(1, 3)
"""The ways in which an image may be off: late (s); to the side and down (px)."""
FLOORS = np.array([JITTERS_S[1], SHIFTS_PX[1], SHIFTS_PX[1]])  # s, px, px: less is none, as with a board


class Order:
    """Places of the unknowns.

    Images but the last, knots but the last, the window's own lens, last image, last knot, constants, jumps.

    Args:
        F: Images.
        K: Knots.
        constants: Of camera and imu.
        of_imu: The first so many of them are gravity and the numbers of the imu, which move no pixel.
        own: Errors of the window's own lens.
        jumps: Numbers of the clocks' jumps.

    Attributes:
        camera: Those that move pixels: of the constants, and the window's own lens.
    """

    def __init__(self, F: int, K: int, constants: int, of_imu: int = 0, own: int = 0, jumps: int = 0) -> None:
        self.size = 9 * F + 6 * K + own + constants + jumps
        self.tail = 9 * (F - 1) + 6 * (K - 1) + own
        self.own = self.tail - own + np.arange(own)
        frames = np.arange(9 * (F - 1)).reshape(F - 1, 9)
        knots = 9 * (F - 1) + np.arange(6 * (K - 1)).reshape(K - 1, 6)
        self.frames = np.concatenate([frames, self.tail + np.arange(9)[None]])
        self.knots = np.concatenate([knots, self.tail + 9 + np.arange(6)[None]])
        self.constants = self.tail + 15 + np.arange(constants)
        self.jumps = self.tail + 15 + constants + np.arange(jumps)
        self.imu = self.constants[:of_imu]
        self.camera = np.concatenate([self.constants[of_imu:], self.own])

    def of_links(self, knots: IntArray) -> IntArray:
        """Where the states of each link live: both images, knot, gravity, imu; shape (F - 1, 25 or more)."""
        entries = np.broadcast_to(self.imu, (len(knots), len(self.imu)))
        return np.concatenate([self.frames[:-1], self.frames[1:], self.knots[knots], entries], axis=1)


def link_errors(window: Window) -> tuple[FloatArray, FloatArray]:
    """Whitened errors of the links about the present values, (F - 1, 9), and derivatives, see `of_links`."""
    w = window
    e, J = w.links.errors(w.R, w.p, w.v, w.imu_by_link(), w.gravity)
    T = w.links.dt[:, None]
    up = w.R[:-1, 2]  # in the frame of the imu; gravity points the other way
    by_gravity = w.links.root @ np.concatenate([0.0 * up, T * up, 0.5 * T * T * up], axis=1)[..., None]
    return e, np.concatenate([J[:, :, :24], by_gravity, J[:, :, 24:]], axis=2)


def add_links(window: Window, sigmas: FloatArray, order: Order, H: FloatArray, g: FloatArray) -> float:
    """Add the links and the walk of the biases to the normal equations, in place.

    Args:
        window: Present values.
        sigmas: Of what images are off by, see `ImageOffsets`; zeros: exact.
        order: Places of the unknowns.
        H: Normal matrix, shape (n, n).
        g: Gradient, shape (n,).

    Returns:
        Their sum of squares.
    """
    knots = window.knots()
    e, J = link_errors(window)
    JT = np.swapaxes(J, 1, 2)
    A, b = JT @ J, np.matvec(JT, e)
    # neighbours share an image and many links a knot: even and odd links, then the knots one by one
    for first in (0, 1):
        at = np.concatenate([order.frames[first:-1:2], order.frames[first + 1 :: 2]], axis=1)
        H[at[:, :, None], at[:, None, :]] += A[first::2, :18, :18]
        g[at] += b[first::2, :18]
    for knot in range(len(window.bias)):
        own = np.flatnonzero(knots == knot)
        rows = order.knots[knot]
        H[rows[:, None], rows] += A[own, 18:24, 18:24].sum(axis=0)
        g[rows] += b[own, 18:24].sum(axis=0)
        for first in (0, 9):
            at = order.frames[own + first // 9].reshape(-1)
            _add_side(H, at, rows, A[own, first : first + 9, 18:24].reshape(-1, 6))
        _add_side(H, rows, order.imu, A[own, 18:24, 24:].sum(axis=0))
    H[order.imu[:, None], order.imu] += A[:, 24:, 24:].sum(axis=0)
    g[order.imu] += b[:, 24:].sum(axis=0)
    for first, frames in ((0, order.frames[:-1]), (9, order.frames[1:])):
        side = A[:, first : first + 9, 24:].reshape(-1, len(order.imu))
        _add_side(H, frames.reshape(-1), order.imu, side)
    cost = float((e**2).sum()) + _add_walk(window, order, H, g)
    if sigmas.any():
        off = ImageOffsets(window, e, J, sigmas)
        off.eliminate(H, g, J, order.of_links(knots))
        cost -= off.explained()
    return cost


def _add_side(H: FloatArray, rows: IntArray, columns: IntArray, block: FloatArray) -> None:
    """Add an off-diagonal block, and its transpose."""
    H[rows[:, None], columns] += block
    H[columns[:, None], rows] += block.T


def _add_walk(window: Window, order: Order, H: FloatArray, g: FloatArray) -> float:
    """Biases walk from knot to knot."""
    noise, cost = window.noise, 0.0
    information = np.repeat([noise.gyro_walk**-2, noise.accel_walk**-2], 3) / KNOT_S
    for m in range(len(window.bias) - 1):
        a, c = order.knots[m], order.knots[m + 1]
        off = window.bias[m + 1] - window.bias[m]
        H[a, a] += information
        H[c, c] += information
        H[a, c] -= information
        H[c, a] -= information
        g[a] -= information * off
        g[c] += information * off
        cost += float(information @ off**2)
    return cost


def links_left(
    window: Window, sigmas: FloatArray, order: Order, root: FloatArray
) -> tuple[float, FloatArray, float]:
    """Mean squared error of the links, by how much they show images to be off, and how alike delays are.

    Args:
        window: Adjusted.
        sigmas: Of what images are off by, as allowed for.
        order: Places of the unknowns.
        root: Lower Cholesky factor of the normal matrix; what is above its diagonal does not count.
    """
    e, J = link_errors(window)
    if not sigmas.any():
        return float((e**2).mean()), np.zeros(3), 0.0
    off = ImageOffsets(window, e, J, sigmas)
    squares = off.mean_squares(J, order.of_links(window.knots()), root)
    squares[1:] = squares[1:].mean()
    shown = np.sqrt(squares)
    left = (float((e**2).sum()) - off.explained()) / e.size
    return left, np.where(shown > FLOORS, shown, 0.0), off.alike()


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


def evidence(square: FloatArray, usual: FloatArray) -> float:
    """By how many standard deviations squared errors exceed their usual variances.

    Args:
        square: Squared errors, shape (n,).
        usual: Their variances without anything else, in the same unit, shape (n,).
    """
    ratio = np.minimum(square / usual, SURE_SIGMAS**2)
    telling = 1.0 / np.maximum(usual, np.median(usual))  # images with a wide prior have little to say
    return float(telling @ (ratio - 1.0) / np.sqrt(2.0 * float(telling @ telling)))


def excess(square: FloatArray, usual: FloatArray) -> float:
    """Standard deviation beyond their usual variances that squared errors show; arguments as `evidence`.

    Maximum likelihood by scoring.
    """
    variance = max(float(np.median(square)) / MEDIAN_CHI2 - float(np.median(usual)), 0.0)
    for _ in range(MOST_STEPS):
        expected = usual + variance
        weight = expected**-2
        more = np.minimum(square, SURE_SIGMAS**2 * expected) - usual
        variance = max(float(weight @ more / weight.sum()), 0.0)
    return float(np.sqrt(variance))
