"""Mounting, delay and gyro bias from feature tracks alone: the epipolar constraint with the gyro's rotation.

Between two images the rays a, b of one feature obey t . (a x R b) = 0 for an unknown direction t. The gyro
gives R = R_imu_cam^T dR(t_i + shift, t_j + shift; bias) R_imu_cam, so that all pairs of a stretch share the
same seven unknowns, whatever the depths and translations are; the direction t of each pair is eliminated
[after Kneip & Lynen, "Direct optimization of frame-to-frame rotation", 2013, with the gyro's rotation in
place of a free one]. Unlike strung-together two-view rotations nothing accumulates. The focal length can be
fitted along: a turn by a known angle moves a feature by a length in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import project_jacobians
from vical_daemon.estimation.measurements import BoolArray, FloatArray, Frames, IntArray
from vical_daemon.estimation.model.camera_rays import unproject
from vical_daemon.estimation.model.inertial_links import DONE
from vical_daemon.estimation.model.priors import GYRO_BIAS_SIGMA_RPS, WINDOW_START
from vical_daemon.estimation.robust import geman_mcclure_weight, sigma_by_median
from vical_daemon.estimation.significance import STRETCH_S
from vical_daemon.estimation.temporal.epipolar_errors import (
    Effects,
    TrackNoise,
    gyro_scores,
    persistent_scores,
    sighting_errors,
    track_noise,
)
from vical_daemon.estimation.temporal.epipolar_pairs import LAGS_S, Pairs, make_pairs
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve

_ITERATIONS = 18  # steps, at most: five with a wide gate, five with the lens as given, then to convergence
# What a lens may be off by: focal length and its ratio (relative), distortion.
_FOCAL_SIGMA, _RATIO_SIGMA = 0.1, 0.003
_DISTORTION_SIGMA = {
    "radtan": (0.1, 0.1, 0.005, 0.005),
    "plumb_bob": (0.1, 0.1, 0.005, 0.005, 0.1),
    "equidistant": (0.05, 0.05, 0.05, 0.05),
}
_LENS_AFTER = 4  # iterations with the lens as given
_LEAST_RAYS = 0.5  # share of the features; no lens near the given one leaves more of them without a ray
_GOOD = 0.25  # weight of a feature that fits
_BENT_UNSURE = 0.5  # of what noise bends: one draw, and a straight line through two sizes of noise
_FAR_S, _FAR_EVERY = (1.0, 2.0), 4  # pairs that show how long errors last
_BLOCK_S = LAGS_S[-1]  # errors of the fit are taken as independent beyond this


@dataclass(slots=True)
class EpipolarFit:
    """What the tracks say together with the gyro.

    Attributes:
        R_imu_cam: Mounting, shape (3, 3).
        timeshift_s: t_imu = t_cam + timeshift_s, s.
        gyro_bias: rad/s, shape (3,).
        intrinsics: fx fy cx cy, px; as given unless the lens was fitted.
        distortion: The model's coefficients; likewise.
        rotation_covariance: Of the mounting, about the camera's axes, rad^2, shape (3, 3).
        timeshift_sigma_s: s.
        error: RMS epipolar error of the pairs used, in focal lengths.
        inliers: Share of the feature pairs that fit.
        stretches: What stretches of the data say alone, [mounting about the camera's axes, rad; delay, s] and
            its covariance, with errors that persist along tracks; empty unless asked for.
        covariance: The same for the whole, shape (4, 4); with errors that persist.
    """

    R_imu_cam: FloatArray
    timeshift_s: float
    gyro_bias: FloatArray
    intrinsics: FloatArray
    distortion: FloatArray
    rotation_covariance: FloatArray
    timeshift_sigma_s: float
    error: float
    inliers: float
    stretches: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    covariance: FloatArray = field(default_factory=lambda: np.full((4, 4), np.nan))


def epipolar_fit(
    t_imu_s: FloatArray,
    gyro_rps: FloatArray,
    frames: Frames,
    lens: tuple[FloatArray, FloatArray, str],
    R_imu_cam: FloatArray,
    timeshift_s: float,
    *,
    fit_lens: bool = False,
    every: int = 1,
    gyro_density: float | None = None,
    roughly: bool = False,
) -> EpipolarFit | None:
    """Fit mounting, delay, gyro bias (and the focal length) to tracks.

    Args:
        t_imu_s: Stamps of the gyro, s, shape (m,).
        gyro_rps: Rates, rad/s, imu frame, shape (m, 3).
        frames: (stamp in the camera's clock in s, tracks), in order of time.
        lens: fx fy cx cy, distortion, model.
        R_imu_cam: Start of the mounting, good to some 20 degrees.
        timeshift_s: Start of the delay, good to some 0.1 s.
        fit_lens: Fit the lens too, within what a rough lens may be off by.
        every: See `make_pairs`.
        gyro_density: Of the gyro's noise, rad/s/sqrt(Hz); where given, what is known of errors that persist
            along tracks goes into `covariance` and `stretches`.
        roughly: End where a step is predicted to lower the squared errors by less than `DONE`: enough to
            compare places to start from. Errors are weighted anew, so each step is two thirds of the one
            before, and else hardly any fit ends before its last step.

    Returns:
        The fit; None where the tracks do not allow one. Sigmas are empirical (sandwich over half-second
        blocks), so slow errors of the tracker count.
    """
    pairs = make_pairs(frames, every=every)
    if pairs is None:
        return None
    fit = _Fit(t_imu_s, gyro_rps, frames, pairs, lens, fit_lens, gyro_density)
    return fit.run(R_imu_cam.copy(), timeshift_s, roughly=roughly)


class _Fit:
    """Gauss-Newton with the translations' directions eliminated.

    Errors are angles: a longer focal length makes those of the same pixels smaller, and would be preferred
    without any reason in the scene. What that adds to the gradient of fx and fy (`shrinking`) is taken out;
    on a cart, where nothing else shows fy, it had come out 60 % too long.
    """

    def __init__(
        self,
        t_imu: FloatArray,
        gyro: FloatArray,
        frames: Frames,
        pairs: Pairs,
        lens: tuple[FloatArray, FloatArray, str],
        fit_lens: bool,
        gyro_density: float | None,
    ) -> None:
        self.t_imu, self.gyro, self.gyro_density = t_imu, gyro, gyro_density
        self.frames, self.t_cam = frames, np.array([t for t, _ in frames])
        self.pairs, self.fit_lens, self.lens_free = pairs, fit_lens, False
        self.intrinsics, self.distortion, self.model = lens[0].copy(), lens[1].copy(), lens[2]
        self.given = (lens[0].copy(), lens[1].copy())
        self.dray: list[FloatArray] = []
        self.shrinking = np.zeros((len(pairs.of), 2))
        self.lasting = 1.0
        self._rays()

    def _rays(self) -> None:
        p, lens = self.pairs, (self.intrinsics, self.distortion, self.model)
        rays, ok = unproject(p.uv, *lens)
        rays = np.where(ok[:, None], rays, [0.0, 0.0, 1.0])
        self.a, self.b = (np.take(rays, at, axis=0) for at in (p.at_1, p.at_2))
        self.ok: BoolArray = ok[p.at_1] & ok[p.at_2]
        if self.fit_lens:
            change = self._ray_change(rays)
            self.dray = [np.take(change, at, axis=0) for at in (p.at_1, p.at_2)]

    def _ray_change(self, rays: FloatArray) -> FloatArray:
        """D ray / d (fx fy cx cy, distortion) for a fixed pixel, shape (n, 3, 4 + coefficients).

        The pixel stays: J_ray d ray + J_lens d lens = 0, and the ray keeps its length: since J_ray ray = 0,
        d ray = -J_ray^T (J_ray J_ray^T)^-1 J_lens d lens does both.
        """
        with np.errstate(all="ignore"):
            _, J, J_lens = project_jacobians(rays, self.intrinsics, self.distortion, self.model)
            (a, b), c = (np.einsum("nk,njk->jn", J[:, 0], J)), np.vecdot(J[:, 1], J[:, 1])
            inverse = np.stack([c, -b, -b, a], axis=-1).reshape(-1, 2, 2) / (a * c - b * b)[:, None, None]
            out = -np.swapaxes(J, 1, 2) @ (inverse @ J_lens)
        out[~np.isfinite(out).all(axis=(1, 2))] = 0.0
        return np.asarray(out)

    def run(self, R: FloatArray, shift: float, *, roughly: bool) -> EpipolarFit | None:
        bias = np.zeros(3)
        weight = np.where(self.ok, 1.0, 0.0)
        for step in range(_ITERATIONS):
            self.lens_free = self.fit_lens and step >= _LENS_AFTER  # first with the lens as given
            lin = self._linearise(R, shift, bias)
            if lin is None:
                return None
            e, J, Jt = lin
            spread = sigma_by_median(e[self.ok]) + 1e-9
            k = 4.0 if step < 5 else 2.5
            weight = np.where(self.ok, geman_mcclure_weight((e / (k * spread)) ** 2), 0.0)
            H, g, each = self._normal(e, J, Jt, weight / spread**2)
            if self.lens_free:
                self.lasting = self._errors_last(H, each) if step == _LENS_AFTER else self.lasting
                g[7:9] += (weight * (e / spread) ** 2) @ self.shrinking
            self._prior(H, g, bias)
            dx = np.asarray(-np.linalg.solve(H + 1e-9 * np.diag(np.diag(H)), g), np.float64)
            near = roughly and float(-g @ dx) < DONE
            dx *= min(1.0, 0.2 / max(float(np.abs(dx[:3]).max()), 1e-12))
            R = R @ so3.exp(dx[:3])
            shift += float(dx[3])
            bias = bias + dx[4:7]
            if self.lens_free:
                self.intrinsics = self.intrinsics + dx[7:11]
                self.distortion = self.distortion + dx[11:]
                self._rays()
                if self.ok.mean() < _LEAST_RAYS:
                    return None  # the lens has run away
            near |= float(np.abs(dx[:3]).max()) < 1e-5 and abs(dx[3]) < 1e-6
            if near and step > _LENS_AFTER + 2:
                break
        return self._result(R, shift, bias, weight)

    def _errors_last(self, H: FloatArray, each: FloatArray) -> float:
        """By how much the scatter of blocks exceeds that of independent pairs, for the lens; at least 1.

        A sighting is in several pairs, and errors of a tracker, or of a model without rolling shutter, last:
        taken as independent, pairs outvote any prior of the lens.
        """
        scores = self._by_block(each)
        scores -= scores.mean(axis=0)
        inverse = np.linalg.inv(H + 1e-9 * np.diag(np.diag(H)))
        scatter = np.diag(inverse @ (scores.T @ scores) @ inverse) / np.diag(inverse)
        return max(1.0, float(np.median(scatter[7:])))

    def _by_block(self, each: FloatArray) -> FloatArray:
        """Gradients of the pairs (P, n) summed over half-second blocks."""
        t = self.t_cam[self.pairs.first]
        block = ((t - t[0]) / _BLOCK_S).astype(int)
        sums = np.zeros((int(block.max()) + 1, each.shape[1]))
        np.add.at(sums, block, each)
        return sums

    def _prior(self, H: FloatArray, g: FloatArray, bias: FloatArray) -> None:
        """Add what is known before: of the bias, and of the lens where it is among the unknowns."""
        H[range(4, 7), range(4, 7)] += GYRO_BIAS_SIGMA_RPS**-2
        g[4:7] += bias / GYRO_BIAS_SIGMA_RPS**2
        if len(g) == 7:
            return
        f = self.given[0][0]
        focal = np.eye(2) * _FOCAL_SIGMA**-2 + np.array([[1.0, -1.0], [-1.0, 1.0]]) * _RATIO_SIGMA**-2
        P = np.zeros((len(g) - 7,) * 2)
        P[:2, :2] = focal / f**2
        P[2:4, 2:4] = np.eye(2) / (WINDOW_START.centre * f) ** 2
        P[4:, 4:] = np.diag(np.array(_DISTORTION_SIGMA[self.model]) ** -2.0)
        P *= self.lasting
        off = np.concatenate([self.intrinsics - self.given[0], self.distortion - self.given[1]])
        H[7:, 7:] += P
        g[7:] += P @ off

    def _linearise(
        self, R: FloatArray, shift: float, bias: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Normalised errors (n,), derivatives by the k shared unknowns (n, k) and by t (n, 2)."""
        p = self.pairs
        t = self.t_cam + shift
        curve = GyroCurve.integrate(self.t_imu, self.gyro, bias)
        inside = (t > self.t_imu[0]) & (t < self.t_imu[-1])
        if inside.mean() < 0.7:
            return None
        A, rate, area = curve.at(np.clip(t, self.t_imu[0], self.t_imu[-1]))
        A1, A2 = A[p.first], A[p.second]
        dR = np.swapaxes(A1, 1, 2) @ A2
        R12 = R.T @ dR @ R
        usable = (inside[p.first] & inside[p.second])[p.of] & self.ok
        b = np.matvec(np.take(R12, p.of, axis=0), self.b)
        n = so3.cross(self.a, b) * usable[:, None]
        vectors = np.linalg.eigh(_products(n, n, p.begin))[1]
        d, Bt = (np.take(part, p.of, axis=0) for part in (vectors[:, :, 0], vectors[:, :, 1:]))
        ta, tb = so3.cross(d, self.a), so3.cross(d, b)
        length = np.sqrt(np.vecdot(ta, ta) + np.vecdot(tb, tb)) + 1e-6
        e = np.where(usable, np.vecdot(d, n) / length, 0.0)
        if self.lens_free:
            across = ta[:, :2] ** 2 + tb[:, :2] ** 2
            self.shrinking = usable[:, None] * across / across.sum(-1, keepdims=True) / self.intrinsics[:2]
        # a turn delta local to the second image: d . (a x R (delta x b)) = delta . (b x R^T (d x a))
        back = np.matvec(np.take(np.swapaxes(R12, 1, 2), p.of, axis=0), ta)
        local = so3.cross(self.b, back)
        by_turn = self._turns(R, R12, dR, rate, area, A2)
        J = np.vecmat(local, np.take(by_turn, p.of, axis=0))
        if self.lens_free:
            lens = np.vecmat(back, self.dray[1]) - np.vecmat(tb, self.dray[0])
            J = np.concatenate([J, lens], axis=1)
        Jt = np.vecmat(n, Bt)
        if self.gyro_density is not None:
            share = (usable / length)[:, None]
            turned = np.matvec((A2 @ R)[p.of], local)
            self.effects = Effects(-tb[:, :2] * share, back[:, :2] * share, turned * share)
        return e, J * (usable / length)[:, None], Jt * (usable / length)[:, None]

    def _turns(
        self,
        R: FloatArray,
        R12: FloatArray,
        dR: FloatArray,
        rate: FloatArray,
        area: FloatArray,
        A2: FloatArray,
    ) -> FloatArray:
        """Local turn of the second image by mounting, delay and bias, shape (P, 3, 7)."""
        p = self.pairs
        out = np.empty((len(dR), 3, 7))
        out[:, :, :3] = np.eye(3) - np.swapaxes(R12, 1, 2)
        spin = rate[p.second] - np.matvec(np.swapaxes(dR, 1, 2), rate[p.first])
        out[:, :, 3] = spin @ R
        out[:, :, 4:] = -R.T @ np.swapaxes(A2, 1, 2) @ (area[p.second] - area[p.first])
        return out

    def _normal(
        self, e: FloatArray, J: FloatArray, Jt: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal equations with the directions eliminated, and each pair's share of the gradient."""
        tx, solved = self._directions(np.concatenate([J, e[:, None]], axis=1), Jt, weight)
        wJ, xt = J * weight[:, None], np.swapaxes(tx[..., :-1], 1, 2)
        H = wJ.T @ J - (xt @ solved[..., :-1]).sum(axis=0)
        each = np.add.reduceat(wJ * e[:, None], self.pairs.begin) - np.matmul(xt, solved[..., -1:])[..., 0]
        return H, each.sum(axis=0), each

    def _directions(
        self, columns: FloatArray, Jt: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Jt' W columns by pair, and the move of its direction that fits the columns best, (P, 2, p) each."""
        both = _products(Jt * weight[:, None], np.concatenate([Jt, columns], axis=1), self.pairs.begin)
        tt, tx = both[..., :2] + 1e-9 * np.eye(2), both[..., 2:]
        return tx, np.asarray(np.linalg.solve(tt, tx), np.float64)

    def _result(
        self, R: FloatArray, shift: float, bias: FloatArray, weight: FloatArray
    ) -> EpipolarFit | None:
        lin = self._linearise(R, shift, bias)
        if lin is None:
            return None
        e, J, Jt = lin
        good = weight > _GOOD
        if not good.any():
            return None
        error = float(np.sqrt(np.mean(e[good] ** 2)))
        H, g, each = self._normal(e, J, Jt, weight / max(error, 1e-9) ** 2)
        self._prior(H, g, bias)
        try:
            inverse = np.linalg.inv(H)
        except np.linalg.LinAlgError:
            return None
        sums = self._by_block(each)
        covariance = inverse @ (sums.T @ sums) @ inverse + inverse
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        stretches: list[tuple[FloatArray, FloatArray]] = []
        whole = np.full((4, 4), np.nan)
        if self.gyro_density is not None:
            self.noise = self._track_noise((R, shift, bias), e, good)
            stretches, whole, slope = self._persistent((e, J, Jt, weight), H.shape[0], error, bias)
            bent = self._bent_by_noise(R, shift, bias, weight, slope, error)
            R, shift = R @ so3.exp(-bent[:3]), shift - float(bent[3])
            whole = whole + _BENT_UNSURE**2 * np.outer(bent, bent)
        if not (np.isfinite(sigma).all() and np.isfinite(R).all()):
            return None
        return EpipolarFit(
            R,
            shift,
            bias,
            self.intrinsics,
            self.distortion,
            covariance[:3, :3],
            float(sigma[3]),
            error,
            float(good[self.ok].mean()),
            stretches,
            whole,
        )

    def _persistent(
        self,
        rows: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
        size: int,
        error: float,
        bias: FloatArray,
    ) -> tuple[list[tuple[FloatArray, FloatArray]], FloatArray, float]:
        """Answers of stretches, covariance of the whole, with errors that persist; slope of the influence."""
        e, J, Jt, weight = rows
        p, good = self.pairs, (weight > _GOOD).astype(np.float64)
        # a robust fit gives way by the slope of its influence, not by its weight: the large errors hold less
        u2 = 1.0 / np.sqrt(np.maximum(weight, 1e-12)) - 1.0
        slope = float((good * weight * (1.0 - 3.0 * u2) / (1.0 + u2)).sum() / max(good.sum(), 1.0))
        # in the gradient large errors count by their weight: smaller, but as persistent
        gain = float((good * (weight * e) ** 2).sum() / max(float((good * e**2).sum()), 1e-30))
        noise = replace(self.noise, white=gain * self.noise.white, persistent=gain * self.noise.persistent)
        prior, off = np.zeros((size, size)), np.zeros(size)
        self._prior(prior, off, bias)
        t = self.t_cam[p.first]
        count = max(1, int((t[-1] - t[0]) / STRETCH_S))
        stretch = np.minimum(((t - t[0]) / max(t[-1] - t[0], 1e-9) * count).astype(int), count - 1)
        assert self.gyro_density is not None
        out = []
        for chosen in [np.ones(len(t), dtype=np.bool_), *(stretch == k for k in range(count))]:
            w = good * chosen[p.of] / max(error, 1e-9) ** 2
            H, g, _ = self._normal(weight * e, J, Jt, w)
            follows = self._directions(J, Jt, w)[1]
            clear = (J - np.vecmat(Jt, follows[p.of])) * w[:, None]  # each pair's direction follows along
            M = persistent_scores(clear, p, self.t_cam, self.effects, noise)
            M += slope**2 * gyro_scores(clear, p, self.t_cam, self.effects, self.gyro_density)
            inverse = np.linalg.inv(slope * H + prior)
            C = inverse @ (M + prior) @ inverse
            out.append((-(inverse @ (g + off))[:4], C[:4, :4]))
        return out[1:], out[0][1], slope

    def _bent_by_noise(
        self, R: FloatArray, shift: float, bias: FloatArray, weight: FloatArray, slope: float, error: float
    ) -> FloatArray:
        """What the errors of the sightings do to mounting and delay on average, shape (4,).

        Rays with errors give directions and derivatives with errors of their own, which do not average out:
        0.5 px turned the mounting by 0.2 deg. Errors of the same size are added once more, and again with the
        opposite sign so that what is linear in them cancels; they move the answer as far again [Cook and
        Stefanski, "Simulation-extrapolation estimation in parametric measurement error models", 1994].
        """
        given = self.pairs
        first, second = sighting_errors(given, self.t_cam, self.noise, float(np.mean(self.intrinsics[:2])))
        good = weight > _GOOD
        moved, squares, H = list[FloatArray](), list[float](), np.zeros((0, 0))
        for sign in (0.0, 1.0, -1.0):
            self.pairs = given.moved(sign * first, sign * second)
            self._rays()
            lin = self._linearise(R, shift, bias)
            if lin is None:
                break
            w = weight / max(error, 1e-9) ** 2
            h, g, _ = self._normal(lin[0], lin[1], lin[2], w)
            g[7:9] += (w * lin[0] ** 2) @ self.shrinking if self.fit_lens else 0.0
            self._prior(h, np.zeros(len(g)), bias)
            H = h if not moved else H
            moved.append(g)
            squares.append(float(np.mean(lin[0][good] ** 2)))
        self.pairs = given
        self._rays()
        if len(moved) < 3:
            return np.zeros(4)
        # as much as doubles the residuals' variance, and by the slope of the influence as in `_persistent`
        grown = 0.5 * (squares[1] + squares[2]) - squares[0]
        share = squares[0] / max(grown, 0.1 * squares[0])
        give = slope * float(np.mean(good)) / max(float(np.mean(weight)), 1e-9)
        change = 0.5 * (moved[1] + moved[2]) - moved[0]
        return np.asarray(-share * np.linalg.solve(give * H, change)[:4], dtype=np.float64)

    def _track_noise(
        self, at: tuple[FloatArray, float, FloatArray], e: FloatArray, good: BoolArray
    ) -> TrackNoise:
        """Errors of single sightings by the residuals, those of pairs far apart among them."""
        lag = (self.t_cam[self.pairs.second] - self.t_cam[self.pairs.first])[self.pairs.of]
        short, effects = self.pairs, self.effects
        parts = [(e[good], lag[good], effects.by_first[good], effects.by_second[good])]
        far = make_pairs(self.frames, _FAR_S, _FAR_EVERY)
        if far is not None:
            self.pairs = far
            self._rays()
            lin = self._linearise(*at)
            if lin is not None:
                lag = (self.t_cam[far.second] - self.t_cam[far.first])[far.of]
                near = np.abs(lin[0]) < 2.5 * sigma_by_median(lin[0][self.ok]) + 1e-9
                near &= self.ok
                by = self.effects
                parts.append((lin[0][near], lag[near], by.by_first[near], by.by_second[near]))
            self.pairs, self.effects = short, effects
            self._rays()
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return track_noise(columns[0], columns[1], columns[2], columns[3])


def _products(a: FloatArray, b: FloatArray, begin: IntArray) -> FloatArray:
    """Sum of a' b over the rows of each pair, shape (P, i, j), of rows (n, i) and (n, j)."""
    out = np.empty((len(begin), a.shape[1], b.shape[1]))
    for pair, (low, high) in enumerate(pairwise([*begin.tolist(), len(a)])):
        np.matmul(a[low:high].T, b[low:high], out=out[pair])
    return out
