"""When a part of the calibration jumped: likelihood ratios of all instants from one run of a filter.

A filter that does not know that some errors jumped by nu just before image k sees innovations of the mean
H_t D_t nu. D begins as the unit columns of these errors, moves with the state from image to image, and loses
what each correction takes off. So one run gives, for each k, what the innovations say of nu.
[Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in
linear systems", 1976]
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.estimation.model.unscented import solve_lower, unit


@dataclass(slots=True)
class JumpScores:
    """What the images of a run say about jumps just before each of them.

    Attributes:
        errors: Indices of the errors that may jump, shape (p,).
        D: By each instant and error, shape (n, k p).
        information: Of each instant, shape (k, p, p).
        weighted: That times the jump, shape (k, p).
    """

    errors: IntArray
    D: FloatArray
    information: FloatArray = field(init=False)
    weighted: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        p = len(self.errors)
        self.information, self.weighted = np.zeros((0, p, p)), np.zeros((0, p))

    @classmethod
    def of(cls, errors: IntArray, size: int) -> JumpScores:
        """Of a filter with `size` errors."""
        return cls(errors, np.zeros((size, 0)))

    def begin(self) -> None:
        """The next image may be the first after a jump."""
        p = len(self.errors)
        columns = np.zeros((len(self.D), p))
        columns[self.errors, np.arange(p)] = 1.0
        self.D = np.concatenate([self.D, columns], axis=1)
        self.information = np.concatenate([self.information, np.zeros((1, p, p))])
        self.weighted = np.concatenate([self.weighted, np.zeros((1, p))])

    def predict(self, linear: FloatArray, S: FloatArray) -> None:
        """Propagate.

        Args:
            linear: F S of the motion by the dynamic errors, shape (9, d).
            S: Square root of their covariance before, shape (d, d).
        """
        self.D[:9] = linear @ solve_lower(S, self.D[: len(S)])

    def update(
        self,
        rows: tuple[FloatArray, FloatArray],
        by_error: FloatArray,
        moves: FloatArray,
        S: FloatArray,
    ) -> None:
        """Take an image, with the covariance as predicted.

        Args:
            rows: The whitened corners by the ways in which the image can move, shape (m, w), and their
                innovation, shape (m,).
            by_error: The ways by the errors, shape (w, n).
            moves: Square root of how far the state, and then what corners share, move the image: (w, c).
            S: Square root of the covariance, shape (n, n).
        """
        ways, innovation = rows
        N = ways.T @ ways
        inner = np.linalg.solve(
            unit(len(N)) + N @ (moves @ moves.T), np.concatenate([N, (ways.T @ innovation)[:, None]], axis=1)
        )
        J, j = inner[:, :-1], inner[:, -1]  # W' V^-1 W and W' V^-1 r, V = 1 + W moves moves' W'
        G = by_error @ self.D
        k, p = self.weighted.shape
        JG = J @ G
        self.weighted += (j @ G).reshape(k, p)
        by_instant = np.swapaxes(G.reshape(len(G), k, p), 0, 1)
        self.information += np.swapaxes(by_instant, 1, 2) @ np.swapaxes(JG.reshape(len(G), k, p), 0, 1)
        self.D -= S @ (moves[:, : len(S)].T @ JG)

    def log_ratios(self, part: slice, sigma: FloatArray) -> FloatArray:
        """Logarithm of the likelihood of a jump of some errors over that of none, shape (k,).

        Args:
            part: Which of `errors`.
            sigma: By how much they jump, one sigma before the images, shape (q,).
        """
        A = sigma[:, None] * self.information[:, part, part] * sigma + unit(len(sigma))
        b = self.weighted[:, part] * sigma
        explained = np.vecdot(b, np.linalg.solve(A, b[..., None])[..., 0])
        return np.asarray(0.5 * (explained - np.linalg.slogdet(A)[1]))
