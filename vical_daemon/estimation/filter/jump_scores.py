"""When a part of the calibration jumped: likelihood ratios of all instants from one run of a filter.

A filter that does not know that some errors jumped by nu just before image k sees innovations of the mean
H_t D_t nu. D begins with one column for each direction of the jump, is propagated from image to image, and is
reduced by each correction. So one run gives, for each k, the information about nu in the innovations.
[Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in
linear systems", 1976]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.unscented import solve_lower, unit

SIZES = 3.0 ** -np.arange(5)
"""Sizes that a jump may have, over one sigma of the largest, all equally likely a priori: nobody knows how
far something was moved. The last is 0.6 mm and 0.06 deg of a mounting, less than matters."""
_LEAST = 1e-12  # variance of a jump over that of one sigma: rounding


def _likelihoods(A: FloatArray, b: FloatArray) -> FloatArray:
    """Logarithm of the likelihood of a jump of each of `SIZES` over that of none, shape (..., sizes).

    Args:
        A: Information about the jump, shape (..., q, q).
        b: Its information vector, shape (..., q).
    """
    inner = unit(b.shape[-1]) + A[..., None, :, :] * SIZES[:, None, None] ** 2
    scaled = b[..., None, :] * SIZES[:, None]
    explained = np.vecdot(scaled, np.linalg.solve(inner, scaled[..., None])[..., 0])
    return np.asarray(0.5 * (explained - np.linalg.slogdet(inner)[1]))


@dataclass(slots=True)
class JumpScores:
    """What the images of a run say about jumps just before each of them.

    Jumps are over one sigma of theirs, so that the prior of each is a unit normal distribution.

    Attributes:
        D: Errors now, after a jump of one sigma, by its instant and direction, shape (n, k p).
        information: A of the jump before each of k images, shape (k, p, p).
        weighted: Information vector b, whose mean is A times the jump, shape (k, p).
    """

    D: FloatArray
    information: FloatArray
    weighted: FloatArray

    @classmethod
    def of(cls, size: int, p: int) -> JumpScores:
        """Return empty scores for a filter with `size` errors, and jumps in `p` directions."""
        return cls(np.zeros((size, 0)), np.zeros((0, p, p)), np.zeros((0, p)))

    def begin(self, columns: FloatArray) -> None:
        """The next image may be the first after a jump.

        Args:
            columns: Directions of the errors, each as long as one sigma of a jump, shape (n, p).
        """
        p = columns.shape[1]
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

    def log_ratios(self, part: slice) -> FloatArray:
        """Logarithm of the likelihood of a jump of any size in some directions over that of none, shape (k,).

        Args:
            part: Which of the directions.
        """
        each = _likelihoods(self.information[:, part, part], self.weighted[:, part])
        return np.asarray(logsumexp(each, axis=-1) - np.log(len(SIZES)))


@dataclass(slots=True)
class JumpSizes:
    """How far errors jumped, by a filter whose covariance contains the jump from its first image on.

    A jump is known by the images only as far as the state is. So each correction of the state moves the
    estimate of the jump by their regression, wherever the image was linearised.

    Attributes:
        D: Covariance of the state with the jump over its sigmas, shape (n, p).
        mean: Of the jump over its sigmas, shape (p,).
        covariance: Likewise, shape (p, p).
    """

    D: FloatArray
    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, columns: FloatArray) -> JumpSizes:
        """Just after `columns` were added to the covariance, shape (n, p)."""
        p = columns.shape[1]
        return cls(columns.copy(), np.zeros(p), np.eye(p))

    def predict(self, linear: FloatArray, S: FloatArray) -> None:
        """Propagate; arguments as for `JumpScores`."""
        self.D[:9] = linear @ solve_lower(S, self.D[: len(S)])

    def correct(self, before: FloatArray, after: FloatArray, dx: FloatArray) -> None:
        """Take a correction of the state.

        Args:
            before: Square root of the covariance as predicted, shape (n, n).
            after: Likewise, of the corrected state.
            dx: Step of the state, shape (n,).
        """
        normal = solve_lower(before, np.concatenate([self.D, dx[:, None]], axis=1))
        by_jump = normal[:, :-1]
        left = after.T @ solve_lower(before, by_jump, transposed=True)
        self.mean = self.mean + by_jump.T @ normal[:, -1]
        self.covariance = self.covariance - by_jump.T @ by_jump + left.T @ left
        self.D = after @ left

    @property
    def any_size(self) -> float:
        """Logarithm of the likelihood if the jump may be of any size, over that if one sigma is as given."""
        each = _likelihoods(*self._information())
        return float(logsumexp(each) - np.log(len(SIZES)) - each[0])

    @property
    def sizes(self) -> FloatArray:
        """Root of the expected square of each jump, over one sigma, shape (p,)."""
        A, b = self._information()
        each = _likelihoods(A, b)
        out = np.zeros(len(b))
        for weight, size in zip(np.exp(each - logsumexp(each)), SIZES, strict=True):
            covariance = size**2 * np.linalg.inv(unit(len(b)) + size**2 * A)
            out += weight * ((covariance @ b) ** 2 + np.diag(covariance))
        return np.sqrt(out)

    def _information(self) -> tuple[FloatArray, FloatArray]:
        """What the images say about the jump without its prior: A, shape (p, p), and b, shape (p,)."""
        variances, axes = np.linalg.eigh(self.covariance)
        variances = np.clip(variances, _LEAST, 1.0)
        A = (axes * (1.0 / variances - 1.0)) @ axes.T
        return A, axes @ (axes.T @ self.mean / variances)
