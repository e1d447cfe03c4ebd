"""What one window of images hands on to the next: tilt, speed, biases, calibration, and how well known.

In coordinates that do not know where the world's origin and heading are, so that no information about them
can arise from nothing. [docs/math/target_free.md, "From window to window"]
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from vical_daemon.estimation.filter.unobservable_directions import HELD_M
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.so3 import tangents
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import ACCEL_BIAS_SIGMA_MPS2, GYRO_BIAS_SIGMA_RPS, WINDOW_START
from vical_daemon.estimation.model.retract import camera_difference
from vical_daemon.estimation.model.state import CameraState, Layout
from vical_daemon.estimation.smoother.window import Window

TILT, SPEED, BIASES = slice(0, 2), slice(2, 5), slice(5, 11)  # rad, m/s, rad/s and m/s^2
CORE = 11
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
