"""When a part of the calibration jumped: likelihood ratios of all instants from one run of a filter.

A filter that does not know that some errors jumped by nu just before image k sees innovations of the mean
H_t D_t nu. D begins with one column for each direction of the jump, is propagated from image to image, and is
reduced by each correction. All these steps are linear. So what the filter did is gone through once, backwards
(as in a smoother), for the information about any error before each image; D then picks the directions.
[Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in
linear systems", 1976; Bryson and Frazier, "Smoothing for linear and nonlinear dynamic systems", 1963]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.passed import Corrected, Moved, by_step, said
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import MOTION
from vical_daemon.estimation.model.unscented import RIDGE, solve_upper, unit

SIZES = 3.0 ** -np.arange(5)
"""Sizes that a jump may have, over one sigma of the largest, all equally likely a priori: nobody knows how
far something was moved. The last is 0.6 mm and 0.06 deg of a mounting, less than matters."""


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


class JumpScores(NamedTuple):
    """What the images of a run say about jumps just before each of them.

    Jumps are over one sigma of theirs, so that the prior of each is a unit normal distribution.

    Attributes:
        information: A of the jump before each of k images, shape (k, p, p).
        weighted: Information vector b, whose mean is A times the jump, shape (k, p).
    """

    information: FloatArray
    weighted: FloatArray

    @classmethod
    def of(
        cls,
        run: Sequence[Sequence[Moved | Corrected]],
        columns: Sequence[FloatArray],
        drifts: Sequence[tuple[int, int]],
    ) -> JumpScores:
        """Go back through a run once: what images say about the errors at an instant holds for any jump.

        Errors are counted in columns of the square root of the covariance. In these units nothing is large,
        and what images say is only added up.

        Args:
            run: What each image did to the filter.
            columns: Directions of the errors before that, each as long as one sigma of a jump, (n, p).
            drifts: Where errors of a time shift and of its rate are.
        """
        n, p = columns[0].shape
        A, b, root = np.zeros((n, n)), np.zeros(n), unit(n)
        information, weighted = np.zeros((len(run), p, p)), np.zeros((len(run), p))
        for k in range(len(run) - 1, -1, -1):
            for done in reversed(run[k]):
                after = done.carried if isinstance(done, Corrected) else done.after
                if after is not root:  # an error was reopened, or errors mean something else now
                    A, b = _before(A, b, solve_upper(root, after))
                A, b = _before(A, b, by_step(done, drifts))
                if isinstance(done, Corrected):
                    J, j = said(done)
                    spread = done.moves[:, -n:]
                    A, b = A + spread.T @ J @ spread, b + j @ spread
                root = done.before
            D = solve_upper(root, columns[k])
            information[k], weighted[k] = D.T @ A @ D, b @ D
        return cls(information, weighted)

    def log_ratios(self, part: slice) -> FloatArray:
        """Logarithm of the likelihood of a jump of any size in some directions over that of none, shape (k,).

        Args:
            part: Which of the directions.
        """
        each = _likelihoods(self.information[:, part, part], self.weighted[:, part])
        return np.asarray(np.logaddexp.reduce(each, axis=-1) - np.log(len(SIZES)))


def _before(A: FloatArray, b: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What is said about the errors before a step, from what is said about those after it."""
    return step.T @ A @ step, b @ step


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
        """Propagate.

        Args:
            linear: F S of the motion, shape (9, n).
            S: Square root of the covariance before, shape (n, n).
        """
        self.D[MOTION] = linear @ solve_upper(S, self.D)

    def correct(self, before: FloatArray, after: FloatArray, dx: FloatArray) -> None:
        """Take a correction of the state.

        Args:
            before: Square root of the covariance as predicted, shape (n, n).
            after: Likewise, of the corrected state.
            dx: Step of the state, shape (n,).
        """
        normal = solve_upper(before, np.concatenate([self.D, dx[:, None]], axis=1))
        by_jump = normal[:, :-1]
        left = after.T @ solve_upper(before, by_jump, transposed=True)
        self.mean = self.mean + by_jump.T @ normal[:, -1]
        self.covariance = self.covariance - by_jump.T @ by_jump + left.T @ left
        self.D = after @ left

    @property
    def any_size(self) -> float:
        """Logarithm of the likelihood if the jump may be of any size, over that if one sigma is as given."""
        each = _likelihoods(*self._information())
        return float(np.logaddexp.reduce(each) - np.log(len(SIZES)) - each[0])

    @property
    def sizes(self) -> FloatArray:
        """Root of the expected square of each jump, over one sigma, shape (p,)."""
        A, b = self._information()
        each = _likelihoods(A, b)
        out = np.zeros(len(b))
        for weight, size in zip(np.exp(each - np.logaddexp.reduce(each)), SIZES, strict=True):
            covariance = size**2 * np.linalg.inv(unit(len(b)) + size**2 * A)
            out += weight * ((covariance @ b) ** 2 + np.diag(covariance))
        return np.sqrt(out)

    def _information(self) -> tuple[FloatArray, FloatArray]:
        """What the images say about the jump without its prior: A, shape (p, p), and b, shape (p,)."""
        variances, axes = np.linalg.eigh(self.covariance)
        variances = np.clip(variances, RIDGE, 1.0)
        A = (axes * (1.0 / variances - 1.0)) @ axes.T
        return A, axes @ (axes.T @ self.mean / variances)
