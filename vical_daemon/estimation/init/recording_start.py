"""The motion at the beginning of another recording of the same rig: biases and gravity are new, too.

As `motion_restart`, with gravity and the biases among the unknowns: the board may stand elsewhere, the imu
was switched off. With the calibration known, all are linear in poses of the target over a second or two
(`LinearMotion`); the gyro's bias is by what its turns differ from those seen.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.linear_start import (
    BIAS,
    GRAVITY,
    SPEED,
    LinearMotion,
    LinearStart,
    linear_start,
)
from vical_daemon.estimation.init.motion_restart import MotionRestart, sigmas_of_motion
from vical_daemon.estimation.measurements import FloatArray, PointsFrame
from vical_daemon.estimation.model.priors import ACCEL_BIAS_SIGMA_MPS2, GRAVITY_SIGMA_RAD, GYRO_BIAS_SIGMA_RPS
from vical_daemon.estimation.model.state import BiasStart, MotionStart, State
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve

_LEAST_IMAGES = 8  # with poses: fewer do not show which of them are wrong
_LEAST_S = 1.5
"""Of motion: 2 mm of position noise in 15 images are then 10 mm/s^2 of gravity, a milliradian."""
_MOST_S = 4.0  # of images without enough poses among them; what is older says nothing of the motion now
_POSITION_SIGMA_M = 2e-3  # of a pose of the target, m: weighs the prior of the bias


class RecordingStart(MotionRestart):
    """Collects the first images of another recording until its motion can start from them."""

    def take(self, frame: PointsFrame, t_cam_s: float, state: State, buffer: ImuBuffer) -> None:
        """See `MotionRestart.take`; images of long ago are left out."""
        super().take(frame, t_cam_s, state, buffer)
        self.drop_before(t_cam_s - _MOST_S)

    def motion(self, f: CalibrationFilter, buffer: ImuBuffer) -> MotionStart | None:
        """See `MotionRestart.motion`; the time between the recordings is not known, and taken as none."""
        state = f.state
        poses = self._enough_poses(state, _LEAST_IMAGES, _LEAST_S)
        if poses is None:
            return None
        gyro_bias = _gyro_bias(buffer, poses.t_s, poses.R)
        if gyro_bias is None:
            return None
        found = LinearMotion.between(buffer, poses.t_s, poses.R, gyro_bias)
        if found is None:
            return None
        start = _linear(found, poses.p, state)
        wide = sigmas_of_motion(poses.first, f, float(found.T[-1]))
        biases = BiasStart(
            gyro_bias,
            start.accel_bias,
            start.gravity,
            GYRO_BIAS_SIGMA_RPS,
            ACCEL_BIAS_SIGMA_MPS2,
            GRAVITY_SIGMA_RAD,
        )
        return MotionStart(
            float(poses.t_s[0]), poses.R[0], start.p_world_cam, start.v_world_imu, wide, 0.0, biases
        )

    def gyro_bias(self, state: State, buffer: ImuBuffer) -> FloatArray:
        """Bias of the gyro by the images so far, rad/s, shape (3,); the state's where they say nothing."""
        poses = self._enough_poses(state, 3, 0.0)
        found = None if poses is None else _gyro_bias(buffer, poses.t_s, poses.R)
        return state.gyro_bias if found is None else found


def _gyro_bias(buffer: ImuBuffer, t_s: FloatArray, R_world_imu: FloatArray) -> FloatArray | None:
    """Bias of the gyro by the attitudes seen, rad/s, shape (3,); None where readings are missing.

    log(dR_gyro' dR_seen) = -integral of dR(t)' b dt, with dR from t to the end of each interval.
    """
    if t_s[0] < buffer.oldest_s or t_s[-1] > buffer.newest_s:
        return None
    curve = GyroCurve.integrate(buffer.rows[:, 0], buffer.rows[:, 1:4], np.zeros(3))
    R, _, integral = curve.at(t_s)
    back, turned = np.swapaxes(R[1:], 1, 2) @ R[0], R[0].T @ (integral[1:] - integral[0])
    misses = so3.log(back @ R_world_imu[0].T @ R_world_imu[1:])
    rows = np.concatenate([back @ turned, back], axis=2)  # the error of the first attitude is unknown, too
    x, *_ = np.linalg.lstsq(rows.reshape(-1, 6), -misses.ravel(), rcond=None)
    return np.asarray(x[:3])


def _linear(motion: LinearMotion, p_world_imu: FloatArray, state: State) -> LinearStart:
    """Motion at the first pose, gravity of its known length, and the accelerometer's bias."""
    sigma, known = np.full(len(p_world_imu), _POSITION_SIGMA_M), np.zeros(12)
    known[BIAS] = state.accel_bias
    found = linear_start(motion, p_world_imu, sigma, unknown=[SPEED, GRAVITY, BIAS], known=known)
    known[GRAVITY] = found.gravity * (np.linalg.norm(state.gravity) / np.linalg.norm(found.gravity))
    return linear_start(motion, p_world_imu, sigma, unknown=[SPEED, BIAS], known=known)
