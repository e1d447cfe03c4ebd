"""Inertial bundle adjustment of one window: motion, landmarks, biases and calibration at once.

Levenberg-Marquardt on whitened errors; landmarks are eliminated by the Schur complement. What a window
knows leaves it as a `Carry`: the marginal over what lives on (tilt, speed, biases, calibration) in
coordinates that do not know where the world's origin and heading are, so that no information about them can
arise from nothing. [docs/math/target_free.md]
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from vical_daemon.estimation import so3
from vical_daemon.estimation.camera_model import project_jacobians
from vical_daemon.estimation.free_window import KNOT_S, Landmarks, Seen, Window
from vical_daemon.estimation.imu_model import ImuBuffer
from vical_daemon.estimation.inertial_links import Links
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.retract import orthonormal
from vical_daemon.estimation.state import CameraState

ARM, TURN, SHIFT, LENS = slice(0, 3), slice(3, 6), 6, slice(7, 15)  # of the calibration's 15 errors
_FULL = 15
_HUBER = 2.5  # sigmas (of the two axes together)
_GAUGE = 1e10
_INVERSE_SIGMA = 5.0  # 1/m: next to nothing is known about the depth of a new landmark
_OUT = 4.5  # sigmas; an observation beyond is taken out
_MEMORY = 25  # images over which an error of the pixels may last
_DONE = 1.0  # a step that promises less than this of the sum of squares is the last
_SMALL = 0.02  # of the sum of squares: from here on outliers stand out


@dataclass(slots=True)
class Carry:
    """What is known at the first image of a window before its own data.

    Errors: tilt (2), speed in the imu frame (3), biases (6), calibration (the active ones of 15).

    Attributes:
        R: Attitude there; only its tilt matters.
        speed: Velocity in the imu frame, m/s, shape (3,).
        bias: [gyro, accel], shape (6,).
        camera: Calibration.
        root: W with W^T W = information of the errors, shape (d, d).
        active: Which of the 15 calibration errors are estimated.
    """

    R: FloatArray
    speed: FloatArray
    bias: FloatArray
    camera: CameraState
    root: FloatArray
    active: BoolArray

    def covariance(self) -> FloatArray:
        """Covariance of the errors, shape (d, d)."""
        inverse = np.linalg.inv(self.root)
        return np.asarray(inverse @ inverse.T)


class Fit(NamedTuple):
    """How a window came out.

    Attributes:
        carry: What goes on from its last image.
        squares: Sum of squared whitened pixel errors of the observations kept.
        dof: Their degrees of freedom.
        inertial: Squared whitened errors of the links over their number of rows.
        sigma_px: Pixel noise that was found.
        spread: Square root of the images that share an error.
        steps: Iterations done.
        used, refused: Observations.
        change: Calibration found minus the one carried in, shape (k,), active errors only.
        landmarks: How many.
        parallax_deg: Typical angle under which a landmark's rays cross.
    """

    carry: Carry
    squares: float
    dof: int
    inertial: float
    sigma_px: float
    spread: float
    steps: int
    used: int
    refused: int
    change: FloatArray
    landmarks: int
    parallax_deg: float


class _Step(NamedTuple):
    states: FloatArray
    landmarks: FloatArray  # (L, 3)
    promise: float  # by how much the sum of squares should fall


class _Normal(NamedTuple):
    H: FloatArray  # reduced normal matrix, ordered as `_Order`
    g: FloatArray
    V: FloatArray  # landmark blocks (L, 3, 3)
    W: FloatArray  # (L, 3, 6 F + k): coupling of landmarks to [turn, position] of images and calibration
    gl: FloatArray  # (L, 3)
    cost: float


class Bundle:
    """Adjusts one window.

    Args:
        window: Is changed in place.
        carry: What was known before.
        sigma_px: Pixel noise, first guess.
        spread: Square root of how many neighbouring images share an error of the pixels; see `_correlation`.
    """

    def __init__(self, window: Window, carry: Carry, sigma_px: float, spread: float = 1.0) -> None:
        self.window, self.carry, self.sigma_px, self.spread = window, carry, sigma_px, spread
        self.active = np.flatnonzero(carry.active)
        self.gauge_yaw = carry.R[2]  # world's z seen from the first image

    # ------------------------------------------------------------------ the loop
    def solve(self, buffer: ImuBuffer, most: int) -> Fit | None:
        """Iterate until nothing changes or `most` steps are done; None where it does not hold together."""
        w = self.window
        seen = w.observe()
        if len(seen.begin) < 8:
            return None
        lam, steps, cleaned = 1e-7, 0, False
        links = w.stacked()
        normal = self._normal(seen, links)
        while steps < most:
            steps += 1
            step = self._step(normal, lam)
            if step is None:
                return None
            if cleaned and step.promise < _DONE:
                self._apply(step)
                break
            if not cleaned and step.promise < _SMALL * normal.cost:
                # close enough to tell what does not belong
                self._apply(step)
                cleaned = True
                self._learn_noise(seen)
                if self._refuse(seen):
                    seen = w.observe()
                    if len(seen.begin) < 8:
                        return None
            else:
                saved = self._save()
                self._apply(step)
                trial = self._normal(seen, links)
                if not np.isfinite(trial.cost) or trial.cost > normal.cost:
                    self._restore(saved)
                    lam = max(10.0 * lam, 1e-4)
                    if lam > 1e6:
                        break
                    continue
                normal, lam = trial, max(0.1 * lam, 1e-9)
                if not w.stale():
                    continue
            if w.stale():
                if not w.relink(buffer):
                    return None
                links = w.stacked()
            normal = self._normal(seen, links)
        return self._result(seen, links, normal, steps)

    def _save(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, CameraState, Landmarks]:
        w = self.window
        return w.R, w.p, w.v, w.bias, w.camera, w.landmarks

    def _restore(
        self, s: tuple[FloatArray, FloatArray, FloatArray, FloatArray, CameraState, Landmarks]
    ) -> None:
        w = self.window
        w.R, w.p, w.v, w.bias, w.camera, w.landmarks = s

    # ------------------------------------------------------------------ pixels
    def _rays(self, seen: Seen) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Landmarks in the camera frame at their observations, scaled by rho; and parts for derivatives."""
        w, cam = self.window, self.window.camera
        late = cam.timeshift_s - w.shift_s + seen.row_s
        rates = w.rates()[seen.frame]
        R = w.R[seen.frame] @ so3.exp(rates * late[:, None])
        p = w.p[seen.frame] + w.v[seen.frame] * late[:, None]
        marks = w.landmarks
        rho = marks.inverse[seen.landmark]
        X = marks.bearing[seen.landmark] + rho[:, None] * (marks.anchor[seen.landmark] - p)
        x_imu = np.einsum("nji,nj->ni", R, X)
        y = (x_imu - rho[:, None] * cam.p_imu_cam) @ cam.R_imu_cam
        return y, x_imu, R, rates

    def _pixel_errors(self, seen: Seen) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Whitened errors (N, 2), which are valid, and Huber weights."""
        y = self._rays(seen)[0]
        cam = self.window.camera
        with np.errstate(all="ignore"):
            uv = project_jacobians(y, cam.intrinsics, cam.distortion, cam.distortion_model)[0]
        return self._weigh(seen, uv)

    def _weigh(self, seen: Seen, uv: FloatArray) -> tuple[FloatArray, BoolArray, FloatArray]:
        ok = np.isfinite(uv).all(axis=1)
        e = np.where(ok[:, None], (np.where(ok[:, None], uv, 0.0) - seen.uv) / self.sigma_px, 0.0)
        size = np.sqrt((e**2).sum(axis=1))
        weight = np.where(ok, np.minimum(1.0, _HUBER / np.maximum(size, 1e-9)), 0.0)
        return e, ok, weight

    def _normal(self, seen: Seen, links: Links) -> _Normal:
        """Normal equations with landmarks kept apart."""
        w, cam = self.window, self.window.camera
        y, x_imu, R, rates = self._rays(seen)
        with np.errstate(all="ignore"):
            uv, Jy, Jlens = project_jacobians(y, cam.intrinsics, cam.distortion, cam.distortion_model)
        e, ok, weight = self._weigh(seen, uv)
        root = np.sqrt(weight) / (self.sigma_px * self.spread)
        Jy = np.where(ok[:, None, None], Jy, 0.0) * root[:, None, None]
        Jlens = np.where(ok[:, None, None], Jlens, 0.0) * root[:, None, None]
        e = e * np.sqrt(weight)[:, None]
        cost = self._robust_cost(e, weight) / self.spread**2
        e = e / self.spread
        marks = w.landmarks
        rho = marks.inverse[seen.landmark][:, None, None]
        Rt = np.swapaxes(R, 1, 2)
        JR = Jy @ cam.R_imu_cam.T  # by the point in the imu frame
        JW = JR @ Rt  # by the point in the world
        Jf = np.concatenate([JR @ so3.hat(x_imu), -rho * JW], axis=2)
        Jc = np.empty((len(e), 2, _FULL))
        Jc[:, :, ARM], Jc[:, :, TURN] = -rho * JR / 1.0, Jy @ so3.hat(y)
        v_imu = np.matmul(Rt, w.v[seen.frame][..., None])
        spin = np.cross(x_imu, rates)[..., None] - rho * v_imu
        Jc[:, :, SHIFT] = np.matmul(JR, spin)[..., 0]
        Jc[:, :, LENS] = Jlens
        Jc = Jc[:, :, self.active]
        basis = _tangents(marks.bearing)[seen.landmark]
        away = marks.anchor[seen.landmark] - w.p[seen.frame]
        by_rho = np.matmul(JW, away[..., None])[..., 0] - JR @ cam.p_imu_cam
        Jl = np.concatenate([JW @ basis, by_rho[..., None]], axis=2)
        return self._assemble(seen, links, e, Jf, Jc, Jl, cost)

    def _robust_cost(self, e: FloatArray, weight: FloatArray) -> float:
        """Sum of the Huber losses (e is weighted already: weight * size^2)."""
        square = (e**2).sum(axis=1)
        inner = square
        outer = 2.0 * _HUBER * np.sqrt(square / np.maximum(weight, 1e-12)) - _HUBER**2
        return float(np.where(weight < 1.0, outer, inner).sum()) + 1e4 * float((weight == 0.0).sum())

    def _assemble(
        self,
        seen: Seen,
        links: Links,
        e: FloatArray,
        Jf: FloatArray,
        Jc: FloatArray,
        Jl: FloatArray,
        cost: float,
    ) -> _Normal:
        w = self.window
        F, K, k, L = len(w.frames), len(w.bias), len(self.active), len(seen.begin)
        order = _Order(F, K, k)
        H, g = np.zeros((order.size, order.size)), np.zeros(order.size)
        JfT, JcT, JlT = (np.swapaxes(J, 1, 2) for J in (Jf, Jc, Jl))
        begin, by, fb, fw = seen.begin, seen.by_frame, seen.frame_begin, seen.frames_with
        Jall = np.concatenate([Jf, Jc, e[..., None]], axis=2)
        blocks = np.add.reduceat((JfT @ Jall)[by], fb)
        pose = order.frames[:, :6]
        at = pose[fw]
        H[at[:, :, None], at[:, None, :]] += blocks[:, :, :6]
        H[at[:, :, None], order.calib] += blocks[:, :, 6:-1]
        H[order.calib[:, None], at.reshape(1, -1)] += blocks[:, :, 6:-1].reshape(-1, k).T
        g[at] += blocks[:, :, -1]
        flat = Jc.reshape(-1, k)
        H[order.calib[:, None], order.calib] += flat.T @ flat
        g[order.calib] += flat.T @ e.reshape(-1)
        V = np.add.reduceat(JlT @ Jl, begin)
        V[:, 2, 2] += _INVERSE_SIGMA**-2
        gl = np.add.reduceat(np.matmul(JlT, e[..., None])[..., 0], begin)
        gl[:, 2] += w.landmarks.inverse * _INVERSE_SIGMA**-2
        cost += float((w.landmarks.inverse**2).sum()) * _INVERSE_SIGMA**-2
        W = np.zeros((L, 3, 6 * F + k))
        W[:, :, 6 * F :] = np.add.reduceat(JlT @ Jc, begin)
        poses = np.zeros((L, F, 3, 6))  # a landmark is seen once in an image
        poses[seen.landmark, seen.frame] = JlT @ Jf
        W[:, :, : 6 * F] = poses.transpose(0, 2, 1, 3).reshape(L, 3, 6 * F)
        cost += self._add_links(H, g, order, links)
        cost += self._add_prior(H, g, order)
        return _Normal(H, g, V, W, gl, cost)

    # ------------------------------------------------------------------ inertial part and prior
    def _add_links(self, H: FloatArray, g: FloatArray, order: _Order, links: Links) -> float:
        w = self.window
        knots = w.knots()
        e, J = links.errors(w.R, w.p, w.v, w.bias[knots], w.gravity)
        JT = np.swapaxes(J, 1, 2)
        A, b = JT @ J, np.matmul(JT, e[..., None])[..., 0]
        # neighbours share an image and many links a knot: even and odd links, then the knots one by one
        for first in (0, 1):
            at = np.concatenate([order.frames[first:-1:2], order.frames[first + 1 :: 2]], axis=1)
            H[at[:, :, None], at[:, None, :]] += A[first::2, :18, :18]
            g[at] += b[first::2, :18]
        for knot in range(len(w.bias)):
            own = np.flatnonzero(knots == knot)
            rows = order.knots[knot]
            H[rows[:, None], rows] += A[own, 18:, 18:].sum(axis=0)
            g[rows] += b[own, 18:].sum(axis=0)
            for first in (0, 9):
                at = order.frames[own + first // 9].reshape(-1)
                side = A[own, first : first + 9, 18:].reshape(-1, 6)
                H[at[:, None], rows] += side
                H[rows[:, None], at] += side.T
        cost = float((e**2).sum())
        information = np.repeat([w.noise.gyro_walk**-2, w.noise.accel_walk**-2], 3) / KNOT_S
        for m in range(len(w.bias) - 1):
            a, c = order.knots[m], order.knots[m + 1]
            off = w.bias[m + 1] - w.bias[m]
            H[a, a] += information
            H[c, c] += information
            H[a, c] -= information
            H[c, a] -= information
            g[a] -= information * off
            g[c] += information * off
            cost += float(information @ off**2)
        return cost

    def _prior_errors(self) -> tuple[FloatArray, FloatArray]:
        """Errors (d,) of the carried knowledge and derivatives (d, 9 + 6 + k)."""
        w, c = self.window, self.carry
        R0, v0 = w.R[0], w.v[0]
        up, now = c.R[2], R0[2]
        B = _tangents(up[None])[0]
        speed = R0.T @ v0
        calibration = calibration_difference(w.camera, c.camera)[self.active]
        e = np.concatenate([B.T @ np.cross(now, up), speed - c.speed, w.bias[0] - c.bias, calibration])
        J = np.zeros((len(e), 15 + len(self.active)))
        J[:2, :3] = B.T
        J[2:5, :3], J[2:5, 6:9] = so3.hat(speed), R0.T
        J[5:11, 9:15] = np.eye(6)
        J[11:, 15:] = np.eye(len(self.active))
        return c.root @ e, c.root @ J

    def _add_prior(self, H: FloatArray, g: FloatArray, order: _Order) -> float:
        e, J = self._prior_errors()
        at = np.concatenate([order.frames[0], order.knots[0], order.calib])
        H[at[:, None], at] += J.T @ J
        g[at] += J.T @ e
        # where the origin lies and which way is north cannot be seen: held, at no cost
        turn, place = order.frames[0][:3], order.frames[0][3:6]
        up = self.window.R[0][2]
        H[turn[:, None], turn] += _GAUGE * np.outer(up, up)
        H[place, place] += _GAUGE
        return float(e @ e)

    # ------------------------------------------------------------------ step
    def _reduced(self, normal: _Normal, lam: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Normal matrix without landmarks, gradient, and what brings the landmarks back."""
        order = self._order()
        F = len(self.window.frames)
        tiny = 1e-10 * np.trace(normal.V, axis1=1, axis2=2)
        V = normal.V * (1.0 + lam * np.eye(3)) + tiny[:, None, None] * np.eye(3)
        root = np.linalg.cholesky(V)
        inverse = np.linalg.inv(root)
        L = len(V)
        Y = np.matmul(inverse, normal.W).reshape(3 * L, -1)
        u = np.matmul(inverse, normal.gl[..., None]).reshape(-1)
        S = Y.T @ Y
        s = Y.T @ u
        H, g = normal.H.copy(), normal.g.copy()
        at = np.concatenate([order.frames[:, :6].reshape(6 * F), order.calib])
        H[np.ix_(at, at)] -= S
        g[at] -= s
        return H, g, inverse, at

    def _order(self) -> _Order:
        return _Order(len(self.window.frames), len(self.window.bias), len(self.active))

    def _step(self, normal: _Normal, lam: float) -> _Step | None:
        """Step of states and landmarks; None where the matrix is not positive."""
        for _ in range(6):
            try:
                H, g, inverse, at = self._reduced(normal, lam)
            except np.linalg.LinAlgError:  # a landmark without any depth
                lam = max(10.0 * lam, 1e-6)
                continue
            H[np.diag_indices_from(H)] *= 1.0 + lam
            root, info = dpotrf(H, lower=1, overwrite_a=1)
            if info == 0:
                dx = -dpotrs(root, g, lower=1)[0]
                right = normal.gl + np.matmul(normal.W, dx[at])
                own = np.matmul(inverse, normal.gl[..., None])
                dl = -np.matmul(np.swapaxes(inverse, 1, 2), np.matmul(inverse, right[..., None]))[..., 0]
                return _Step(dx, dl, float((own**2).sum() - g @ dx))
            lam = max(10.0 * lam, 1e-6)
        return None

    def _apply(self, step: _Step) -> None:
        dx, dl = step.states, step.landmarks
        w, order = self.window, self._order()
        d = dx[order.frames]
        w.R = orthonormal_all(w.R @ so3.exp(d[:, :3]))
        w.p, w.v = w.p + d[:, 3:6], w.v + d[:, 6:]
        w.bias = w.bias + dx[order.knots]
        full = np.zeros(_FULL)
        full[self.active] = dx[order.calib]
        w.camera = moved(w.camera, full)
        m = w.landmarks
        bearing = m.bearing + np.matmul(_tangents(m.bearing), dl[:, :2, None])[..., 0]
        bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
        inverse = np.clip(m.inverse + dl[:, 2], 0.2 * m.inverse, 5.0 * m.inverse + 0.01)
        w.landmarks = Landmarks(m.ids, m.anchor, bearing, inverse)

    # ------------------------------------------------------------------ noise, outliers, result
    def _learn_noise(self, seen: Seen) -> None:
        """Pixel noise such that the kept errors have the size that they should have."""
        e, ok, _ = self._pixel_errors(seen)
        size = np.sqrt((e[ok] ** 2).sum(axis=1))
        if not len(size):
            return
        # median of a Rayleigh variable is 1.1774 sigma; degrees of freedom used up by the fit
        share = np.sqrt(max(self._dof(seen) / max(2 * int(ok.sum()), 1), 0.05))
        self.sigma_px = float(np.clip(self.sigma_px * np.median(size) / 1.1774 / share, 0.02, 20.0))
        self.spread = float(np.sqrt(_correlation(np.where(ok[:, None], e, 0.0), seen)))

    def _dof(self, seen: Seen) -> int:
        return 2 * len(seen.frame) - 3 * len(seen.begin) - 2 * len(self.window.frames)

    def _refuse(self, seen: Seen) -> int:
        """Take observations out that do not fit, and whole landmarks of which a third does not."""
        e, ok, _ = self._pixel_errors(seen)
        out = ~ok | ((e**2).sum(axis=1) > _OUT**2)
        count = np.add.reduceat(np.ones(len(out)), seen.begin)
        share = np.add.reduceat(out.astype(float), seen.begin) / count
        out |= (share > 0.34)[seen.landmark]
        w = self.window
        for n in np.flatnonzero(out):
            w.bad.add((w.frames[seen.frame[n]][1].t_cam_ns, int(w.landmarks.ids[seen.landmark[n]])))
        return int(out.sum())

    def _result(self, seen: Seen, links: Links, normal: _Normal, steps: int) -> Fit | None:
        w, order = self.window, self._order()
        try:
            H = self._reduced(normal, 0.0)[0]
        except np.linalg.LinAlgError:
            return None
        root, info = dpotrf(H, lower=1, overwrite_a=1)
        if info:
            return None
        tail = order.tail
        L22 = np.tril(root[tail:, tail:])
        try:
            covariance = np.linalg.inv(L22 @ L22.T)
        except np.linalg.LinAlgError:
            return None
        e, ok, weight = self._pixel_errors(seen)
        links_e = links.errors(w.R, w.p, w.v, w.bias[w.knots()], w.gravity)[0]
        good = ok & ((e**2).sum(axis=1) <= _OUT**2)
        squares = float((np.minimum((e[ok] ** 2).sum(axis=1), _OUT**2)).sum())
        change = calibration_difference(w.camera, self.carry.camera)[self.active]
        return Fit(
            self._carry_out(covariance),
            squares,
            max(self._dof(seen), 1),
            float((links_e**2).mean()),
            self.sigma_px,
            self.spread,
            steps,
            int(good.sum()),
            int((~good).sum()) + len(w.bad),
            change,
            len(seen.begin),
            self._parallax(seen),
        )

    def _carry_out(self, covariance: FloatArray) -> Carry:
        """Marginal of [last image 9, last knot 6, calibration] in coordinates without origin and heading."""
        w, k = self.window, len(self.active)
        R, v = w.R[-1], w.v[-1]
        J = np.zeros((11 + k, 15 + k))
        speed = R.T @ v
        J[:2, :3] = _tangents(R[2][None])[0].T
        J[2:5, :3], J[2:5, 6:9] = so3.hat(speed), R.T
        J[5:11, 9:15] = np.eye(6)
        J[11:, 15:] = np.eye(k)
        P = J @ covariance @ J.T
        root = np.linalg.inv(np.linalg.cholesky(P + 1e-18 * np.eye(len(P))))
        return Carry(R.copy(), speed, w.bias[-1].copy(), w.camera, root, self.carry.active)

    def _parallax(self, seen: Seen) -> float:
        """Median angle between the first and last ray of the landmarks, deg."""
        w = self.window
        last = np.concatenate([seen.begin[1:], [len(seen.frame)]]) - 1
        m = w.landmarks
        X = m.bearing + m.inverse[:, None] * m.anchor
        ends = [X - m.inverse[:, None] * w.p[seen.frame[at]] for at in (seen.begin, last)]
        a, b = (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12) for x in ends)
        return float(np.rad2deg(np.median(np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0)))))


class _Order:
    """Places of the unknowns: images but the last, knots but the last, last image, last knot, calibration."""

    def __init__(self, F: int, K: int, k: int) -> None:
        self.size = 9 * F + 6 * K + k
        self.tail = 9 * (F - 1) + 6 * (K - 1)
        frames = np.arange(9 * (F - 1)).reshape(F - 1, 9)
        knots = 9 * (F - 1) + np.arange(6 * (K - 1)).reshape(K - 1, 6)
        self.frames = np.concatenate([frames, self.tail + np.arange(9)[None]])
        self.knots = np.concatenate([knots, self.tail + 9 + np.arange(6)[None]])
        self.calib = self.tail + 15 + np.arange(k)


def _correlation(e: FloatArray, seen: Seen) -> float:
    """By how much the variance of a track's mean error exceeds that of white noise: 1 + 2 sum rho_k.

    Errors that stay with a feature from image to image (lens, tracker, blur) count once, not once an image.
    The sum ends where the correlation is lost in its own noise. [Geyer, "Practical Markov chain Monte
    Carlo", 1992, initial positive sequence]
    """
    size = np.sqrt((e**2).sum(axis=1, keepdims=True))
    e = e * np.minimum(1.0, _HUBER / np.maximum(size, 1e-9))
    variance = float((e**2).mean())
    total = 1.0
    for k in range(1, _MEMORY):
        if len(e) <= k:
            break
        same = (seen.landmark[k:] == seen.landmark[:-k]) & (seen.frame[k:] - seen.frame[:-k] == k)
        count = int(same.sum())
        if count < 50:
            break
        rho = float((e[k:][same] * e[:-k][same]).sum()) / (2.0 * count * max(variance, 1e-12))
        if rho < 2.0 / np.sqrt(2.0 * count):
            break
        total += 2.0 * rho
    return total


def _tangents(bearing: FloatArray) -> FloatArray:
    """Two directions across each unit vector, shape (n, 3, 2); smooth but at one pole."""
    x, y, z = bearing[:, 0], bearing[:, 1], bearing[:, 2]
    sign = np.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    out = np.empty((len(bearing), 3, 2))
    out[:, :, 0] = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    out[:, :, 1] = np.stack([b, sign + y * y * a, -y], axis=1)
    return out


def orthonormal_all(R: FloatArray) -> FloatArray:
    """One Newton step towards the nearest rotation for each of a batch (`retract.orthonormal`)."""
    return np.asarray(1.5 * R - 0.5 * R @ (np.swapaxes(R, -1, -2) @ R))


def calibration_difference(now: CameraState, then: CameraState) -> FloatArray:
    """Errors [arm, turn (local), shift, lens 8] that lead from `then` to `now`, shape (15,)."""
    return np.concatenate(
        [
            now.p_imu_cam - then.p_imu_cam,
            so3.log(then.R_imu_cam.T @ now.R_imu_cam),
            [now.timeshift_s - then.timeshift_s],
            now.intrinsics - then.intrinsics,
            now.distortion - then.distortion,
        ]
    )


def moved(camera: CameraState, d: FloatArray) -> CameraState:
    """The camera with an error of 15 applied."""
    return replace(
        camera,
        R_imu_cam=orthonormal(camera.R_imu_cam @ so3.exp(d[TURN])),
        p_imu_cam=camera.p_imu_cam + d[ARM],
        timeshift_s=camera.timeshift_s + float(d[SHIFT]),
        intrinsics=camera.intrinsics + d[7:11],
        distortion=camera.distortion + d[11:],
    )


def first_carry(window: Window, active: BoolArray, sigmas: FloatArray) -> Carry:
    """Next to nothing known: wide sigmas around a start.

    Args:
        window: Started window; its camera is the centre of the prior.
        active: Which of the 15 calibration errors are estimated, shape (15,).
        sigmas: Of the 15 calibration errors.
    """
    wide = np.concatenate([[1.0] * 2, [5.0] * 3, [0.02] * 3, [0.3] * 3, sigmas[np.flatnonzero(active)]])
    R = window.R[0]
    return Carry(R.copy(), R.T @ window.v[0], np.zeros(6), window.camera, np.diag(1.0 / wide), active)
