"""Do stretches of the data agree about the lens? How much larger its sigmas must be where they do not.

A lens model never fits quite, and what it gets wrong depends on where in the image and at which slant the
target is seen: for seconds at a time the same way. Residuals hardly show it (the parameters bend to fit), and
the filter takes each of its images as news. So each stretch of five seconds says what it would have the lens
be; the answer with each run of neighbouring stretches left out in turn shows how far it rests on any of them.
That block-jackknife variance, over the one that independent errors would give, is the factor by which the
filter's variances are too small. It is known from few runs only: as for a Student variable, less is known.
[Kunsch, "The jackknife and the bootstrap for general stationary observations", 1989; docs/math/filter.md]
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.unscented import upper_root

_STRETCH_S = 5.0
_SIGNIFICANT = 0.01
_MOST = 40  # stretches kept apart; beyond, the oldest two become one
_LEAST = 3
_LONGEST_RUN = 4
_WEAK = np.array([0.1, 0.1, 0.1, 0.1])  # of the focal length: as good as nothing known
_WEAK_DISTORTION = 0.5


@dataclass(slots=True)
class _Stretch:
    """Information of some images about the lens, and that times the lens they would have."""

    information: FloatArray = field(default_factory=lambda: np.zeros((8, 8)))
    weighted: FloatArray = field(default_factory=lambda: np.zeros(8))

    def plus(self, other: _Stretch) -> _Stretch:
        return _Stretch(self.information + other.information, self.weighted + other.weighted)


@dataclass(slots=True)
class LensAgreement:
    """Running agreement of one camera's lens.

    Attributes:
        factors: Multiply the variances of fx fy cx cy and the four distortion coefficients, >= 1, shape (8,).
    """

    factors: FloatArray = field(default_factory=lambda: np.ones(8))
    _done: list[_Stretch] = field(default_factory=list)
    _now: _Stretch = field(default_factory=_Stretch)
    _begin_s: float = np.inf

    def learn(
        self, t_s: float, innovation: FloatArray, by_pose: FloatArray, by_lens: FloatArray, lens: FloatArray
    ) -> None:
        """Take in one image before it is used.

        Args:
            t_s: Its instant, s.
            innovation: Measured minus predicted, over the corner noise, shape (2n,).
            by_pose: Derivatives of the whitened pixels by attitude and position, shape (2n, 6).
            by_lens: By fx fy cx cy and the distortion, shape (2n, 8).
            lens: Present values, shape (8,).
        """
        if not 0.0 <= t_s - self._begin_s < _STRETCH_S:
            self._close(lens[0])
            self._begin_s = t_s
        # whatever the pose of the image may be: only what no pose explains says something about the lens
        p, n = by_pose.shape[1], by_pose.shape[1] + by_lens.shape[1]
        rows = np.concatenate([by_pose, by_lens, innovation[:, None]], axis=1)
        R = upper_root(rows)[p:n]
        J = R[:, p:n]
        self._now.information += J.T @ J
        self._now.weighted += J.T @ (R[:, n] + J @ lens)

    def _close(self, focal_px: float) -> None:
        """Put the stretch to the others and leave out each in turn."""
        if self._now.information.any():
            self._done.append(self._now)
            self._now = _Stretch()
        if len(self._done) > _MOST:
            self._done[:2] = [self._done[0].plus(self._done[1])]
        n = len(self._done)
        if n < _LEAST:
            return
        weak = np.diag(np.concatenate([1.0 / (_WEAK * focal_px) ** 2, np.full(4, _WEAK_DISTORTION**-2)]))
        A = np.array([s.information for s in self._done])
        b = np.array([s.weighted for s in self._done])
        whole = A.sum(axis=0) + weak
        lens = np.linalg.solve(whole, b.sum(axis=0))
        d = min(max(1, n // 3), _LONGEST_RUN)
        runs = np.stack([np.arange(k, k + d) for k in range(n - d + 1)])
        left = whole - A[runs].sum(axis=1)
        without = np.linalg.solve(left, (b.sum(axis=0) - b[runs].sum(axis=1))[..., None])[..., 0]
        spread = (n - d) / (d * len(runs)) * ((without - lens) ** 2).sum(axis=0)
        ratio = spread / np.diag(np.linalg.inv(whole))
        apart = n / d  # how many runs there are to tell the spread from
        limit = float(chi2.isf(_SIGNIFICANT, apart)) / apart
        student = apart / max(apart - 2.0, 1.0)
        self.factors = np.where(ratio > limit, student * ratio, 1.0)
