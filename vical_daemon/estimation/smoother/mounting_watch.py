"""Notices a mounting that moved by less than one window shows, from estimates some windows apart.

For consistent sigmas cov(new - old) = P_old - P_new, however many windows lie between them.
[Hausman, "Specification tests in econometrics", 1978; docs/math/target_free.md, "Changes"]
"""

from __future__ import annotations

from collections import deque

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.retract import camera_difference
from vical_daemon.estimation.model.state import CameraSlices, CameraState
from vical_daemon.estimation.significance import LIKELY_SIGMAS, SURE_SIGMAS, chi_square_limit

_WINDOWS = 5
"""Estimates looked back at: some 15 s. After as long, a move is a change like any other: windows disagree."""
_INFORMED = 0.02
"""Share of the old variance that the data between must take away in a direction, to say anything about it."""


def square_of_change(change: FloatArray, before: FloatArray, after: FloatArray) -> tuple[float, int]:
    """How far an estimate moved, against how far new data may move it.

    Args:
        change: New minus old, shape (n,).
        before: Covariance of the old one, shape (n, n).
        after: Of the new one, likewise.

    Returns:
        Sum of squares over the directions that the new data show, and their number.
    """
    scale = np.sqrt(np.diag(before))
    values, vectors = np.linalg.eigh((before - after) / np.outer(scale, scale))
    informed = values > _INFORMED
    d = vectors.T @ (change / scale)
    return float((d[informed] ** 2 / values[informed]).sum()), int(np.count_nonzero(informed))


class MountingWatch:
    """Compares lever arm and mounting, each as a whole, with those of the last windows.

    Attributes:
        doubtful: One of them may have moved.
    """

    def __init__(self) -> None:
        self.doubtful = False
        self._models: object = None
        self._past: deque[tuple[CameraState, FloatArray]] = deque(maxlen=_WINDOWS)

    def moved(
        self, camera: CameraState, covariance: FloatArray, factor: float, where: CameraSlices, models: object
    ) -> bool:
        """Take what is reported after a complete window; whether lever arm or mounting have surely moved.

        Args:
            camera: The calibration.
            covariance: Of it, over its factor, shape (n, n).
            factor: Measured variance over the stated one.
            where: Where the errors of the camera live.
            models: What is taken to be as specified: with other models the answer is another one.
        """
        if models != self._models:
            self._past.clear()
            self._models = models
        self.doubtful = surely = False
        for old, before in self._past:
            d = camera_difference(camera, old, where, len(covariance))
            for block in (where.position, where.rotation):
                if block is None:
                    continue
                square, dof = square_of_change(d[block], before[block, block], covariance[block, block])
                if dof:
                    self.doubtful |= square > factor * chi_square_limit(dof, LIKELY_SIGMAS)
                    surely |= square > factor * chi_square_limit(dof, SURE_SIGMAS)
        self._past.append((camera, covariance))
        return surely
