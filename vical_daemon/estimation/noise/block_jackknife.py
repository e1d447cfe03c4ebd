"""Block jackknife: what stretches of the data say about some unknowns, and how far they agree.

Errors of a model last for seconds. Neighbouring images are therefore not independent, and residuals hardly
show it, because the unknowns follow the errors. So images are grouped into stretches of some seconds. Each
run of neighbouring stretches is left out in turn, and the change of the answer shows how much it depends on
them. The block-jackknife variance over that of independent errors is the factor by which variances are too
small. It comes from few runs, so it is uncertain itself, as for a Student variable. [Kunsch, "The jackknife
and the bootstrap for general stationary observations", 1989; docs/math/filter.md]
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.unscented import RIDGE, root, solve_lower, unit
from vical_daemon.estimation.significance import PERHAPS_SIGMAS, chance

_MOST = 40  # stretches kept apart; beyond, the oldest two become one
_LEAST = 3  # stretches: with two, one difference would stand for all scatter
_LONGEST_RUN = 4  # stretches left out together: errors that last longer are taken as constant


class _JackknifeBlock(NamedTuple):
    """Information of some images about the unknowns; that times the values they would have."""

    information: FloatArray
    weighted: FloatArray

    def __deepcopy__(self, memo: object) -> _JackknifeBlock:
        """Itself: it does not change."""
        return self

    def plus(self, other: _JackknifeBlock) -> _JackknifeBlock:
        return _JackknifeBlock(self.information + other.information, self.weighted + other.weighted)


class JackknifeResult(NamedTuple):
    """What all stretches say together.

    Attributes:
        values: Of the unknowns, shape (m,).
        covariance: If errors were independent, shape (m, m).
        factors: By which the variances of what is compared are too small, >= 1, shape (m,).
    """

    values: FloatArray
    covariance: FloatArray
    factors: FloatArray


@dataclass(slots=True)
class BlockJackknife:
    """Gathers images.

    Args:
        length_s: Of a stretch.
    """

    length_s: float
    _done: list[_JackknifeBlock] = field(default_factory=list)
    _now: _JackknifeBlock | None = None
    _begin_s: float = np.inf

    def learn(
        self, t_s: float, innovation: FloatArray, by_pose: FloatArray, by: FloatArray, values: FloatArray
    ) -> bool:
        """Take in one image before it is used.

        Args:
            t_s: Its instant, s.
            innovation: Measured minus predicted, over the corner noise, shape (2n,).
            by_pose: Derivatives of the whitened pixels by attitude and position, shape (2n, 6).
            by: By the unknowns, shape (2n, m).
            values: Present values of the first of these; the others are zero, shape (at most m,).

        Returns:
            Whether a stretch was closed and there are enough of them to be compared.
        """
        closed = not 0.0 <= t_s - self._begin_s < self.length_s
        if closed:
            self._close()
            self._begin_s = t_s
        # whatever the pose of the image may be: only what no pose explains says something about the rest
        rows = np.concatenate([by_pose, by, innovation[:, None]], axis=1)
        N, p = rows.T @ rows, by_pose.shape[1]
        posed = N[:p, :p]
        posed = posed + (RIDGE * posed.trace()) * unit(p)  # corners in one line leave a turn about it open
        explained = solve_lower(root(posed), N[:p, p:])
        N = N[p:, p:] - explained.T @ explained
        A, b = N[:-1, :-1], N[:-1, -1]
        said = _JackknifeBlock(A, b + A[:, : len(values)] @ values)
        self._now = said if self._now is None else self._now.plus(said)
        return closed and len(self._done) >= _LEAST

    def _close(self) -> None:
        if self._now is not None:
            self._done.append(self._now)
            self._now = None
        if len(self._done) > _MOST:
            self._done[:2] = [self._done[0].plus(self._done[1])]

    def compared(self, sigmas: FloatArray, onto: FloatArray) -> JackknifeResult:
        """Leave out each run of stretches in turn.

        Args:
            sigmas: Of a prior about zero that hardly matters; of the first so many unknowns, shape (k,), the
                others are held at zero.
            onto: What is compared: these combinations of the unknowns, shape (m, k).
        """
        k = len(sigmas)
        A = np.array([s.information[:k, :k] for s in self._done])
        b = np.array([s.weighted[:k] for s in self._done])
        n = len(A)
        d = min(max(1, n // 3), _LONGEST_RUN)
        runs = np.stack([np.arange(i, i + d) for i in range(n - d + 1)])
        whole = A.sum(axis=0) + np.diag(sigmas**-2.0)
        P = np.linalg.inv(whole)
        values = P @ b.sum(axis=0)
        # information of all but two runs, which may overlap
        out = (runs[:, :, None] == np.arange(n)).any(axis=1)
        both = out[:, None] | out[None]
        left = whole - np.tensordot(both.astype(np.float64), A, axes=1)
        Q = np.linalg.inv(left[np.arange(len(runs)), np.arange(len(runs))])
        without = np.matvec(Q, b.sum(axis=0) - out @ b)
        # covariance of the changes were errors independent: stretches do not tell equally much
        Q, spread = onto @ Q, np.vecdot(onto @ P, onto)
        C = np.einsum("rpi,rsij,spj->rsp", Q, left, Q, optimize=True) - spread
        usual = np.maximum(np.einsum("rrp->rp", C), RIDGE * spread)
        ratio = (((without - values) @ onto.T) ** 2 / usual).mean(axis=0)
        # a mean of dependent squares: a chi-square of as many degrees as have its variance [Satterthwaite]
        dof = len(runs) ** 2 / (C**2 / (usual[:, None] * usual[None])).sum(axis=(0, 1))
        limit = chdtri(dof, chance(PERHAPS_SIGMAS) / len(onto)) / dof
        student = dof / np.maximum(dof - 2.0, 1.0)
        return JackknifeResult(values, P, np.where(ratio > limit, student * ratio, 1.0))
