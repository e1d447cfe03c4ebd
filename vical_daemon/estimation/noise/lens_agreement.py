"""Sigmas of the lens: do stretches of the data agree about it, and does its model lack a term?

A lens model never fits exactly. Its misfit depends on where in the image and at which slant the target is
seen. So each stretch gives its own lens (`BlockJackknife`), and the variances of the lens grow by as much as
the stretches disagree. No comparison shows an error that all stretches share. So the next power of the radius
is estimated as well: if it is significant, the sigmas are at least as large as what it would move.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from vical_daemon.estimation.geometry.camera_model import EQUIDISTANT, PLUMB_BOB, RADTAN
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.next_term import onto_model
from vical_daemon.estimation.model.priors import AGAIN_SIGMAS, FILTER_START
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.model.unscented import RIDGE, root, solve_lower, unit
from vical_daemon.estimation.noise.lens_limit import WINDOWS
from vical_daemon.estimation.significance import LIKELY_SIGMAS, PERHAPS_SIGMAS, STRETCH_S, chance

# the two highest powers of the radius among fx fy cx cy and the distortion
_RADIAL = {RADTAN: (4, 5), PLUMB_BOB: (5, 8), EQUIDISTANT: (6, 7)}
_LEAST = 3  # stretches: with two, one difference would stand for all scatter
_LONGEST_RUN = 4  # stretches left out together: errors that last longer are taken as constant


@dataclass(slots=True)
class LensAgreement:
    """Running agreement of one camera's lens.

    Attributes:
        factors: Multiply the variances of fx fy cx cy and the distortion as they are reported, >= 1, shape
            (m,), or (1,) at first.
        moved: How far those would move with one more power of the radius, where that is there beyond doubt;
            else zeros; px and -, likewise.
        seen: Sum over the images of J'J, J the derivatives by the lens of points over their noise, (n, n).
    """

    factors: FloatArray = field(default_factory=lambda: np.ones(1))
    moved: FloatArray = field(default_factory=lambda: np.zeros(1))
    seen: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    _stretches: BlockJackknife = field(default_factory=lambda: BlockJackknife(STRETCH_S))

    def learn(
        self,
        t_s: float,
        innovation: FloatArray,
        by_pose: FloatArray,
        by_lens: FloatArray,
        camera: CameraState,
    ) -> None:
        """Take in one image before it is used.

        Args:
            t_s: Its instant, s.
            innovation: Measured minus predicted, over the corner noise, shape (2k,).
            by_pose: Derivatives of the whitened pixels by attitude and position, shape (2k, 6).
            by_lens: By fx fy cx cy and the distortion, shape (2k, n).
            camera: Its lens at present.
        """
        self.seen = self.seen + by_lens.T @ by_lens
        lens = np.concatenate([camera.intrinsics, camera.distortion])
        by = with_next_power(by_lens, camera.distortion_model)
        if not self._stretches.learn(t_s, innovation, by_pose, by, lens):
            return
        weak = lens_sigmas(lens[0], len(lens) + 1)
        n, onto = len(lens), onto_model(camera, self.seen)
        self.factors = self._stretches.compared(weak[:n], onto).factors
        free = self._stretches.compared(weak, np.eye(n + 1))
        power, variance = free.values[n], free.covariance[n, n]
        doubt = LIKELY_SIGMAS**2 * free.factors[n] * variance
        there = power if power**2 > doubt else 0.0
        self.moved = onto @ free.covariance[:n, n] * (there / variance)

    def anew(self) -> LensAgreement:
        """Without what stretches have said."""
        return LensAgreement(seen=self.seen)


def lens_sigmas(focal_px: float, n: int) -> FloatArray:
    """Standard deviations of fx fy cx cy and n - 4 coefficients of which as good as nothing is known."""
    known = [FILTER_START.focal * focal_px] * 4 + [FILTER_START.distortion] * (n - 4)
    return AGAIN_SIGMAS * np.array(known)


def with_next_power(by_lens: FloatArray, model: str) -> FloatArray:
    """Add the derivative by the coefficient that a distortion model would have next.

    Args:
        by_lens: Derivatives by fx fy cx cy and the distortion, shape (2k, n).
        model: radtan, plumb_bob or equidistant.

    Returns:
        Shape (2k, n + 1).
    """
    below, highest = (by_lens[:, k].reshape(-1, 2) for k in _RADIAL[model])
    size = np.maximum(np.vecdot(below, below), 1e-30)
    ratio = np.vecdot(below, highest) / size  # each power is the one below times radius squared
    return np.concatenate([by_lens, (highest * ratio[:, None]).reshape(-1, 1)], axis=1)


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
    """What stretches of the data say about some unknowns, and how far they agree.

    Errors of a model last for seconds. Neighbouring images are therefore not independent, and residuals
    hardly show it, because the unknowns follow the errors. So images are grouped into stretches. Each run of
    neighbouring stretches is left out in turn, and the change of the answer shows how much it depends on
    them. The variance by that over that of independent errors is the factor by which variances are too small.
    It comes from few runs, so it is uncertain itself, as for a Student variable. [Kunsch, "The jackknife and
    the bootstrap for general stationary observations", 1989; docs/math/filter.md]

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
        if len(self._done) > WINDOWS:  # the oldest two become one
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
