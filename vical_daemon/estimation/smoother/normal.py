"""Normal equations of one window: pixels, inertial links and what was carried in; landmarks kept apart."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import project, project_jacobians
from vical_daemon.estimation.geometry.so3 import tangents
from vical_daemon.estimation.measurements import COLUMNS, BoolArray, FloatArray
from vical_daemon.estimation.model.camera_rays import patches_seen, read_share
from vical_daemon.estimation.model.inertial_links import PreintegratedLinks
from vical_daemon.estimation.noise.lens_limit import SYSTEMATIC_PX, patches
from vical_daemon.estimation.noise.stamp_jitter import excess
from vical_daemon.estimation.robust import huber_weight
from vical_daemon.estimation.smoother.inertial import Order, add_links, link_errors
from vical_daemon.estimation.smoother.jitter import first_guess
from vical_daemon.estimation.smoother.marginal_prior import (
    BIASES,
    SPEED,
    TILT,
    MarginalPrior,
    calibration_difference,
)
from vical_daemon.estimation.smoother.window import IntArray, Seen, Window

HUBER = 2.5  # sigmas (of the two axes together)
_GAUGE = 1e10
_INVERSE_SIGMA = 5.0  # 1/m: next to nothing is known about the depth of a new landmark


class Normal(NamedTuple):
    """Normal equations about the present values.

    Attributes:
        H: Of the states, ordered as `Order`, shape (n, n).
        g: Gradient, shape (n,).
        V: Blocks of the landmarks, shape (L, 3, 3).
        W: Coupling of landmarks to [turn, position] of the images and to the camera, (L, 3, 6 F + c).
        gl: Gradient of the landmarks, shape (L, 3).
        cost: Sum of the (robust) squares.
    """

    H: FloatArray
    g: FloatArray
    V: FloatArray
    W: FloatArray
    gl: FloatArray
    cost: float


class ImageNoise(NamedTuple):
    """Noise of the images of a window, as taken to be or as measured.

    Attributes:
        sigma_px: Of a feature, px.
        spread: Square root of how many neighbouring images share an error of the pixels; see `correlation`.
        jitter_s: Standard deviation of the images' stamps, s; 0: they are believed until links contradict.
        lens_px: Misfit of the lens model, see `lens_misfit`, px.
    """

    sigma_px: float
    spread: float = 1.0
    jitter_s: float = 0.0
    lens_px: float = SYSTEMATIC_PX


class Problem:
    """Whitened errors of a window and their derivatives.

    Args:
        window: Present values.
        carry: What was known before.
        noise: Of the images.
    """

    def __init__(self, window: Window, carry: MarginalPrior, noise: ImageNoise) -> None:
        self.window, self.carry, self.noise = window, carry, noise
        self.own = 0 if carry.layout.camera.intrinsics is None else len(window.own_lens)
        uv = np.concatenate([frame.uv_px for _, frame in window.frames])
        seen = patches_seen(uv, carry.camera.resolution)
        self.lens_root = (
            patches(carry.camera, seen) / noise.lens_px
        )  # of the information in the prior of the own lens

    def order(self) -> Order:
        """Places of the unknowns."""
        w, layout = self.window, self.carry.layout
        of_imu = layout.dynamic - layout.core
        return Order(len(w.frames), len(w.bias), layout.size - layout.core, of_imu, self.own, len(w.jumps))

    # ------------------------------------------------------------------ pixels
    def _rays(self, seen: Seen) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Landmarks in the camera frame at their observations, scaled by rho; and parts for derivatives."""
        w, cam = self.window, self.window.camera
        rates = w.rates()
        late = cam.timeshift_s - w.shift_s + cam.skew * self._since()
        if cam.readout_s:  # each row has an instant of its own
            late, frame = late[seen.frame] + cam.readout_s * seen.row, seen.frame
            rates = rates[frame]
            alpha, accel = w.accelerations()
            half = 0.5 * (late * late)[:, None]
            R = w.R[frame] @ so3.exp(rates * late[:, None] + half * alpha[frame])
            p = w.p[frame] + w.v[frame] * late[:, None] + half * accel[frame]
        else:
            R = (w.R @ so3.exp(rates * late[:, None]))[seen.frame]
            p = (w.p + w.v * late[:, None])[seen.frame]
            rates = rates[seen.frame]
        marks = w.landmarks
        rho = marks.inverse[seen.landmark]
        X = marks.bearing[seen.landmark] + rho[:, None] * (marks.anchor[seen.landmark] - p)
        x_imu = np.einsum("nji,nj->ni", R, X)
        y = (x_imu - rho[:, None] * cam.p_imu_cam) @ cam.R_imu_cam
        return y, x_imu, R, rates

    def _since(self) -> FloatArray:
        """Seconds from the first image to each, shape (F,)."""
        stamps = np.array([t for t, _ in self.window.frames])
        return np.asarray(stamps - stamps[0])

    def pixel_errors(self, seen: Seen) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Whitened errors (N, 2), which are valid, and Huber weights."""
        y = self._rays(seen)[0]
        with np.errstate(all="ignore"):
            uv = project(y, *self.window.lens)
        return self._weigh(seen, uv)

    def _weigh(self, seen: Seen, uv: FloatArray) -> tuple[FloatArray, BoolArray, FloatArray]:
        ok: BoolArray = np.asarray(np.isfinite(uv).all(axis=1))
        e = np.where(ok[:, None], (np.where(ok[:, None], uv, 0.0) - seen.uv) / self.noise.sigma_px, 0.0)
        size = np.sqrt((e**2).sum(axis=1))
        weight = np.where(ok, huber_weight(size, HUBER), 0.0)
        return e, ok, weight

    def normal(self, seen: Seen, links: PreintegratedLinks) -> Normal:
        """Normal equations with landmarks kept apart."""
        w, cam = self.window, self.window.camera
        y, x_imu, R, rates = self._rays(seen)
        with np.errstate(all="ignore"):
            uv, Jy, Jlens = project_jacobians(y, *w.lens)
        e, ok, weight = self._weigh(seen, uv)
        root = np.sqrt(weight) / (self.noise.sigma_px * self.noise.spread)
        Jy = np.where(ok[:, None, None], Jy, 0.0) * root[:, None, None]
        Jlens = np.where(ok[:, None, None], Jlens, 0.0) * root[:, None, None]
        e = e * np.sqrt(weight)[:, None]
        cost = self._robust_cost(e, weight) / self.noise.spread**2
        e = e / self.noise.spread
        marks = w.landmarks
        rho = marks.inverse[seen.landmark][:, None, None]
        Rt = np.ascontiguousarray(np.swapaxes(R, 1, 2))  # three times as fast below
        JR = (Jy.reshape(-1, 3) @ cam.R_imu_cam.T).reshape(Jy.shape)  # by the point in the imu frame
        JW = JR @ Rt  # by the point in the world
        by_shift = self._by_shift(seen, JR, R, x_imu, rates)
        Jf = np.concatenate([so3.cross(JR, x_imu[:, None]), -rho * JW], axis=2)
        Jc = self._by_camera(seen, -rho * JR, so3.cross(Jy, y[:, None]), by_shift, Jlens)
        basis = tangents(marks.bearing)[seen.landmark]
        away = marks.anchor[seen.landmark] - w.p[seen.frame]
        by_rho = np.einsum("nij,nj->ni", JW, away) - JR @ cam.p_imu_cam
        Jl = np.concatenate([JW @ basis, by_rho[..., None]], axis=2)
        return self._assemble(seen, links, e, Jf, Jc, Jl, cost)

    def _by_camera(
        self, seen: Seen, by_arm: FloatArray, by_turn: FloatArray, by_shift: FloatArray, by_lens: FloatArray
    ) -> FloatArray:
        """How pixels move with those constants that move them, and with the window's own lens, (N, 2, c)."""
        layout, where = self.carry.layout, self.carry.layout.camera
        J = np.empty((len(by_shift), 2, layout.size + self.own))
        if where.position is not None and where.rotation is not None:
            J[:, :, where.position], J[:, :, where.rotation] = by_arm, by_turn
        if where.timeshift is not None and where.skew is not None:
            J[:, :, where.timeshift] = by_shift
            J[:, :, where.skew] = by_shift * self._since()[seen.frame, None]
        if where.intrinsics is not None and where.distortion is not None:
            J[:, :, where.intrinsics.start : where.distortion.stop] = by_lens
        if where.readout is not None:
            J[:, :, where.readout] = by_shift * seen.row[:, None]
        J[:, :, layout.size :] = by_lens[:, :, : self.own]
        return J[:, :, layout.dynamic :]

    def _by_shift(
        self, seen: Seen, JR: FloatArray, R: FloatArray, x_imu: FloatArray, rates: FloatArray
    ) -> FloatArray:
        """How pixels move with the time of the exposure: the imu turns and moves on, shape (N, 2)."""
        rho = self.window.landmarks.inverse[seen.landmark]
        forward = np.einsum("nj,nji->ni", self.window.v[seen.frame], R)  # speed in the imu frame
        moved = so3.cross(x_imu, rates) - rho[:, None] * forward
        return np.asarray(np.einsum("nij,nj->ni", JR, moved))

    def pixels_late(self, seen: Seen) -> tuple[FloatArray, FloatArray]:
        """By how much each image looks late by its pixels, s, and the variance by their noise, shape (F,)."""
        by_shift, e = self._whitened_by_shift(seen)
        F = len(self.window.frames)
        size = np.bincount(seen.frame, (by_shift**2).sum(axis=1), F)
        late = np.bincount(seen.frame, (by_shift * e).sum(axis=1), F)
        shown = size > 0.0
        return late[shown] / size[shown], self.noise.spread**2 / size[shown]

    def late_by_columns(self, seen: Seen) -> float:
        """By how much at least the squared errors would fall if columns were read one after the other.

        At the optimum of all else this is the score test of one more parameter, with the information that
        it would have were all else known: a lower bound. [Rao 1948]
        """
        by_shift, e = self._whitened_by_shift(seen)
        by_column = by_shift * read_share(seen.uv, self.window.camera.resolution, COLUMNS)[:, None]
        size = float((by_column**2).sum())
        return float((by_column * e).sum()) ** 2 / max(size, 1e-300) / self.noise.spread**2

    def _whitened_by_shift(self, seen: Seen) -> tuple[FloatArray, FloatArray]:
        """How pixels move with the exposure's time, and their errors, both over their noise, (N, 2) each."""
        cam = self.window.camera
        y, x_imu, R, rates = self._rays(seen)
        with np.errstate(all="ignore"):
            uv, Jy, _ = project_jacobians(y, *self.window.lens)
        e, ok, weight = self._weigh(seen, uv)
        JR = (np.where(ok[:, None, None], Jy, 0.0).reshape(-1, 3) @ cam.R_imu_cam.T).reshape(Jy.shape)
        root = np.sqrt(weight)[:, None]
        return self._by_shift(seen, JR, R, x_imu, rates) * root / self.noise.sigma_px, e * root

    def _robust_cost(self, e: FloatArray, weight: FloatArray) -> float:
        """Sum of the Huber losses (e is weighted already: weight * size^2)."""
        square = (e**2).sum(axis=1)
        inner = square
        outer = 2.0 * HUBER * np.sqrt(square / np.maximum(weight, 1e-12)) - HUBER**2
        return float(np.where(weight < 1.0, outer, inner).sum()) + 1e4 * float((weight == 0.0).sum())

    def _assemble(
        self,
        seen: Seen,
        links: PreintegratedLinks,
        e: FloatArray,
        Jf: FloatArray,
        Jc: FloatArray,
        Jl: FloatArray,
        cost: float,
    ) -> Normal:
        w = self.window
        F, k, L = len(w.frames), Jc.shape[2], len(seen.begin)
        order = self.order()
        camera = order.camera
        H, g = np.zeros((order.size, order.size)), np.zeros(order.size)
        begin, by, fb, fw = seen.begin, seen.by_frame, seen.frame_begin, seen.frames_with
        Jall = np.concatenate([Jf, Jc, e[..., None]], axis=2)
        sorted_J = Jall[by]
        blocks = _products(sorted_J[:, :, :6], sorted_J, fb)
        pose = order.frames[:, :6]
        at = pose[fw]
        H[at[:, :, None], at[:, None, :]] += blocks[:, :, :6]
        H[at[:, :, None], camera] += blocks[:, :, 6:-1]
        H[camera[:, None], at.reshape(1, -1)] += blocks[:, :, 6:-1].reshape(-1, k).T
        g[at] += blocks[:, :, -1]
        flat = Jc.reshape(-1, k)
        H[camera[:, None], camera] += flat.T @ flat
        g[camera] += flat.T @ e.reshape(-1)
        own = _products(Jl, np.concatenate([Jl, Jall[:, :, 6:]], axis=2), begin)
        V = own[:, :, :3].copy()
        V[:, 2, 2] += _INVERSE_SIGMA**-2
        gl = own[:, :, -1].copy()
        gl[:, 2] += w.landmarks.inverse * _INVERSE_SIGMA**-2
        cost += float((w.landmarks.inverse**2).sum()) * _INVERSE_SIGMA**-2
        W = np.zeros((L, 3, 6 * F + k))
        W[:, :, 6 * F :] = own[:, :, 3:-1]
        by_frame = W[:, :, : 6 * F].reshape(L, 3, F, 6)  # the same memory
        by_frame[seen.landmark, :, seen.frame] = np.swapaxes(Jl, 1, 2) @ Jf  # seen once in an image
        cost += add_links(w, links, self.noise.jitter_s, order, H, g)
        cost += self._add_prior(H, g, order) + self._add_own_lens(H, g, order)
        return Normal(H, g, V, W, gl, cost)

    def suspected_jitter_s(self, seen: Seen, links: PreintegratedLinks) -> float:
        """Jitter of the stamps, s, that errors show while stamps are believed; 0 where it may be chance.

        A late image is torn between its links and its pixels: the stiffer of the two keeps most of the error.
        """
        by_links = first_guess(self.window, *link_errors(self.window, links))
        late, variance = self.pixels_late(seen)
        return float(np.hypot(by_links, excess(late**2, variance)))

    # ------------------------------------------------------------------ prior
    def _prior_errors(self) -> tuple[FloatArray, FloatArray]:
        """Errors (d,) of the carried knowledge and derivatives (d, 9 + 6 + k + jumps)."""
        w, c = self.window, self.carry
        R0, v0 = w.R[0], w.v[0]
        up, now = c.R[2], R0[2]
        B = tangents(up[None])[0]
        speed = R0.T @ v0
        e = np.concatenate([calibration_difference(w, c), w.jumps - c.jumps])
        e[TILT], e[SPEED], e[BIASES] = B.T @ np.cross(now, up), speed - c.speed, w.bias[0] - c.bias
        J = np.zeros((len(e), len(e) + 4))  # an image has four errors more than tilt and speed
        J[TILT, :3] = B.T
        J[SPEED, :3], J[SPEED, 6:9] = so3.hat(speed), R0.T
        J[BIASES.start :, 9:] = np.eye(len(e) - BIASES.start)
        return c.root @ e, c.root @ J

    def _add_prior(self, H: FloatArray, g: FloatArray, order: Order) -> float:
        e, J = self._prior_errors()
        at = np.concatenate([order.frames[0], order.knots[0], order.constants, order.jumps])
        H[at[:, None], at] += J.T @ J
        g[at] += J.T @ e
        # where the origin lies and which way is north cannot be seen: held, at no cost
        turn, place = order.frames[0][:3], order.frames[0][3:6]
        up = self.window.R[0][2]
        H[turn[:, None], turn] += _GAUGE * np.outer(up, up)
        H[place, place] += _GAUGE
        return float(e @ e)

    def _add_own_lens(self, H: FloatArray, g: FloatArray, order: Order) -> float:
        """How far the lens of a window may be from the common one."""
        if not self.own:
            return 0.0
        e = self.lens_root @ self.window.own_lens
        H[order.own[:, None], order.own] += self.lens_root.T @ self.lens_root
        g[order.own] += self.lens_root.T @ e
        return float(e @ e)


def _products(A: FloatArray, B: FloatArray, begin: IntArray) -> FloatArray:
    """Sums of A_n^T B_n over groups of rows, (N, 2, a) and (N, 2, b) to (groups, a, b).

    One product of long matrices a group: numpy takes three times as long for many small ones.
    """
    a, b = A.shape[2], B.shape[2]
    A, B = A.reshape(-1, a), B.reshape(-1, b)
    out = np.empty((len(begin), a, b))
    edges = [*(2 * begin).tolist(), len(A)]
    for k, (low, high) in enumerate(pairwise(edges)):
        np.matmul(A[low:high].T, B[low:high], out=out[k])
    return out
