"""What one window of images hands on to the next: tilt, speed, biases, calibration, and how well known.

In coordinates that do not know where the world's origin and heading are, so that no information about them
can arise from nothing. [docs/math/target_free.md, "From window to window"]
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from vical_daemon.estimation.filter.unobservable_directions import HELD_M
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.so3 import tangents
from vical_daemon.estimation.init.camera_start import starting_camera
from vical_daemon.estimation.measurements import CameraPrior, FloatArray, ImuNoise, PointsFrame
from vical_daemon.estimation.model.inertial_links import PreintegratedLinks
from vical_daemon.estimation.model.priors import (
    ACCEL_BIAS_SIGMA_MPS2,
    GYRO_BIAS_SIGMA_RPS,
    SHIFT_WALK,
    SKEW_WALK,
    WINDOW_START,
)
from vical_daemon.estimation.model.retract import camera_difference
from vical_daemon.estimation.model.start_sigmas import start_sigmas
from vical_daemon.estimation.model.state import CameraState, Layout
from vical_daemon.estimation.smoother.window import KNOT_S, Landmarks, Window

TILT, SPEED, BIASES = slice(0, 2), slice(2, 5), slice(5, 11)  # rad, m/s, rad/s and m/s^2
CORE = BIASES.stop
"""Of the `Layout` of a window's errors. The time shift is that at the first image."""


@dataclass
class MarginalPrior:
    """What is known at the first image of a window before its own data.

    Errors: tilt (2), speed in the imu frame (3), biases (6), constants of camera and imu (`layout`), jumps.

    Attributes:
        R: Attitude there; only its tilt matters.
        speed: Velocity in the imu frame, m/s, shape (3,).
        bias: [gyro, accel], shape (6,).
        camera: Calibration.
        root: W with W^T W = information of the errors, shape (d, d).
        layout: Where the errors of one camera and the imu live, up to the jumps.
        t_cam_s: Stamp of that image, s.
        imu: Gravity and errors of the imu, see `Window`.
        jumps: Step of the time shift, s, and change of its drift, s/s, at each of the last few boundaries
            between windows, shape (2 m,); their errors follow all others. See `clock_changes`.
        jump_t_s: Stamps of these boundaries, s.
    """

    R: FloatArray
    speed: FloatArray
    bias: FloatArray
    camera: CameraState
    root: FloatArray
    layout: Layout
    t_cam_s: float
    imu: FloatArray
    jumps: FloatArray = field(default_factory=lambda: np.zeros(0))
    jump_t_s: tuple[float, ...] = ()

    @cached_property
    def S(self) -> FloatArray:
        """Square root of the covariance, shape (d, d); `root` never changes."""
        return np.asarray(np.linalg.inv(self.root), dtype=np.float64)

    def covariance(self) -> FloatArray:
        """Covariance of the errors, shape (d, d)."""
        S = self.S
        return np.asarray(S @ S.T)

    def sigma(self, place: int | None) -> float:
        """Standard deviation of one error, which must be estimated."""
        assert place is not None
        return float(np.linalg.norm(self.S[place]))

    def at(self, t_cam_s: float) -> MarginalPrior:
        """The same at another stamp of the camera's clock: its drift moves the time shift."""
        seconds = t_cam_s - self.t_cam_s
        camera = replace(self.camera, timeshift_s=self.camera.timeshift_s + self.camera.skew * seconds)
        known = slice(0, self.layout.size)
        root = self.root.copy()
        root[:, known] = root[:, known] @ later(self.layout, -seconds)
        return replace(self, camera=camera, root=root, t_cam_s=t_cam_s)


def later(layout: Layout, seconds: float) -> FloatArray:
    """Errors some seconds later, by those now, shape (n, n): the drift carries into the time shift."""
    G, where = np.eye(layout.size), layout.camera
    if where.timeshift is not None and where.skew is not None:
        G[where.timeshift, where.skew] = seconds
    return G


def calibration_difference(window: Window, carry: MarginalPrior) -> FloatArray:
    """Errors of the constants that lead from what was carried in to the window's, shape (n,)."""
    layout = carry.layout
    d = camera_difference(window.camera, carry.camera, layout.camera, layout.size)
    d[layout.inertial] = window.imu - carry.imu
    return d


def first_carry(window: Window, camera: CameraState, layout: Layout, sigmas: FloatArray) -> MarginalPrior:
    """Next to nothing known: wide sigmas.

    Args:
        window: Started window.
        camera: Centre of the prior.
        layout: Where the errors live.
        sigmas: Of the constants, shape (n,).
    """
    wide = sigmas.copy()
    wide[TILT], wide[SPEED] = WINDOW_START.attitude_rad, WINDOW_START.velocity_mps
    wide[BIASES] = np.repeat([GYRO_BIAS_SIGMA_RPS, ACCEL_BIAS_SIGMA_MPS2], 3)
    R, t_s = window.R[0], window.frames[0][0]
    root, speed = np.diag(1.0 / wide), R.T @ window.v[0]
    return MarginalPrior(R.copy(), speed, np.zeros(6), camera, root, layout, t_s, window.imu)


def held_along(carry: MarginalPrior, axis: FloatArray) -> MarginalPrior:
    """The same with the lever arm as good as known along an axis of the imu (unit, shape (3,))."""
    if carry.layout.camera.position is None:
        return carry
    row = np.zeros((1, len(carry.root)))
    row[0, carry.layout.camera.position] = axis / HELD_M
    stacked = np.vstack([carry.root, row])
    return replace(carry, root=np.linalg.qr(stacked)[1])


def carried_out(window: Window, covariance: FloatArray, carry: MarginalPrior) -> MarginalPrior:
    """Turn the marginal at a window's last image into coordinates without origin and heading.

    Args:
        window: Adjusted.
        covariance: Of [last image 9, last knot 6, constants, jumps].
        carry: What was carried into the window.
    """
    layout, span_s, camera = carry.layout, window.span_s, window.camera
    camera = replace(camera, timeshift_s=camera.timeshift_s + camera.skew * span_s)
    R, v = window.last_at(camera.timeshift_s)
    d = len(carry.root)
    J = np.zeros((d, d + 4))  # of the motion of an image, 9, five are carried on
    speed = R.T @ v
    J[TILT, :3] = tangents(R[2][None])[0].T
    J[SPEED, :3], J[SPEED, 6:9] = so3.hat(speed), R.T
    J[BIASES.start :, 9:] = np.eye(d - BIASES.start)
    J[CORE : layout.size, 15 : layout.size + 4] = later(layout, span_s)[CORE:, CORE:]
    root = root_of(J @ covariance @ J.T)
    bias, t_s = window.bias[-1].copy(), window.frames[-1][0]
    return MarginalPrior(R, speed, bias, camera, root, layout, t_s, window.imu, window.jumps, carry.jump_t_s)


def root_of(covariance: FloatArray) -> FloatArray:
    """W with W^T W = inverse of a covariance."""
    scale = np.sqrt(np.diag(covariance))  # pixels and microseconds
    root = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-14 * np.eye(len(scale)))
    return np.asarray(np.linalg.inv(root) / scale)


def initial_prior(
    window: Window,
    known: MarginalPrior | None,
    layout: Layout,
    held: FloatArray | None,
    imu_sigma: float,
    gravity_sigma_mps2: float,
    given: CameraPrior,
    reopened: Collection[int] = (),
) -> MarginalPrior:
    """Prior of a window that starts from nothing: wide, or with the calibration and biases known before.

    Args:
        window: As the start left it; takes the known time shift along.
        known: What was known, or None.
        layout: Where the errors live.
        held: Axis along which the lever arm is held, see `TargetFreeInitializer`.
        imu_sigma: Of the entries of the imu's matrices, where nothing is known.
        gravity_sigma_mps2: Of the magnitude of gravity.
        given: What is known about the camera without any data.
        reopened: Errors of which nothing is known any more; of mounting and time shift.
    """
    centre = prior_centre(window.camera, given)
    (name,) = layout.cameras
    sigmas = start_sigmas(
        layout, {name: centre}, WINDOW_START, imu_sigma=imu_sigma, gravity_sigma_mps2=gravity_sigma_mps2
    )
    wide = first_carry(window, centre, layout, sigmas)
    if known is None:
        return wide if held is None else held_along(wide, held)
    unseen_s = max(wide.t_cam_s - known.t_cam_s, KNOT_S)
    known = known.at(wide.t_cam_s)
    covariance, before = np.diag(np.diag(wide.root) ** -2.0), known.covariance()
    before[BIASES, BIASES] += _walked(window.noise, unseen_s)
    kept = [k for k in range(BIASES.start, layout.size) if k not in reopened]
    covariance[np.ix_(kept, kept)] = before[np.ix_(kept, kept)]
    camera, found, where = known.camera, window.camera, layout.camera
    if where.timeshift in reopened:
        camera = replace(camera, timeshift_s=found.timeshift_s)
    else:
        window.camera = replace(found, timeshift_s=camera.timeshift_s)
    if where.position is not None and where.position.start in reopened:
        camera = replace(camera, R_imu_cam=found.R_imu_cam, p_imu_cam=found.p_imu_cam)
    return replace(wide, root=root_of(covariance), bias=known.bias.copy(), camera=camera, imu=known.imu)


def prior_centre(found: CameraState, given: CameraPrior) -> CameraState:
    """Centre of the prior of a first window: what is known without its data.

    The start has used the same data. On a flat scene it is off by more than its sigmas: lenses of 842 px
    instead of 567, lever arms of 1 m. So it says where to begin. Only what nothing else says is taken from
    it: mounting and time shift, and the focal length where none is given.
    """
    before = starting_camera(given)
    lens = before.intrinsics
    if given.intrinsics is None:
        lens = np.concatenate([found.intrinsics[:2], lens[2:]])
    return replace(found, p_imu_cam=before.p_imu_cam, intrinsics=lens, distortion=before.distortion)


def of_another_recording(known: MarginalPrior, window: Window, stepped_s: float) -> MarginalPrior:
    """What was known, for the first window of another recording: its biases are those that its start finds.

    Args:
        known: At the end of the recording before.
        window: As a start from nothing makes it.
        stepped_s: By how much the imu's stamps were moved there, s: they may begin as far off here.

    The time between the recordings is not known, and taken as none.
    """
    P = known.covariance()
    P[BIASES], P[:, BIASES] = 0.0, 0.0
    P[BIASES, BIASES] = np.diag(np.repeat([GYRO_BIAS_SIGMA_RPS, ACCEL_BIAS_SIGMA_MPS2], 3) ** 2)
    shift = known.layout.camera.timeshift
    if shift is not None:
        P[shift, shift] += stepped_s**2
    return replace(known, bias=window.bias[0].copy(), root=root_of(P), t_cam_s=window.frames[0][0])


def with_process_noise(
    carry: MarginalPrior, noise: ImuNoise, span_s: float, *, drifting: bool
) -> MarginalPrior:
    """Let biases and delay walk a little before the next window."""
    P, where = carry.covariance(), carry.layout.camera
    P[BIASES, BIASES] += _walked(noise, KNOT_S)
    for place, walk in ((where.timeshift, SHIFT_WALK), (where.skew, SKEW_WALK if drifting else 0.0)):
        if place is not None:
            P[place, place] += walk**2 * span_s
    return replace(carry, root=root_of(P))


def _walked(noise: ImuNoise, seconds: float) -> FloatArray:
    """Covariance that biases gain in some seconds, shape (6, 6)."""
    return np.diag(np.repeat([noise.gyro_walk, noise.accel_walk], 3) ** 2 * seconds)


def next_window(window: Window, carry: MarginalPrior) -> Window:
    """A window that begins at the last image of this one; that image has been used."""
    t, last = window.frames[-1]
    none = PointsFrame(last.camera, last.t_cam_ns, last.ids[:0], last.uv_px[:0])
    return Window(
        carry.camera,
        window.noise,
        [(t, none)],
        carry.R[None],
        np.zeros((1, 3)),
        (carry.R @ carry.speed)[None],
        carry.bias[None].copy(),
        PreintegratedLinks.none(6 + len(window.imu) - 1),
        carry.camera.timeshift_s,
        Landmarks.none(),
        window.imu,
        jumps=carry.jumps.copy(),
    )
