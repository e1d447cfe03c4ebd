"""Normal equations of one window: pixels, inertial links and what was carried in; landmarks kept apart."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import project_jacobians
from vical_daemon.estimation.geometry.so3 import tangents
from vical_daemon.estimation.measurements import COLUMNS, BoolArray, FloatArray
from vical_daemon.estimation.model.camera_rays import patches_seen, read_share
from vical_daemon.estimation.noise.lens_limit import SYSTEMATIC_PX, patches
from vical_daemon.estimation.robust import huber_weight
from vical_daemon.estimation.significance import LIKELY_SIGMAS
from vical_daemon.estimation.smoother.inertial import (
    FLOORS,
    LATE,
    SHIFTED,
    ImageOffsets,
    Order,
    add_links,
    evidence,
    excess,
    link_errors,
    moves,
)
from vical_daemon.estimation.smoother.marginal_prior import (
    BIASES,
    SPEED,
    TILT,
    MarginalPrior,
    calibration_difference,
)
from vical_daemon.estimation.smoother.window import IntArray, Seen, Window

HUBER = 2.5  # sigmas (of the two axes together)
POSE = slice(3, 9)
"""Columns of `Normal.J` for turn and place of the image."""
_CONSTANTS = 9  # the first column of them
_GAUGE = 1e10  # information that holds the window's place and heading, 1/m^2 and 1/rad^2: 10 um
_NO_DEPTH = 1e-10  # share of a landmark's information that is added to it: some have none about their depth
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
        J: Whitened derivatives of the N observations, see `_derivatives`, shape (N, 2, 9 + c + 1).
    """

    H: FloatArray
    g: FloatArray
    V: FloatArray
    W: FloatArray
    gl: FloatArray
    cost: float
    J: FloatArray


class View(NamedTuple):
    """The landmarks as the camera sees them by the present values, at their N observations.

    Attributes:
        seen: The observations.
        uv: Where they should be, px, shape (N, 2); where measured, if behind the camera.
        valid: Those in front of the camera, shape (N,).
        y, x_imu: In the frames of camera and imu, times rho, shape (N, 3).
        R: R_world_imu at their exposure, shape (N, 3, 3).
        rates: Angular rate there, rad/s, shape (N, 3).
        by_point: Derivatives of uv by y, shape (N, 2, 3); 0 behind the camera.
        by_lens: By fx fy cx cy and the distortion, shape (N, 2, 4 + d); 0 behind the camera.
    """

    seen: Seen
    uv: FloatArray
    valid: BoolArray
    y: FloatArray
    x_imu: FloatArray
    R: FloatArray
    rates: FloatArray
    by_point: FloatArray
    by_lens: FloatArray


class ImageNoise(NamedTuple):
    """Noise of the images of a window, as taken to be or as measured.

    Attributes:
        sigma_px: Of a feature, px.
        spread: Square root of how many neighbouring images share an error of the pixels; see `correlation`.
        jitter_s: Standard deviation of the images' stamps, s; 0: they are believed until errors contradict.
        shift_px: Standard deviation by which whole images are off, per axis, px; likewise.
        lens_px: Misfit of the lens model, see `LensMisfit`, px.
        alike: Correlation of what the stamps of neighbouring images are off by, as measured.
    """

    sigma_px: float
    spread: float = 1.0
    jitter_s: float = 0.0
    shift_px: float = 0.0
    lens_px: float = SYSTEMATIC_PX
    alike: float = 0.0

    @property
    def offsets(self) -> FloatArray:
        """Standard deviations of what images are off by, see `ImageOffsets`, shape (3,)."""
        return np.array([self.jitter_s, self.shift_px, self.shift_px])

    def with_offsets(self, sigmas: FloatArray) -> ImageNoise:
        """The same with other standard deviations of what images are off by, shape (3,)."""
        return self._replace(jitter_s=float(sigmas[0]), shift_px=float(sigmas[1]))


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
        # of the information in the prior of the own lens
        self.lens_root = patches(carry.camera, seen) / noise.lens_px
        window.moves = moves(window)

    def order(self) -> Order:
        """Places of the unknowns."""
        w, layout = self.window, self.carry.layout
        of_imu = layout.dynamic - layout.core
        return Order(len(w.frames), len(w.bias), layout.size - layout.core, of_imu, self.own, len(w.jumps))

    # ------------------------------------------------------------------ pixels
    def view(self, seen: Seen) -> View:
        """What the present values say of the observations."""
        y, x_imu, R, rates = self._rays(seen)
        with np.errstate(all="ignore"):
            uv, by_point, by_lens = project_jacobians(y, *self.window.lens)
        valid: BoolArray = np.asarray(np.isfinite(uv).all(axis=1))
        if not valid.all():
            uv[~valid], by_point[~valid], by_lens[~valid] = seen.uv[~valid], 0.0, 0.0
        return View(seen, uv, valid, y, x_imu, R, rates, by_point, by_lens)

    def _rays(self, seen: Seen) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """See `View`: y, x_imu, R and rates."""
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
            R = np.take(w.R @ so3.exp(rates * late[:, None]), seen.frame, axis=0)
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

    def pixel_errors(self, view: View) -> tuple[FloatArray, FloatArray]:
        """Whitened errors, shape (N, 2), 0 behind the camera; and Huber weights."""
        e = (view.uv - view.seen.uv) / self.noise.sigma_px
        size = np.sqrt(np.vecdot(e, e))
        return e, np.where(view.valid, huber_weight(size, HUBER), 0.0)

    def normal(self, view: View) -> Normal:
        """Normal equations with landmarks kept apart."""
        e, weight = self.pixel_errors(view)
        e *= np.sqrt(weight)[:, None]
        spread = self.noise.spread
        cost = self._robust_cost(e, weight) / spread**2
        J = self._derivatives(view, np.sqrt(weight) / (self.noise.sigma_px * spread))
        J[:, :, -1] = e / spread
        return self._assemble(view.seen, J, cost)

    def _derivatives(self, view: View, whitening: FloatArray) -> FloatArray:
        """How pixels move, times a factor each (N,), and a last column for errors, (N, 2, 9 + c + 1).

        The columns are the landmark (3), turn and place of the image (6), the c constants that move pixels.
        """
        w, cam, seen = self.window, self.window.camera, view.seen
        layout, where = self.carry.layout, self.carry.layout.camera
        marks = w.landmarks
        rho = marks.inverse[seen.landmark][:, None, None]
        J = np.empty((len(view.uv), 2, _CONSTANTS + layout.size - layout.dynamic + 1))
        Jy = view.by_point * whitening[:, None, None]
        JR = (Jy.reshape(-1, 3) @ cam.R_imu_cam.T).reshape(Jy.shape)  # by the point in the imu frame
        JW = np.matvec(view.R[:, None], JR)  # by the point in the world
        away = marks.anchor[seen.landmark] - w.p[seen.frame]
        J[:, :, :2] = JW @ np.take(tangents(marks.bearing), seen.landmark, axis=0)
        J[:, :, 2] = np.einsum("nij,nj->ni", JW, away) - JR @ cam.p_imu_cam
        J[:, :, 3:6] = so3.cross(JR, view.x_imu[:, None])
        J[:, :, 6:9] = -rho * JW
        by_shift = self._by_shift(view, JR)
        first = _CONSTANTS - layout.dynamic
        if where.position is not None and where.rotation is not None:
            J[:, :, _later(where.position, first)] = -rho * JR
            J[:, :, _later(where.rotation, first)] = so3.cross(Jy, view.y[:, None])
        if where.timeshift is not None and where.skew is not None:
            J[:, :, first + where.timeshift] = by_shift
            J[:, :, first + where.skew] = by_shift * self._since()[seen.frame, None]
        if where.intrinsics is not None and where.distortion is not None:
            lens = slice(where.intrinsics.start, where.distortion.stop)
            J[:, :, _later(lens, first)] = view.by_lens * whitening[:, None, None]
        if where.readout is not None:
            J[:, :, first + where.readout] = by_shift * seen.row[:, None]
        return J

    def _by_shift(self, view: View, JR: FloatArray) -> FloatArray:
        """How pixels move with the time of the exposure: the imu turns and moves on, shape (N, 2).

        Args:
            view: Present values.
            JR: Derivatives of the pixels by the point in the imu frame, shape (N, 2, 3).
        """
        seen = view.seen
        rho = self.window.landmarks.inverse[seen.landmark]
        forward = np.einsum("nj,nji->ni", self.window.v[seen.frame], view.R)  # speed in the imu frame
        moved = so3.cross(view.x_imu, view.rates) - rho[:, None] * forward
        return np.asarray(np.einsum("nij,nj->ni", JR, moved))

    def late_by_columns(self, view: View) -> float:
        """By how much at least the squared errors would fall if columns were read one after the other.

        At the optimum of all else this is the score test of one more parameter, with the information that
        it would have were all else known: a lower bound. [Rao 1948]
        """
        by_shift, e = self._whitened_by_shift(view)
        by_column = by_shift * read_share(view.seen.uv, self.window.camera.resolution, COLUMNS)[:, None]
        size = float((by_column**2).sum())
        return float((by_column * e).sum()) ** 2 / max(size, 1e-300) / self.noise.spread**2

    def _whitened_by_shift(self, view: View) -> tuple[FloatArray, FloatArray]:
        """How pixels move with the exposure's time, and their errors, both over their noise, (N, 2) each."""
        e, weight = self.pixel_errors(view)
        root = np.sqrt(weight)[:, None]
        JR = (view.by_point.reshape(-1, 3) @ self.window.camera.R_imu_cam.T).reshape(view.by_point.shape)
        return self._by_shift(view, JR) * root / self.noise.sigma_px, e * root

    def _robust_cost(self, e: FloatArray, weight: FloatArray) -> float:
        """Sum of the Huber losses (e is weighted already: weight * size^2)."""
        square = np.vecdot(e, e)
        inner = square
        outer = 2.0 * HUBER * np.sqrt(square / np.maximum(weight, 1e-12)) - HUBER**2
        return float(np.where(weight < 1.0, outer, inner).sum()) + 1e4 * float((weight == 0.0).sum())

    def _assemble(self, seen: Seen, J: FloatArray, cost: float) -> Normal:
        """The normal equations from derivatives and errors of the pixels (`_derivatives`) and their cost."""
        w, order = self.window, self.order()
        F, L = len(w.frames), len(seen.begin)
        H, g = np.zeros((order.size, order.size)), np.zeros(order.size)
        columns, camera = self.camera_columns(), order.camera
        k = len(columns)
        by_camera = np.zeros((F, 6, k))
        for frame, rows in zip(seen.frames_with, np.split(seen.by_frame, seen.frame_begin[1:]), strict=True):
            of_image = J[rows].reshape(2 * len(rows), -1)
            block = of_image[:, 3:9].T @ of_image
            pose = slice(order.frames[frame, 0], order.frames[frame, 5] + 1)
            H[pose, pose], g[pose], by_camera[frame] = block[:, 3:9], block[:, -1], block[:, columns]
        poses, sides = order.frames[:, :6].ravel(), by_camera.reshape(6 * F, k)
        H[poses[:, None], camera], H[camera[:, None], poses] = sides, sides.T
        flat = J.reshape(2 * len(J), -1)
        block = flat.T @ flat
        H[camera[:, None], camera], g[camera] = block[columns[:, None], columns], block[columns, -1]
        own = np.empty((L, 3, flat.shape[1]))
        for at, (low, high) in enumerate(pairwise([*(2 * seen.begin).tolist(), len(flat)])):
            np.matmul(flat[low:high, :3].T, flat[low:high], out=own[at])
        V, gl = own[:, :, :3].copy(), own[:, :, -1].copy()
        V[:, 2, 2] += _INVERSE_SIGMA**-2
        gl[:, 2] += w.landmarks.inverse * _INVERSE_SIGMA**-2
        cost += float((w.landmarks.inverse**2).sum()) * _INVERSE_SIGMA**-2
        W = np.zeros((L, 3, 6 * F + k))
        W[:, :, 6 * F :] = own[:, :, columns]
        by_frame = W[:, :, : 6 * F].reshape(L, 3, F, 6)  # the same memory
        by_frame[seen.landmark, :, seen.frame] = np.swapaxes(J[:, :, :3], 1, 2) @ J[:, :, 3:9]
        cost += add_links(w, self.noise.offsets, order, H, g)
        cost += self._add_prior(H, g, order) + self._add_own_lens(H, g, order)
        return Normal(H, g, V, W, gl, cost, J)

    def camera_columns(self) -> IntArray:
        """Columns of `_derivatives` for `Order.camera`: a window's own lens moves pixels as the lens does."""
        layout = self.carry.layout
        constants = _CONSTANTS + np.arange(layout.size - layout.dynamic)
        if not self.own or layout.camera.intrinsics is None:
            return constants
        lens = _CONSTANTS + layout.camera.intrinsics.start - layout.dynamic + np.arange(self.own)
        return np.concatenate([constants, lens])

    def suspected(self, view: View) -> ImageNoise:
        """The noise with one way more in which errors show images to be off beyond chance, or as it was.

        A late image of a turning rig looks like one that is shifted: the surer of the two goes first.
        """
        e, J = link_errors(self.window)
        sigmas, allowed = self.noise.offsets, None
        if sigmas.any():
            allowed = ImageOffsets(self.window, e, J, sigmas)
            e = allowed.left(e)
        by_pixels, found, surest = self._information_by_pixels(view), self.noise, LIKELY_SIGMAS
        for name, way in (("jitter_s", LATE), ("shift_px", SHIFTED)):
            if sigmas[way].any():
                continue
            alone = np.zeros(3)
            alone[way] = 1.0
            square, usual = ImageOffsets(self.window, e, J, alone).shown(by_pixels, allowed)
            if way == LATE:  # near rest no image shows a delay that would not put it behind the next one
                told = usual < np.median(np.diff([t_s for t_s, _ in self.window.frames])) ** 2
                square, usual = square[told], usual[told]
            if not len(square):
                continue
            sigma, sure = excess(square, usual), evidence(square, usual)
            if sigma > FLOORS[way][0] and sure > surest:
                found, surest = self.noise._replace(**{name: sigma}), sure
        return found

    def _information_by_pixels(self, view: View) -> FloatArray:
        """What the pixels of each image know of its offsets, shape (F, 3, 3)."""
        root = np.sqrt(self.pixel_errors(view)[1]) / self.noise.sigma_px
        ways = np.zeros((len(root), 2, 3))
        ways[:, :, 0] = self._whitened_by_shift(view)[0]
        ways[:, 0, 1] = ways[:, 1, 2] = root
        out = np.zeros((len(self.window.frames), 3, 3))
        np.add.at(out, view.seen.frame, np.swapaxes(ways, 1, 2) @ ways)
        return out / self.noise.spread**2

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


def inverse_roots(V: FloatArray, damping: float = 0.0) -> FloatArray:
    """Inverses of the lower Cholesky factors of the landmarks' blocks, shape (L, 3, 3)."""
    tiny = _NO_DEPTH * np.trace(V, axis1=1, axis2=2)[:, None, None]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(V * (1.0 + damping * np.eye(3)) + tiny * np.eye(3))))


def _later(where: slice, columns: int) -> slice:
    """A slice so many columns later."""
    return slice(where.start + columns, where.stop + columns)
