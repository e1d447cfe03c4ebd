"""Velocity, gravity, lever arm and structure from tracks and an IMU, linearly, once rotations are known.

With attitudes from the gyro, every camera centre is linear in z (`LinearMotion`): c_i = D_i + A_i z, and a
landmark X seen along d_i obeys (I - d d^T)(X - c_i) = 0. The metric scale comes from the accelerometer, so
that the system is inhomogeneous; gravity's size is known and its direction is relinearised in each round.
Squares are divided by the distances found in the round before, or near points would draw everything towards
the camera. [Martinelli, "Closed-form solution of visual-inertial structure from motion", 2014]

Turns about one axis only (a cart on a floor, a joint of an arm) show two of the mounting's three angles. The
third shows in how the rig moves: the accelerometer feels the direction in which the images see it go. With
mountings turned all the way round about the axis, the rays meet for one only (`mounting_about`). A lever arm
along the axis does not show at all; it is held.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.unobservable_directions import HELD_M
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.imu_model import products
from vical_daemon.estimation.init.linear_start import ARM, BIAS, GRAVITY, SPEED, LinearMotion, still_axes
from vical_daemon.estimation.measurements import FloatArray, Frames, ImuNoise
from vical_daemon.estimation.model.inertial_links import make_links
from vical_daemon.estimation.model.priors import ACCEL_BIAS_SIGMA_MPS2, WINDOW_START
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.robust import geman_mcclure_weight, sigma_by_median
from vical_daemon.estimation.smoother.window import FARTHEST_M, NEAREST_M, Landmarks, Window, rays_of
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve
from vical_daemon.estimation.temporal.track_orientations import MIN_FEATURES

ROUNDS = 8  # of reweighting by the depths found and by outliers
_RAY_SIGMA = 2e-3  # of a ray, rad: 1 px at a focal length of 500 px
_STEP_RAD = float(np.deg2rad(15.0))  # between the angles tried first
_APART_RAD = 3.0 * _STEP_RAD  # from here on it is another mounting
_CONTRAST = 3.0  # so much worse must mountings fit that are turned far from the best


class NoStartError(Exception):
    """Why the stretch does not do for a start, in words for a person."""


@dataclass(frozen=True)
class ArmPrior:
    """What is known of the lever arm before a start.

    Attributes:
        p_imu_cam: Lever arm, m, shape (3,).
        sigma_m: How far it may be off.
        held: Direction in the imu frame along which it stays as it is, unit, shape (3,); None: none.
    """

    p_imu_cam: FloatArray
    sigma_m: float = WINDOW_START.lever_arm_m
    held: FloatArray | None = None

    def information(self) -> FloatArray:
        """Of z = (v0, gravity, lever arm, accel bias), shape (12, 12)."""
        out = np.diag([0.0] * 6 + [self.sigma_m**-2] * 3 + [ACCEL_BIAS_SIGMA_MPS2**-2] * 3)
        if self.held is not None:
            out[ARM, ARM] += np.outer(self.held, self.held) / HELD_M**2
        return out


class _Linear(NamedTuple):
    z: FloatArray  # v0, change of gravity, lever arm, accel bias
    gravity: FloatArray
    misfit: float  # median angle by which rays miss their points, rad


class TrackStart:
    """A stretch of tracks whose rotations are known, ready to be solved for one mounting or many.

    Args:
        buffer: Inertial readings.
        frames: (stamp in the camera's clock in s, tracks), in order.
        camera: Time shift and lens must be roughly right.
        imu: Biases, and numbers of `imu_scale` where they are estimated, see `PreintegratedLinks`, shape (6,)
            or (22,).
        noise: Densities.
        gravity_mps2: Magnitude of gravity.

    Raises:
        NoStartError: Inertial data do not reach, or too few features can be followed.
    """

    def __init__(
        self,
        buffer: ImuBuffer,
        frames: Frames,
        camera: CameraState,
        imu: FloatArray,
        noise: ImuNoise,
        gravity_mps2: float,
    ) -> None:
        shift = camera.timeshift_s
        t_s = np.array([t for t, _ in frames]) + shift
        links = make_links(buffer, t_s, np.broadcast_to(imu, (len(frames) - 1, len(imu))), noise)
        if links is None:
            raise NoStartError("inertial data do not cover the images")
        self.camera, self._gravity_mps2 = camera, gravity_mps2
        self._R = products(links.dR[None])[0]
        self._motion = LinearMotion.along(self._R, links.dt, links.dR, links.dv, links.dp)
        zero = np.zeros((len(frames), 3))
        window = Window(
            *(camera, noise, list(frames), self._R, zero, zero, np.zeros((1, 6)), links, shift),
            Landmarks.none(),
            np.concatenate([[gravity_mps2], imu[6:]]),
        )
        window.bias[:, :3] = imu[:3]
        window.fit_knots()
        window.measure(buffer)
        self._seen = window.observe()
        if len(self._seen.begin) < MIN_FEATURES:
            raise NoStartError(
                f"only {len(self._seen.begin)} features can be followed:"
                " more texture or slower motion is needed"
            )
        self._rays, self._ok = rays_of(self._seen.uv, camera)
        window.landmarks = Landmarks.none()
        self._window = window

    def misfit(self, R_imu_cam: FloatArray, arm: ArmPrior, rounds: int) -> float:
        """How badly features' rays meet with this mounting: median angle, rad; infinite without solution."""
        found = self._solve(R_imu_cam, arm, rounds)
        return np.inf if found is None else found.misfit

    def window(self, arm: ArmPrior) -> Window:
        """Return the window that a bundle adjustment can start from: world z up, first image at the origin.

        The camera's lever arm is set to what was found.

        Args:
            arm: What is known of it before.

        Raises:
            NoStartError: Speed, scale or lever arm do not show.
        """
        found = self._solve(self.camera.R_imu_cam, arm, ROUNDS)
        if found is None:
            raise NoStartError(
                "speed and scale are not visible yet: move the rig back and forth while turning it"
            )
        z, gravity = found.z, found.gravity
        if not np.isfinite(z).all():
            raise NoStartError(
                "the lever arm is not visible yet: turn the rig about two axes while moving it"
            )
        window = self._window
        world = _upright(gravity / self._gravity_mps2)
        at = np.concatenate([z[SPEED], gravity, np.zeros(3), z[BIAS]])
        window.p = (self._motion.D + self._motion.A @ at) @ world.T
        window.R = world @ self._R
        # the velocity by differences of positions would be coarse: it is carried along the links
        links = window.links
        gained = links.dt[:, None] * gravity + np.matvec(self._R[:-1], links.dv)
        window.v = np.cumsum(np.concatenate([z[None, SPEED], gained]), axis=0) @ world.T
        self.camera.p_imu_cam = z[ARM].copy()
        window.bias[:, 3:] = z[BIAS]
        return window

    def _solve(self, R_imu_cam: FloatArray, arm: ArmPrior, rounds: int) -> _Linear | None:
        """Iteratively reweighted least squares; None without a solution."""
        seen, q, A = self._seen, self._motion.D, self._motion.A
        d = np.matvec(self._R[seen.frame] @ R_imu_cam, self._rays)
        P = np.eye(3) - d[:, :, None] * d[:, None, :]
        weight = self._ok / (2.0 * _RAY_SIGMA) ** 2
        prior, wanted = arm.information(), np.concatenate([np.zeros(6), arm.p_imu_cam, np.zeros(3)])
        # over seconds the speed changes little against g T: force is mostly gravity's opposite
        gravity = -q[-1] * (self._gravity_mps2 / float(np.linalg.norm(q[-1])))
        z, misfit = np.zeros(12), np.inf
        for _ in range(rounds):
            reduced = _tangent_map(gravity)
            q_now, A_now = q + A[:, :, GRAVITY] @ gravity, A @ reduced
            WP = P * weight[:, None, None]
            PA, Pq = WP @ A_now[seen.frame], np.matmul(WP, q_now[seen.frame][..., None])
            N = np.add.reduceat(WP, seen.begin) + 1e-6 * np.eye(3)
            B = np.add.reduceat(np.concatenate([PA, Pq], axis=2), seen.begin)
            inner = np.linalg.solve(N, B)  # X = inner_q + inner_A z
            At, Bt = np.swapaxes(A_now[seen.frame], 1, 2), np.swapaxes(B[..., :-1], 1, 2)
            H = (At @ PA).sum(axis=0) - (Bt @ inner[..., :-1]).sum(axis=0)
            g = (At @ Pq).sum(axis=0)[:, 0] - (Bt @ inner[..., -1:]).sum(axis=0)[:, 0]
            try:
                y = np.linalg.solve(H + reduced.T @ prior @ reduced, reduced.T @ prior @ wanted - g)
            except np.linalg.LinAlgError:
                return None
            z = reduced @ y
            X = inner[..., -1] + inner[..., :-1] @ y
            away = X[seen.landmark] - q_now[seen.frame] - A_now[seen.frame] @ y
            ahead = (away * d).sum(axis=1)
            depth = np.clip(ahead, NEAREST_M, FARTHEST_M)
            off = np.linalg.norm(np.matvec(P, away), axis=1) / depth
            misfit = sigma_by_median(off) + 1e-6
            weight = self._ok / (_RAY_SIGMA * depth) ** 2 * geman_mcclure_weight((off / (3.0 * misfit)) ** 2)
            gravity = gravity + z[GRAVITY]
            gravity *= self._gravity_mps2 / float(np.linalg.norm(gravity))
        return _Linear(z, gravity, misfit)


def _tangent_map(gravity: FloatArray) -> FloatArray:
    """From (v0, two tilts of gravity, lever arm, accel bias) to z, shape (12, 11)."""
    out = np.zeros((12, 11))
    out[:3, :3] = np.eye(3)
    basis = np.linalg.svd(gravity[None])[2][1:]
    out[3:6, 3:5] = basis.T * float(np.linalg.norm(gravity))
    out[6:9, 5:8] = out[9:, 8:] = np.eye(3)
    return out


def _upright(down: FloatArray) -> FloatArray:
    """Least rotation that turns `down` into -z."""
    target = np.array([0.0, 0.0, -1.0])
    axis = np.cross(down, target)
    cosine = float(down @ target)
    if cosine < -0.999999:
        return np.diag([1.0, -1.0, -1.0])
    hat = so3.hat(axis)
    return np.asarray(np.eye(3) + hat + hat @ hat / (1.0 + cosine))


def still_axis(t_s: FloatArray, gyro_rps: FloatArray, bias_rps: FloatArray) -> FloatArray | None:
    """Return the one axis of the imu that kept its direction, unit, shape (3,); None: none, or all did.

    Args:
        t_s: Instants, s, shape (m,).
        gyro_rps: Rates, rad/s, shape (m, 3).
        bias_rps: Of the gyro, rad/s, shape (3,).
    """
    curve = GyroCurve.integrate(t_s, gyro_rps, bias_rps)
    axes = still_axes(curve.R_ref_imu.mean(axis=0))
    return axes[0] if len(axes) == 1 else None


def mounting_about(start: TrackStart, axis: FloatArray, R_imu_cam: FloatArray, arm: ArmPrior) -> FloatArray:
    """Find the mounting among those turned about an axis.

    Args:
        start: The stretch.
        axis: Of the imu, unit, shape (3,).
        R_imu_cam: Mounting, right but for a turn about that axis, shape (3, 3).
        arm: What is known of the lever arm.

    Returns:
        The mounting, shape (3, 3), good to a degree or so.

    Raises:
        NoStartError: Others fit nearly as well.
    """
    angles = np.arange(-np.pi, np.pi - 1e-9, _STEP_RAD)

    def misfit(angle: float, rounds: int = ROUNDS) -> float:
        return start.misfit(so3.exp(angle * axis) @ R_imu_cam, arm, rounds)

    found = np.array([misfit(a, ROUNDS // 2) for a in angles])
    best = float(angles[np.argmin(found)])
    away = np.abs((angles - best + np.pi) % (2.0 * np.pi) - np.pi) > _APART_RAD
    if not found.min() * _CONTRAST < found[away].min():
        raise NoStartError(
            "the mounting about the one axis that the rig turns about does not show yet: speed up and brake,"
            " or turn the rig about a second axis"
        )
    for step in (_STEP_RAD / 2.0, _STEP_RAD / 4.0):
        best += _vertex(step, *(misfit(best + x) ** 2 for x in (-step, 0.0, step)))
    return np.asarray(so3.exp(best * axis) @ R_imu_cam)


def _vertex(step: float, low: float, middle: float, high: float) -> float:
    """Where a parabola through three points has its least value; at most a step away."""
    bend = low - 2.0 * middle + high
    if not np.isfinite(bend) or bend <= 0.0:
        return 0.0 if middle <= min(low, high) else step * float(np.sign(low - high))
    return step * float(np.clip(0.5 * (low - high) / bend, -1.0, 1.0))
