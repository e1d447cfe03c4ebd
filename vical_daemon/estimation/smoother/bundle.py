"""Inertial bundle adjustment of one window: motion, landmarks, biases and calibration at once.

Levenberg-Marquardt on whitened errors; landmarks are eliminated by the Schur complement. Pixel noise, and how
long its errors last, are measured on the way. [docs/math/target_free.md]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dpotrf, dpotrs

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.inertial_links import DONE
from vical_daemon.estimation.model.retract import moved_camera, orthonormal
from vical_daemon.estimation.robust import MEDIAN_RAYLEIGH, MOST_STEPS, huber_weight
from vical_daemon.estimation.significance import LIKELY_SIGMAS, chi_square_limit
from vical_daemon.estimation.smoother.inertial import links_left, moves
from vical_daemon.estimation.smoother.marginal_prior import MarginalPrior, calibration_difference, carried_out
from vical_daemon.estimation.smoother.normal import HUBER, ImageNoise, Normal, Problem, View, inverse_roots
from vical_daemon.estimation.smoother.track_errors import with_track_errors
from vical_daemon.estimation.smoother.window import Seen, Window
from vical_daemon.estimation.temporal.track_orientations import MIN_FEATURES

_OUT = np.sqrt(chi_square_limit(2, LIKELY_SIGMAS))  # sigmas; an observation beyond is taken out
_DAMPING = 1e-12
"""Of the diagonal, while steps succeed. Links make the entries of each image 1e10 times what a window knows
of the tilt of them all: at 1e-9 windows stopped with 20 deg of tilt hidden in the accelerometer's bias."""
_FAR = 1e-3  # 1/m: nearer to infinity no image shows a distance
_BOUNDS = 0.2, 5.0  # of an inverse distance after a step, over that before it
_SMALL = 0.1  # of the sum of squares: outliers stand out once a step is predicted to reduce it by less
_MORE = 1.2  # times the offsets of images that are allowed for: so much does not end a window
_LESS = 1.1  # of the noise of features, over what is measured now: then a window goes on with that
_MOVED = ("R", "p", "v", "bias", "camera", "landmarks", "imu", "own_lens", "jumps")  # what a step changes
_MEMORY = 25  # images over which an error of the pixels may last
LEAST_PARALLAX = 1.0  # below, noise prevails in the inverse distances


class Fit(NamedTuple):
    """How a window came out.

    Attributes:
        carry: What goes on from its last image; sigmas as tracks show them (`with_track_errors`).
        counted: The same by the noise of the pixels alone.
        squares: Sum of squared whitened pixel errors of the observations kept.
        dof: Their degrees of freedom.
        inertial: Squared whitened errors of the links over their number of rows.
        noise: Of the images, as it was found; of the lens model, as it was taken to be.
        steps: Iterations done.
        settled: The last of them changed nothing to speak of.
        used, refused: Observations.
        change: Constants and jumps found minus those carried in, at the first image, as errors of
            `MarginalPrior`, shape (d,); zero for tilt, speed and biases.
        landmarks: How many.
        parallax: Typical angle under which a landmark's rays cross, over the noise of a ray.
        own_lens: Covariance of the window's own lens, shape (n, n), or (0, 0).
    """

    carry: MarginalPrior
    counted: MarginalPrior
    squares: float
    dof: int
    inertial: float
    noise: ImageNoise
    steps: int
    settled: bool
    used: int
    refused: int
    change: FloatArray
    landmarks: int
    parallax: float
    own_lens: FloatArray


class _Step(NamedTuple):
    states: FloatArray
    landmarks: FloatArray  # (L, 3)
    predicted_reduction: float  # by how much the sum of squares should fall
    root: FloatArray | None  # see `_root`; None where the step was damped or bounded


@dataclass(slots=True)
class _Present:
    """A window about its present values.

    Attributes:
        view: Of the observations.
        normal: Normal equations.
        damping: Of the next step.
        cleaned: Observations that do not fit have been taken out.
        failures: Steps in a row that were not taken.
    """

    view: View
    normal: Normal
    damping: float = _DAMPING
    cleaned: bool = False
    failures: int = 0

    def relax(self, gain: float = 1.0) -> None:
        """A step succeeded, and lowered the sum of squares by `gain` times what was predicted.

        [Nielsen, "Damping parameter in Marquardt's method", 1999]
        """
        self.failures = 0
        factor = max(0.1, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
        self.damping = max(factor * self.damping, _DAMPING)

    def tighten(self) -> None:
        """A step failed. The second time the factor is larger: from `_DAMPING` it is a long way up."""
        self.damping *= 10.0 if self.failures == 0 else 100.0
        self.failures += 1


class Bundle:
    """Adjusts one window.

    Args:
        window: Is changed in place.
        carry: What was known before.
        noise: Of the images, first guess.
    """

    def __init__(self, window: Window, carry: MarginalPrior, noise: ImageNoise) -> None:
        self.window, self.carry = window, carry
        self.problem = Problem(window, carry, noise)
        self.view: View | None = None

    # ------------------------------------------------------------------ the loop
    def solve(self, buffer: ImuBuffer, most: int) -> Fit | None:
        """Iterate until nothing changes or `most` steps are done; None where it does not hold together."""
        w, now = self.window, self._present()
        for steps in range(1, most + 1):
            step = None if now is None else self._step(now.normal, now.damping, settle=now.cleaned)
            if now is None or step is None:
                return None
            if now.cleaned and now.damping > _DAMPING and step.predicted_reduction < DONE:
                bare = self._step(now.normal, _DAMPING, settle=True)  # with damping, little is predicted
                if bare is not None and bare.predicted_reduction >= DONE:
                    self._tried(now, step)
                    now = self._relinearised(now, buffer)
                    continue
                step = bare or step
            if step.predicted_reduction >= (DONE if now.cleaned else _SMALL * now.normal.cost):
                if not self._tried(now, step) or not w.stale():
                    continue
            elif not now.cleaned:  # close enough to tell outliers
                now.view = self._applied(step, now.view.seen)
                self._learn_noise(now.view)
                now.cleaned = not self._refuse(now.view)
                if not now.cleaned:  # without many outliers the noise is less, and more of them show
                    now.view = self.problem.view(w.observe())
                    now.cleaned = not self._fits_better(now.view)
            else:
                self._tried(now, step)
                if self._suspects_offsets(now):
                    w.bad.clear()  # late images had looked like outliers
                elif not self._fits_better(now.view):
                    fit = self._result(now, step.root, steps, settled=True)
                    if fit is None or 2 * steps > most or not self._shows_more(fit):
                        return fit
                    w.bad.clear()
                now.view, now.cleaned = self.problem.view(w.observe()), False
            now = self._relinearised(now, buffer)
        return None if now is None else self._result(now, None, most, settled=False)

    def _present(self) -> _Present | None:
        """The window as it is given; None where too few features are followed."""
        seen = self.window.observe()
        if len(seen.begin) < MIN_FEATURES:
            return None
        view = self.problem.view(seen)
        return _Present(view, self.problem.normal(view))

    def _tried(self, now: _Present, step: _Step) -> bool:
        """Take a step if it lowers the sum of squares; else damp the next one."""
        before = {name: getattr(self.window, name) for name in _MOVED}
        there = self._applied(step, now.view.seen)
        trial = self.problem.normal(there)
        if np.isfinite(trial.cost) and trial.cost <= now.normal.cost:
            gain = (now.normal.cost - trial.cost) / max(step.predicted_reduction, 1e-300)
            now.view, now.normal = there, trial
            now.relax(gain)
            return True
        for name, value in before.items():
            setattr(self.window, name, value)
        now.tighten()
        return False

    def _relinearised(self, now: _Present, buffer: ImuBuffer) -> _Present | None:
        """Normal equations about what has changed; None where readings or features do not reach."""
        if len(now.view.seen.begin) < MIN_FEATURES:
            return None
        if self.window.stale():
            if not self.window.relink(buffer):
                return None
            now.view = self.problem.view(now.view.seen)
        self.window.moves = moves(self.window)
        now.normal = self.problem.normal(now.view)
        return now

    # ------------------------------------------------------------------ step
    def _reduced(self, normal: Normal, lam: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Normal matrix without landmarks (its upper triangle), gradient, what brings the landmarks back."""
        order, F = self.problem.order(), len(self.window.frames)
        inverse = inverse_roots(normal.V, lam)
        L = len(inverse)
        Y = np.matmul(inverse, normal.W).reshape(3 * L, -1)
        u = np.matmul(inverse, normal.gl[..., None]).reshape(-1)
        S = dsyrk(1.0, Y.T, lower=1).T  # Y'Y, its upper triangle
        s = Y.T @ u
        H, g = normal.H.copy(), normal.g.copy()
        at = np.concatenate([order.frames[:, :6].reshape(6 * F), order.camera])
        n, m = 9 * (F - 1), 6 * (F - 1)  # by a view where unknowns lie evenly: a fifth of the time
        H[:n, :n].reshape(F - 1, 9, F - 1, 9)[:, :6, :, :6] -= S[:m, :m].reshape(F - 1, 6, F - 1, 6)
        S[m:, m:] += np.triu(S[m:, m:], 1).T  # the window's own lens comes before the last image in H
        H[np.ix_(at, at[m:])] -= S[:, m:]
        g[at] -= s
        return H, g, inverse, at

    def _displaced(self, normal: Normal, change: FloatArray) -> tuple[Normal, float]:
        """Normal equations after inverse distances have changed, and by how much that lowers the squares.

        Args:
            normal: Before.
            change: Of each inverse distance, which then stays, 1/m, shape (L,); nan: it remains an unknown.
        """
        fixed = np.isfinite(change)
        if not fixed.any():
            return normal, 0.0
        d, (order, F) = change[fixed], (self.problem.order(), len(self.window.frames))
        V, W, gl, g = normal.V.copy(), normal.W.copy(), normal.gl.copy(), normal.g.copy()
        less = -float((2.0 * gl[fixed, 2] + V[fixed, 2, 2] * d) @ d)
        at = np.concatenate([order.frames[:, :6].reshape(6 * F), order.camera])
        g[at] += d @ W[fixed, 2]
        gl[fixed, :2] += V[fixed, :2, 2] * d[:, None]
        V[fixed, 2, :2] = V[fixed, :2, 2] = gl[fixed, 2] = W[fixed, 2] = 0.0
        return normal._replace(V=V, W=W, gl=gl, g=g), less

    def _root(self, normal: Normal) -> FloatArray | None:
        """Cholesky factor of the states' matrix without landmarks, see `_in_place`; None: not positive."""
        try:
            root, info = _in_place(self._reduced(normal, 0.0)[0])
        except np.linalg.LinAlgError:
            return None
        return None if info else root

    def _step(self, normal: Normal, lam: float, *, settle: bool) -> _Step | None:
        """Step of states and landmarks; None where the matrix is not positive.

        No distance may go beyond infinity, nor change by more than `_BOUNDS` in a step. One that would is
        set to its bound, and all else is found with it there. [Bertsekas, "Projected Newton methods for
        optimization problems with simple constraints", 1982]

        Args:
            normal: About the present values.
            lam: Damping, of the diagonal.
            settle: Look for distances beyond their bounds until there are no more. Else once, and what is
                beyond then is cut off: far from the solution such a step lowers the squares all the same.
        """
        inverse = self.window.landmarks.inverse
        low = np.where(inverse < _FAR, 0.0, (_BOUNDS[0] - 1.0) * inverse)
        high = (_BOUNDS[1] - 1.0) * inverse + 10.0 * _FAR
        change = np.where((inverse < _FAR) & (normal.gl[:, 2] > 0.0), 0.0, np.nan)
        for _ in range(MOST_STEPS if settle else 1):
            step = self._unbounded(*self._displaced(normal, change), lam)
            if step is None:
                return None
            free = np.isnan(change)
            step.landmarks[~free, 2] = change[~free]
            wanted = step.landmarks[:, 2]
            beyond = free & ((wanted < low) | (wanted > high))
            if not beyond.any():
                break
            change[beyond] = np.clip(wanted, low, high)[beyond]
        assert step is not None  # there is a round at least
        np.clip(wanted, low, high, out=wanted)
        return step if free.all() else step._replace(root=None)

    def _unbounded(self, normal: Normal, less: float, lam: float) -> _Step | None:
        """Step without bounds; `less` is by how much the squares fall before it."""
        for _ in range(6):
            try:
                H, g, inverse, at = self._reduced(normal, lam)
            except np.linalg.LinAlgError:  # a landmark without any depth
                lam = max(10.0 * lam, 1e-6)
                continue
            H[np.diag_indices_from(H)] *= 1.0 + lam
            root, info = _in_place(H)
            if info == 0:
                dx = -dpotrs(root, g, lower=1)[0]
                right = normal.gl + np.matmul(normal.W, dx[at])
                own = np.matmul(inverse, normal.gl[..., None])
                dl = -np.matmul(np.swapaxes(inverse, 1, 2), np.matmul(inverse, right[..., None]))[..., 0]
                less += float((own**2).sum() - g @ dx)
                return _Step(dx, dl, less, root if lam <= _DAMPING else None)
            lam = max(10.0 * lam, 1e-6)
        return None

    def _applied(self, step: _Step, seen: Seen) -> View:
        """Take a step; what the window then says of the observations."""
        dx, dl = step.states, step.landmarks
        w, order = self.window, self.problem.order()
        d, R, arm = dx[order.frames], w.R, w.camera.p_imu_cam
        layout = self.carry.layout
        full = np.concatenate([np.zeros(layout.core), dx[order.constants]])
        w.camera, w.imu = moved_camera(w.camera, layout.camera, full), w.imu + full[layout.inertial]
        now = w.camera.p_imu_cam
        w.R, w.v = orthonormal(R @ so3.exp(d[:, :3])), w.v + d[:, 6:]
        # cameras move to first order: the product of a turn and a change of the lever arm would displace them
        moved = d[:, 3:6] + np.matvec(R, now - arm + np.cross(d[:, :3], arm))
        w.p = w.p + np.matvec(R, arm) + moved - np.matvec(w.R, now)
        w.bias, w.jumps = w.bias + dx[order.knots], w.jumps + dx[order.jumps]
        if self.problem.own:
            w.own_lens = w.own_lens + dx[order.own]
        inverse = w.landmarks.inverse
        marks = w.landmarks = w.landmarks.moved(dl, moved[seen.frame[seen.begin]])
        np.clip(marks.inverse, _BOUNDS[0] * inverse, _BOUNDS[1] * inverse + 10.0 * _FAR, out=marks.inverse)
        return self.problem.view(seen)

    # ------------------------------------------------------------------ noise, outliers, result
    def _suspects_offsets(self, now: _Present) -> bool:
        """Whether what was adjusted shows images to be off in one way more; from then on they may be."""
        problem = self.problem
        before, problem.noise = problem.noise, problem.suspected(now.view)
        return problem.noise != before

    def _shows_more(self, fit: Fit) -> bool:
        """Whether images are off by much more than was allowed for; then they may be (one step of EM)."""
        allowed, shown = self.problem.noise.offsets, fit.noise.offsets
        more = bool(((shown > _MORE * allowed) & (allowed > 0.0)).any())
        if more:
            self.problem.noise = self.problem.noise.with_offsets(shown)
        return more

    def _learn_noise(self, view: View) -> None:
        """Pixel noise such that the kept errors have the size that they should have."""
        seen, ok, e = view.seen, view.valid, self.problem.pixel_errors(view)[0]
        size = np.sqrt((e[ok] ** 2).sum(axis=1))
        if not len(size):
            return
        # degrees of freedom used up by the fit
        share = np.sqrt(max(self._dof(seen) / max(2 * int(ok.sum()), 1), 0.05))
        noise = self.problem.noise
        sigma_px = float(np.clip(noise.sigma_px * np.median(size) / MEDIAN_RAYLEIGH / share, 0.02, 20.0))
        spread = float(np.sqrt(correlation(e, seen)))
        self.problem.noise = noise._replace(sigma_px=sigma_px, spread=spread)

    def _fits_better(self, view: View) -> bool:
        """Whether errors are smaller than when their noise was measured; then the new one counts.

        Along a valley a window may have been far off then, and with too much noise it stops before its end.
        """
        before = self.problem.noise
        self._learn_noise(view)
        now = self.problem.noise
        better = bool(before.sigma_px * before.spread > _LESS * now.sigma_px * now.spread)
        if not better:
            self.problem.noise = before
        return better

    def _dof(self, seen: Seen) -> int:
        return 2 * len(seen.frame) - 3 * len(seen.begin) - 2 * len(self.window.frames)

    def _refuse(self, view: View) -> int:
        """Take observations out that do not fit, and whole landmarks of which a third does not."""
        seen, e = view.seen, self.problem.pixel_errors(view)[0]
        out = ~view.valid | (np.vecdot(e, e) > _OUT**2)
        count = np.add.reduceat(np.ones(len(out)), seen.begin)
        share = np.add.reduceat(out.astype(float), seen.begin) / count
        out |= (share > 0.34)[seen.landmark]
        w = self.window
        for n in np.flatnonzero(out):
            w.bad.add((w.frames[seen.frame[n]][1].t_cam_ns, int(w.landmarks.ids[seen.landmark[n]])))
        return int(out.sum())

    def _result(self, now: _Present, root: FloatArray | None, steps: int, *, settled: bool) -> Fit | None:
        """How the window came out, by its last normal equations and their root, if that is known."""
        w, order, view, seen = self.window, self.problem.order(), now.view, now.view.seen
        if (root := self._root(now.normal) if root is None else root) is None:
            return None
        own = len(order.own)
        L22 = np.tril(root[order.tail - own :, order.tail - own :])
        try:
            covariance = np.asarray(np.linalg.inv(L22 @ L22.T), dtype=np.float64)
            known = with_track_errors(covariance[own:, own:], self.problem, seen, now.normal, root)
        except np.linalg.LinAlgError:
            return None
        e, ok = self.problem.pixel_errors(view)[0], view.valid
        self.view = view
        inertial, shown, alike = links_left(w, self.problem.noise.offsets, order, root)
        good = ok & (np.vecdot(e, e) <= _OUT**2)
        squares = float((np.minimum((e[ok] ** 2).sum(axis=1), _OUT**2)).sum())
        change = np.concatenate([calibration_difference(w, self.carry), w.jumps - self.carry.jumps])
        return Fit(
            carried_out(w, known, self.carry),
            carried_out(w, covariance[own:, own:], self.carry),
            squares,
            max(self._dof(seen), 1),
            inertial,
            self.problem.noise.with_offsets(shown)._replace(alike=alike),
            steps,
            settled,
            int(good.sum()),
            int((~good).sum()) + len(w.bad),
            change,
            len(seen.begin),
            parallax(w, seen, self.problem.noise),
            covariance[:own, :own],
        )


def _in_place(H: FloatArray) -> tuple[FloatArray, int]:
    """Lower Cholesky factor of a symmetric matrix (upper triangle) in its place, and LAPACK's info.

    Above it is rubbish. Seen as its transpose it is in LAPACK's order: neither copying nor zeroing it saves a
    third of the time.
    """
    root, info = dpotrf(H.T, lower=1, overwrite_a=1, clean=0)
    return root, int(info)


def correlation(e: FloatArray, seen: Seen) -> float:
    """By how much the variance of a track's mean error exceeds that of white noise: 1 + 2 sum rho_k.

    Errors that stay with a feature from image to image (lens, tracker, blur) count once, not once an image.
    The sum ends where the correlation is lost in its own noise. [Geyer, "Practical Markov chain Monte
    Carlo", 1992, initial positive sequence]
    """
    e = e * huber_weight(np.sqrt((e**2).sum(axis=1, keepdims=True)), HUBER)
    variance = float((e**2).mean())
    total = 1.0
    for k in range(1, min(_MEMORY, len(e))):
        same = (seen.landmark[k:] == seen.landmark[:-k]) & (seen.frame[k:] - seen.frame[:-k] == k)
        count = int(same.sum())
        if count < 50:
            break
        rho = float((e[k:][same] * e[:-k][same]).sum()) / (2.0 * count * max(variance, 1e-12))
        if rho < 2.0 / np.sqrt(2.0 * count):
            break
        total += 2.0 * rho
    return total


def parallax(window: Window, seen: Seen, noise: ImageNoise) -> float:
    """Median angle between the first and last ray of the landmarks, over the noise of one ray that lasts.

    The information about speed and lever arm grows with the squared inverse distances as they are estimated,
    noise included.
    """
    last = np.concatenate([seen.begin[1:], [len(seen.frame)]]) - 1
    m = window.landmarks
    X = m.bearing + m.inverse[:, None] * m.anchor
    ends = [X - m.inverse[:, None] * window.p[seen.frame[at]] for at in (seen.begin, last)]
    a, b = (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12) for x in ends)
    angle = float(np.median(np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0))))
    return angle * float(np.mean(window.camera.intrinsics[:2])) / (noise.sigma_px * noise.spread)


def window_reports(problem: Problem, view: View) -> list[FrameReport]:
    """Residuals of every image with landmarks in it, in order of time.

    Args:
        problem: Of the adjusted window.
        view: Its values at the observations it used.

    Returns:
        One report an image, without predictions: a window is adjusted after its images.
    """
    window = problem.window
    seen, ok, e = view.seen, view.valid, problem.pixel_errors(view)[0]
    residual = np.where(ok[:, None], -e * problem.noise.sigma_px, np.nan)
    out = []
    ends = np.append(seen.frame_begin[1:], len(seen.frame))
    for frame, begin, end in zip(seen.frames_with, seen.frame_begin, ends, strict=True):
        rows = seen.by_frame[begin:end]
        image = window.frames[int(frame)][1]
        squares = float((e[rows][ok[rows]] ** 2).sum())
        out.append(
            FrameReport(
                image.t_cam_ns,
                image.camera,
                window.landmarks.ids[seen.landmark[rows]],
                seen.uv[rows],
                residual[rows],
                ok[rows],
                True,
                squares,
                2 * int(ok[rows].sum()),
                problem.noise.sigma_px,
            )
        )
    return out
