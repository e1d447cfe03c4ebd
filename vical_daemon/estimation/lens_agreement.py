"""Do stretches of the data agree about the lens, and is it of its model? How much larger its sigmas must be.

A lens model never fits quite, and what it gets wrong depends on where in the image and at which slant the
target is seen: for seconds at a time the same way. Residuals hardly show it (the parameters bend to fit), and
the filter takes each of its images as news. So each stretch of five seconds says what it would have the lens
be; the answer with each run of neighbouring stretches left out in turn shows how far it rests on any of them.
That block-jackknife variance, over the one that independent errors would give, is the factor by which the
filter's variances are too small. It is known from few runs only: as for a Student variable, less is known.
[Kunsch, "The jackknife and the bootstrap for general stationary observations", 1989; docs/math/filter.md]

What all stretches get wrong alike no comparison shows. So the model's next power of the radius is estimated
beside: where it is there beyond doubt, the parameters are known no better than they would move with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from vical_daemon.estimation.camera_model import COEFFICIENTS, EQUIDISTANT, PLUMB_BOB, RADTAN
from vical_daemon.estimation.measurements import FloatArray

_STRETCH_S = 5.0
_SIGNIFICANT = 0.01  # one set of clean data in a hundred may lose by it, not one parameter
_BEYOND_DOUBT = 4.0  # sigmas of the next power of the radius: by chance once in 16000
_LEAST_TOLD = 1e-9  # of the variance of all: a run that tells less tells nothing
_MOST = 40  # stretches kept apart; beyond, the oldest two become one
_LEAST = 3
_LONGEST_RUN = 4
_WEAK = 0.1  # of the focal length: as good as nothing known
_WEAK_DISTORTION = 0.5
_RIDGE = 1e-12  # corners in one line leave a turn about it open
# the two highest powers of the radius among fx fy cx cy and the distortion
_RADIAL = {RADTAN: (4, 5), PLUMB_BOB: (5, 8), EQUIDISTANT: (6, 7)}


class _Stretch(NamedTuple):
    """Information of some images about the lens and its next power; that times the lens they would have."""

    information: FloatArray
    weighted: FloatArray

    def plus(self, other: _Stretch) -> _Stretch:
        return _Stretch(self.information + other.information, self.weighted + other.weighted)


class _Told(NamedTuple):
    """What all stretches say together: values, covariance if errors were independent, and factors on it."""

    values: FloatArray
    covariance: FloatArray
    factors: FloatArray


@dataclass(slots=True)
class LensAgreement:
    """Running agreement of one camera's lens.

    Args:
        model: radtan, plumb_bob or equidistant.

    Attributes:
        factors: Multiply the variances of fx fy cx cy and the distortion coefficients, >= 1, shape (n,).
        moved: How far those would move with one more power of the radius, where that is there beyond doubt;
            else zeros; px and -, shape (n,).
    """

    model: str
    factors: FloatArray = field(init=False)
    moved: FloatArray = field(init=False)
    _done: list[_Stretch] = field(default_factory=list)
    _now: _Stretch | None = None
    _begin_s: float = np.inf

    def __post_init__(self) -> None:
        n = 4 + len(COEFFICIENTS[self.model])
        self.factors, self.moved = np.ones(n), np.zeros(n)

    def learn(
        self, t_s: float, innovation: FloatArray, by_pose: FloatArray, by_lens: FloatArray, lens: FloatArray
    ) -> None:
        """Take in one image before it is used.

        Args:
            t_s: Its instant, s.
            innovation: Measured minus predicted, over the corner noise, shape (2n,).
            by_pose: Derivatives of the whitened pixels by attitude and position, shape (2n, 6).
            by_lens: By fx fy cx cy and the distortion, shape (2n, m).
            lens: Present values, shape (m,).
        """
        if not 0.0 <= t_s - self._begin_s < _STRETCH_S:
            self._close(lens[0])
            self._begin_s = t_s
        # whatever the pose of the image may be: only what no pose explains says something about the lens
        rows = np.column_stack([by_pose, by_lens, next_power(by_lens, self.model), innovation])
        N, p = rows.T @ rows, by_pose.shape[1]
        posed = N[:p, :p] + _RIDGE * np.trace(N[:p, :p]) * np.eye(p)
        N = N[p:, p:] - N[p:, :p] @ np.linalg.solve(posed, N[:p, p:])
        A, b = N[:-1, :-1], N[:-1, -1]
        said = _Stretch(A, b + A[:, :-1] @ lens)
        self._now = said if self._now is None else self._now.plus(said)

    def _close(self, focal_px: float) -> None:
        """Put the stretch to the others and compare."""
        if self._now is not None:
            self._done.append(self._now)
            self._now = None
        if len(self._done) > _MOST:
            self._done[:2] = [self._done[0].plus(self._done[1])]
        if len(self._done) < _LEAST:
            return
        A = np.array([s.information for s in self._done])
        b = np.array([s.weighted for s in self._done])
        n = len(self.factors)
        weak = np.array([_WEAK * focal_px] * 4 + [_WEAK_DISTORTION] * (n - 3)) ** -2.0
        self.factors = _compared(A[:, :n, :n], b[:, :n], weak[:n]).factors
        free = _compared(A, b, weak)
        power, variance = free.values[n], free.covariance[n, n]
        doubt = _BEYOND_DOUBT**2 * free.factors[n] * variance
        there = power if power**2 > doubt else 0.0
        self.moved = free.covariance[:n, n] * (there / variance)


def next_power(by_lens: FloatArray, model: str) -> FloatArray:
    """Derivative by the coefficient that a distortion model would have next, shape (2n,).

    Args:
        by_lens: Derivatives by fx fy cx cy and the distortion, shape (2n, m).
        model: radtan, plumb_bob or equidistant.
    """
    below, highest = (by_lens[:, k].reshape(-1, 2) for k in _RADIAL[model])
    size = np.maximum((below**2).sum(axis=1), 1e-30)  # each power is the one below times radius squared
    return np.asarray((highest * ((below * highest).sum(axis=1) / size)[:, None]).ravel())


def _compared(A: FloatArray, b: FloatArray, weak: FloatArray) -> _Told:
    """Leave out each run of stretches in turn.

    Args:
        A: Information by stretch, shape (n, m, m).
        b: That times the values of each stretch, shape (n, m).
        weak: Information of a prior that hardly matters, shape (m,).
    """
    n = len(A)
    d = min(max(1, n // 3), _LONGEST_RUN)
    runs = np.stack([np.arange(k, k + d) for k in range(n - d + 1)])
    whole = A.sum(axis=0) + np.diag(weak)
    P = np.linalg.inv(whole)
    values = P @ b.sum(axis=0)
    # information of all but two runs, which may overlap
    out = (runs[:, :, None] == np.arange(n)).any(axis=1)
    both = out[:, None] | out[None]
    left = whole - np.tensordot(both.astype(np.float64), A, axes=1)
    Q = np.linalg.inv(left[np.arange(len(runs)), np.arange(len(runs))])
    without = np.matmul(Q, (b.sum(axis=0) - out @ b)[..., None])[..., 0]
    # covariance of the changes were errors independent: stretches do not tell equally much
    C = np.einsum("rpi,rsij,sjp->rsp", Q, left, Q, optimize=True) - np.diag(P)
    usual = np.maximum(np.einsum("rrp->rp", C), _LEAST_TOLD * np.diag(P))
    ratio = ((without - values) ** 2 / usual).mean(axis=0)
    # a mean of dependent squares: like a chi-square of as many degrees as have its variance [Satterthwaite]
    dof = len(runs) ** 2 / (C**2 / (usual[:, None] * usual[None])).sum(axis=(0, 1))
    limit = chi2.isf(_SIGNIFICANT / len(values), dof) / dof
    student = dof / np.maximum(dof - 2.0, 1.0)
    return _Told(values, P, np.where(ratio > limit, student * ratio, 1.0))
