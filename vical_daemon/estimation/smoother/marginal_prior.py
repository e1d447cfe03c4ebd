"""What one window of images hands on to the next: tilt, speed, biases, calibration, and how well known.

In coordinates that do not know where the world's origin and heading are, so that no information about them
can arise from nothing. [docs/math/target_free.md, "From window to window"]
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.so3 import tangents
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.model.priors import ACCEL_BIAS_SIGMA_MPS2, GYRO_BIAS_SIGMA_RPS, WINDOW_START
from vical_daemon.estimation.model.retract import camera_difference
from vical_daemon.estimation.model.state import CameraSlices, CameraState
from vical_daemon.estimation.smoother.window import Window

# Places of the calibration's errors. The time shift is that at the first image, and drifts from there on. The
# lens is the last, because its length depends on its model.
ARM, TURN, SHIFT, DRIFT, READOUT = slice(0, 3), slice(3, 6), 6, 7, 8
IMU, LAG, LENS = slice(9, 24), slice(24, 25), slice(25, None)
CAMERA = CameraSlices(ARM, TURN, SHIFT, DRIFT, slice(25, 29), slice(29, None), READOUT)
INERTIAL = slice(IMU.start, LAG.stop)
HELD_M = 1e-4
BIASES = slice(5, 11)  # of a carry
CALIBRATION = 11  # first calibration error of a carry; before it tilt 2, speed 3, biases 6


def length(camera: CameraState) -> int:
    """How many errors the calibration of a camera and the imu has."""
    return LENS.start + len(camera.intrinsics) + len(camera.distortion)


@dataclass(slots=True)
class MarginalPrior:
    """What is known at the first image of a window before its own data; n: errors of the calibration.

    Errors: tilt (2), speed in the imu frame (3), biases (6), calibration (the active ones of `length`).

    Attributes:
        R: Attitude there; only its tilt matters.
        speed: Velocity in the imu frame, m/s, shape (3,).
        bias: [gyro, accel], shape (6,).
        camera: Calibration.
        root: W with W^T W = information of the errors, shape (d, d).
        active: Which of the calibration errors are estimated, shape (n,).
        t_cam_s: Stamp of that image, s.
        imu: Errors of the imu, see `Window`.
        jumps: Step of the time shift, s, and change of its drift, s/s, at each of the last few boundaries
            between windows, shape (2 m,); their errors follow those of the calibration. See `clock_changes`.
        jump_t_s: Stamps of these boundaries, s.
    """

    R: FloatArray
    speed: FloatArray
    bias: FloatArray
    camera: CameraState
    root: FloatArray
    active: BoolArray
    t_cam_s: float
    imu: FloatArray
    jumps: FloatArray = field(default_factory=lambda: np.zeros(0))
    jump_t_s: tuple[float, ...] = ()

    @property
    def _calibration(self) -> slice:
        return slice(CALIBRATION, len(self.root) - len(self.jumps))

    def covariance(self) -> FloatArray:
        """Covariance of the errors, shape (d, d)."""
        inverse = np.linalg.inv(self.root)
        return np.asarray(inverse @ inverse.T)

    def at(self, t_cam_s: float) -> MarginalPrior:
        """The same at another stamp of the camera's clock: its drift moves the time shift."""
        seconds = t_cam_s - self.t_cam_s
        camera = replace(self.camera, timeshift_s=self.camera.timeshift_s + self.camera.skew * seconds)
        root = self.root.copy()
        root[:, self._calibration] = root[:, self._calibration] @ later(self.active, -seconds)
        return replace(self, camera=camera, root=root, t_cam_s=t_cam_s)

    def calibration(self) -> FloatArray:
        """Covariance of the calibration's errors, zero where not estimated, shape (n, n)."""
        full = np.zeros((len(self.active),) * 2)
        at = np.flatnonzero(self.active)
        full[np.ix_(at, at)] = self.covariance()[self._calibration, self._calibration]
        return full


def calibration_root(carry: MarginalPrior) -> FloatArray:
    """Square root of the covariance of the calibration's errors, zero where not estimated, shape (n, d)."""
    S = np.zeros((len(carry.active), len(carry.root)))
    S[carry.active] = np.linalg.inv(carry.root)[CALIBRATION : len(carry.root) - len(carry.jumps)]
    return S


def later(active: BoolArray, seconds: float) -> FloatArray:
    """Active calibration errors some seconds later, by those now: the drift carries into the time shift."""
    G = np.eye(len(active))
    G[SHIFT, DRIFT] = seconds
    at = np.flatnonzero(active)
    return np.asarray(G[np.ix_(at, at)])


def calibration_difference(window: Window, carry: MarginalPrior) -> FloatArray:
    """Errors of the calibration that lead from what was carried in to the window's, shape (n,)."""
    d = camera_difference(window.camera, carry.camera, CAMERA, length(carry.camera))
    if len(window.imu):
        d[INERTIAL] = window.imu - carry.imu
    return d


def first_carry(window: Window, camera: CameraState, active: BoolArray, sigmas: FloatArray) -> MarginalPrior:
    """Next to nothing known: wide sigmas.

    Args:
        window: Started window.
        camera: Centre of the prior.
        active: Which of the calibration errors are estimated, shape (n,).
        sigmas: Of the calibration errors, shape (n,).
    """
    biases = [GYRO_BIAS_SIGMA_RPS] * 3 + [ACCEL_BIAS_SIGMA_MPS2] * 3
    motion = [WINDOW_START.attitude_rad] * 2 + [WINDOW_START.velocity_mps] * 3
    wide = np.concatenate([motion, biases, sigmas[np.flatnonzero(active)]])
    R, t_s = window.R[0], window.frames[0][0]
    root, speed = np.diag(1.0 / wide), R.T @ window.v[0]
    return MarginalPrior(R.copy(), speed, np.zeros(6), camera, root, active, t_s, window.imu)


def held_along(carry: MarginalPrior, axis: FloatArray) -> MarginalPrior:
    """The same with the lever arm as good as known along an axis of the imu (unit, shape (3,))."""
    if not carry.active[:3].all():
        return carry
    row = np.zeros((1, len(carry.root)))
    row[0, CALIBRATION : CALIBRATION + 3] = axis / HELD_M
    stacked = np.vstack([carry.root, row])
    return replace(carry, root=np.linalg.qr(stacked)[1])


def carried_out(window: Window, covariance: FloatArray, carry: MarginalPrior) -> MarginalPrior:
    """Turn the marginal at a window's last image into coordinates without origin and heading.

    Args:
        window: Adjusted.
        covariance: Of [last image 9, last knot 6, active calibration errors, jumps].
        carry: What was carried into the window.
    """
    active = carry.active
    k, m = int(np.count_nonzero(active)), len(carry.jumps)
    span_s, camera = window.span_s, window.camera
    camera = replace(camera, timeshift_s=camera.timeshift_s + camera.skew * span_s)
    R, v = window.last_at(camera.timeshift_s)
    J = np.zeros((CALIBRATION + k + m, 15 + k + m))
    speed = R.T @ v
    J[:2, :3] = tangents(R[2][None])[0].T
    J[2:5, :3], J[2:5, 6:9] = so3.hat(speed), R.T
    J[5:11, 9:15] = np.eye(6)
    J[11 : 11 + k, 15 : 15 + k] = later(active, span_s)
    J[11 + k :, 15 + k :] = np.eye(m)
    root = root_of(J @ covariance @ J.T)
    bias, t_s = window.bias[-1].copy(), window.frames[-1][0]
    return MarginalPrior(R, speed, bias, camera, root, active, t_s, window.imu, window.jumps, carry.jump_t_s)


def root_of(covariance: FloatArray) -> FloatArray:
    """W with W^T W = inverse of a covariance."""
    scale = np.sqrt(np.diag(covariance))  # pixels and microseconds
    root = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-14 * np.eye(len(scale)))
    return np.asarray(np.linalg.inv(root) / scale)
