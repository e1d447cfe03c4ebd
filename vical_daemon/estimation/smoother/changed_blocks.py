"""Whether the rig has changed between windows, and what: the mounting, the clock, or both.

After a change each block is tested by itself (`changed_blocks`). A window is adjusted with mounting and time
shift unknown and the rest r (lens, imu) as known before. Its answer x, r with covariance P is then held
against what was known of a block before, N(m + K (r - r0), C):

    d = (x - m) - K (r - r0),   d' (C + A P A')^-1 d ~ chi^2,   A = [I, -K]

which is exact for Gaussians: r is common to both sides, and the condition on it takes that into account.
[docs/math/target_free.md, eq. (3)]
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import accumulate, combinations
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.retract import camera_difference
from vical_daemon.estimation.model.state import CameraSlices, CameraState, Layout
from vical_daemon.estimation.significance import LIKELY_SIGMAS, PERHAPS_SIGMAS, SURE_SIGMAS, chi_square_limit

_WINDOWS = 5
"""Estimates looked back at: some 15 s. After as long, a move is a change like any other: windows disagree."""
_INFORMED = 0.02
"""Share of the old variance that the data between must take away in a direction, to say anything about it."""
_WRONG = 0.1
"""Share of the old variance by which the difference of two covariances may be wrong before a move is certain:
errors that last make both wrong, and their difference is small. [docs/design/target_free.md, "Doubts"]"""


def mounting(layout: Layout) -> tuple[int, ...]:
    """Errors of lever arm and mounting; empty where they are not estimated."""
    p, r = layout.camera.position, layout.camera.rotation
    return () if p is None or r is None else (*range(p.start, p.stop), *range(r.start, r.stop))


def clock(layout: Layout) -> tuple[int, ...]:
    """Error of the time shift; empty where it is not estimated."""
    shift = layout.camera.timeshift
    return () if shift is None else (shift,)


def changed_blocks(
    found: FloatArray,
    found_covariance: FloatArray,
    known_covariance: FloatArray,
    layout: Layout,
    excess: Callable[[float, int], float],
) -> tuple[int, ...]:
    """The fewest blocks that must have changed; of as many, those that leave the rest fit best.

    Args:
        found: Calibration of a window that knew nothing of the blocks, minus the one known before,
            shape (n,).
        found_covariance: Of it, shape (n, n).
        known_covariance: Of what was known before, likewise.
        layout: Where the errors live.
        excess: Of a sum of squares and its degrees of freedom: above 1, it is no chance.

    Returns:
        Errors to reopen; empty: none has changed.
    """
    blocks = [block for block in (mounting(layout), clock(layout)) if block]
    rest = [k for k in range(layout.core, layout.size) if not any(k in block for block in blocks)]
    for count in range(len(blocks)):
        scored = []
        for reopened in combinations(blocks, count):
            kept = [k for block in blocks if block not in reopened for k in block]
            square = _square(found, found_covariance, known_covariance, kept, rest)
            scored.append((excess(square, len(kept)), sum(reopened, ())))
        least, best = min(scored)
        if least <= 1.0:
            return best
    return sum(blocks, ())


def _square(
    found: FloatArray, P: FloatArray, known: FloatArray, kept: Sequence[int], rest: Sequence[int]
) -> float:
    """The sum of squares of the test above, with as many degrees of freedom as `kept` is long."""
    scale = np.sqrt(np.diag(known))  # pixels and microseconds
    whole, P, d = known / np.outer(scale, scale), P / np.outer(scale, scale), found / scale
    K = np.linalg.solve(whole[np.ix_(rest, rest)], whole[np.ix_(rest, kept)]).T
    C = whole[np.ix_(kept, kept)] - K @ whole[np.ix_(rest, kept)]
    A = np.concatenate([np.eye(len(kept)), -K], axis=1)
    both = [*kept, *rest]
    e = A @ d[both]
    return float(e @ np.linalg.solve(C + A @ P[np.ix_(both, both)] @ A.T, e))


def square_of_change(
    change: FloatArray, before: FloatArray, after: FloatArray, wrong: float = 0.0
) -> tuple[float, int]:
    """How far an estimate moved, against how far new data may move it.

    Args:
        change: New minus old, shape (n,).
        before: Covariance of the old one, shape (n, n).
        after: Of the new one, likewise.
        wrong: Share of the old variance by which the difference of the two may be too small.

    Returns:
        Sum of squares over the directions that the new data show, and their number.
    """
    scale = np.sqrt(np.diag(before))
    values, vectors = np.linalg.eigh((before - after) / np.outer(scale, scale))
    informed = values > _INFORMED
    d = vectors.T @ (change / scale)
    square = (d[informed] ** 2 / (values[informed] + wrong)).sum()
    return float(square), int(np.count_nonzero(informed))


class _Mounting(NamedTuple):
    """What was reported: the calibration, its covariance over its factor, by which models."""

    camera: CameraState
    covariance: FloatArray
    models: object


class MountingWatch:
    """Notices a mounting that moved by less than one window shows, from estimates some windows apart.

    Lever arm and mounting, each as a whole, are compared with those after the last complete windows. For
    consistent sigmas cov(new - old) = P_old - P_new, however many windows lie between them.
    [Hausman, "Specification tests in econometrics", 1978; docs/math/target_free.md, "Changes"]

    Attributes:
        doubtful: One of them may have moved, until a complete window shows that it has not.
        surely: One of them surely has.
    """

    def __init__(self) -> None:
        self.doubtful = self.surely = self._doubted = False
        self._newest: _Mounting | None = None
        self._past: deque[_Mounting] = deque(maxlen=_WINDOWS)

    def compare(
        self, camera: CameraState, covariance: FloatArray, factor: float, where: CameraSlices, models: object
    ) -> None:
        """Take what is reported now.

        Args:
            camera: The calibration.
            covariance: Of it, over its factor, shape (n, n).
            factor: Measured variance over the stated one.
            where: Where the errors of the camera live.
            models: What is taken to be as specified: with other models the answer is another one.
        """
        self.surely = self._doubted = False
        self._newest = _Mounting(camera, covariance, models)
        for old in self._past:
            if old.models != models:
                continue
            d, before = camera_difference(camera, old.camera, where, len(covariance)), old.covariance
            for block in (where.position, where.rotation):
                if block is None:
                    continue
                moved = d[block], before[block, block], covariance[block, block]
                (square, dof), (at_least, _) = square_of_change(*moved), square_of_change(*moved, _WRONG)
                if dof:
                    self._doubted |= square > factor * chi_square_limit(dof, LIKELY_SIGMAS)
                    self.surely |= at_least > factor * chi_square_limit(dof, SURE_SIGMAS)
        self.doubtful |= self._doubted

    def window_done(self) -> None:
        """The estimate compared last belongs to a complete window: later ones are compared with it, too."""
        self.doubtful = self._doubted
        if self._newest is not None:
            self._past.append(self._newest)


def newest_disagree(windows: Sequence[tuple[float, int]], factor: float) -> bool:
    """Whether the newest windows, one to five, moved the calibration by more than chance.

    Each by itself may agree with what was known, and all of them to one side.

    Args:
        windows: Sum of squares of each change and its degrees of freedom, from the oldest on.
        factor: Measured variance over the stated one.
    """
    newest = accumulate(
        reversed(list(windows)[1:][-_WINDOWS:]), lambda both, one: (both[0] + one[0], both[1] + one[1])
    )
    return any(square > factor * chi_square_limit(dof, PERHAPS_SIGMAS) for square, dof in newest)
