"""The inertial side of a window: links between images, biases that walk, stamps that jitter."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.smoother.image_offsets import FLOORS, ImageOffsets
from vical_daemon.estimation.smoother.window import KNOT_S, IntArray, Window


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
