"""The least-squares problem of temporal calibration, linearised: all orientation sensors, one rotation curve.

Model for sensor s: `R_world_s(t) = R_world_ref R_ref_imu(t + shift_s) R_imu_s Exp(noise)`. Parameters per
sensor: mounting (3, local), shift; then the gyro's symmetric matrix (6). States: drift (3), bias (3) and, for
several sensors, the slow error of each (3): the first one's starts at zero, the others' at anything, which
stands for the orientation of their worlds. A single sensor's slow error joins the drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.model.priors import ENTRY_SIGMA, GYRO_BIAS_SIGMA_RPS
from vical_daemon.estimation.temporal.drift_smoother import DriftProblem
from vical_daemon.estimation.temporal.rotation_curves import RotationCurve
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions

_MIN_INTERVAL_S = 2e-5  # two stamps may coincide; the drift between them must not become infinitely certain
LEAST_NOISE_RAD = 1e-5  # two seconds of arc: below every stamp's rounding at a motion of 60 deg/s
_SLOW_START = -1.5  # where the search for log(slow error after a second / noise of one orientation) starts
_TURN_UNKNOWN = 1.0 / 5.0**2  # information about a world that may be turned by any angle
# The gyro's scale errors and the symmetric part of its misalignment: xx yy zz, xy yz xz. The antisymmetric
# part is a rotation of the gyro's axes and cannot be distinguished from the mounting.
_SYMMETRIC = np.zeros((9, 6))
_SYMMETRIC[[0, 4, 8], [0, 1, 2]] = 1.0
_SYMMETRIC[[1, 3, 5, 7, 2, 6], [3, 3, 4, 4, 5, 5]] = 1.0


@dataclass(frozen=True)
class OrientationSensor:
    """A stream of orientations with its present registration.

    Attributes:
        t_s: Stamps in the sensor's clock, s, shape (n,).
        R_world_sensor: Orientations, shape (n, 3, 3).
        covariance: Of the local (right) rotation error, up to a common scale, rad^2, shape (n, 3, 3).
        timeshift_s: t_imu - t_sensor, s.
        R_imu_sensor: Mounting, shape (3, 3).
        R_world_ref: The curve's reference frame in the sensor's world, shape (3, 3).
        used: Orientations that passed the gate, shape (n,).
        log_scale: Log of the factor by which the noise is larger than `covariance` says (in sigma).
        log_slow: Log of the slow error that a second brings over the noise of one orientation. Slow errors
            come from lens and board models which are not exact, and change with the view.
    """

    t_s: FloatArray
    R_world_sensor: FloatArray
    covariance: FloatArray
    timeshift_s: float
    R_imu_sensor: FloatArray
    R_world_ref: FloatArray
    used: BoolArray
    log_scale: float = 0.0
    log_slow: float = _SLOW_START

    @property
    def stated_rad(self) -> float:
        """Noise of one orientation as `covariance` says it, rms per axis, rad."""
        return float(np.sqrt(np.trace(self.covariance.mean(axis=0)) / 3.0))

    @property
    def noise_rad(self) -> float:
        """Noise of one orientation as it was measured, rms per axis, rad."""
        return float(np.exp(self.log_scale)) * self.stated_rad

    @property
    def least_log_scale(self) -> float:
        """The least that `log_scale` may become.

        A stream integrated from a gyro has next to no noise, and eliminating the drift from still smaller
        residuals costs all digits.
        """
        return float(np.log(LEAST_NOISE_RAD / self.stated_rad))


@dataclass(frozen=True)
class Linear:
    """The linearised problem in order of time, before scaling of the noises.

    Attributes:
        problem: With unscaled weights; its steps' noise is set by `orientation_fit.scaled`.
        sensor: Which sensor each row belongs to, shape (n,).
        order: Sorted row to row of the sensors strung together, shape (n,).
        used: Rows that take part, shape (n,).
        drift: Variance per axis of the gyro's drift over each step, rad^2, shape (n - 1,).
        walk: Variance per axis of the bias over each step, (rad/s)^2, shape (n - 1,).
        middle_s: Time of each row from the middle of the data, s, shape (n,).
        slow_sizes: Variances of each sensor's slow error over each step per scale, shape (S, n - 1, 3).
        slow_axes: The axes to which they belong, shape (S, n - 1, 3, 3).
    """

    problem: DriftProblem
    sensor: npt.NDArray[np.intp]
    order: npt.NDArray[np.intp]
    used: BoolArray
    drift: FloatArray
    walk: FloatArray
    middle_s: FloatArray
    slow_sizes: FloatArray
    slow_axes: FloatArray


def linearise(
    curve: RotationCurve, sensors: tuple[OrientationSensor, ...], bias: FloatArray, options: TdIcpOptions
) -> Linear:
    """Residuals and derivatives in the curve's reference frame, sorted by time."""
    S = len(sensors)
    p = 4 * S + 6
    low, high = curve.span_s
    raw = np.concatenate([s.t_s + s.timeshift_s for s in sensors])
    order = np.argsort(np.clip(raw, low, high), kind="stable")
    index = np.repeat(np.arange(S), [len(s.t_s) for s in sensors])[order]
    raw = raw[order]
    tau = np.clip(raw, low, high)
    R, rate, integral = curve.at(tau)
    turn = (R @ rate[..., None])[..., 0]
    R_ref_sensor = R @ np.stack([s.R_imu_sensor for s in sensors])[index]
    measured = np.concatenate([s.R_world_ref.T @ s.R_world_sensor for s in sensors])[order]
    J = _derivatives(R_ref_sensor, turn, index, p)
    J[:, :, 4 * S :] = curve.matrix_effect(tau) @ _SYMMETRIC
    used = np.concatenate([s.used for s in sensors])[order] & (raw >= low) & (raw <= high)
    own = np.concatenate([s.covariance for s in sensors])[order]
    C = R_ref_sensor @ own @ np.swapaxes(R_ref_sensor, 1, 2)
    dt = np.maximum(np.diff(tau), _MIN_INTERVAL_S)
    H, F, first_mean, first_information = _states(S, index, integral, bias)
    problem = DriftProblem(
        so3.log(measured @ np.swapaxes(R_ref_sensor, 1, 2)),
        J,
        H,
        np.asarray(np.linalg.inv(C) * used[:, None, None], dtype=np.float64),
        F,
        np.zeros_like(F),
        0.0,
        first_mean,
        first_information,
        _prior(S, p),
    )
    drift = np.maximum(
        np.diff(curve.variance(tau, options.gyro_density)), 1e-4 * options.gyro_density**2 * _MIN_INTERVAL_S
    )
    slow_sizes, slow_axes = np.empty((S, len(dt), 3)), np.empty((S, len(dt), 3, 3))
    for i, s in enumerate(sensors):  # its covariance, turned with the sensor
        values, vectors = np.linalg.eigh(s.covariance.mean(axis=0))
        slow_sizes[i], slow_axes[i] = dt[:, None] * values, R[:-1] @ (s.R_imu_sensor @ vectors)
    middle = tau - 0.5 * (tau[0] + tau[-1])
    walk = options.gyro_walk**2 * dt
    return Linear(problem, index, order, used, drift, walk, middle, slow_sizes, slow_axes)


def _derivatives(
    R_ref_sensor: FloatArray, turn: FloatArray, index: npt.NDArray[np.intp], p: int
) -> FloatArray:
    """Of the residuals by mountings and shifts, shape (n, 3, p); the gyro's matrix is left zero."""
    J = np.zeros((len(turn), 3, p))
    rows = np.arange(len(turn))
    for i in range(3):
        J[rows, :, 4 * index + i] = R_ref_sensor[:, :, i]
    J[rows, :, 4 * index + 3] = turn
    return J


def _states(
    S: int, index: npt.NDArray[np.intp], integral: FloatArray, bias: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """How the states enter the residuals, how they move, and what is known of the first one."""
    d = 6 if S == 1 else 6 + 3 * S
    n = len(index)
    H = np.zeros((n, 3, d))
    H[:, :, :3] = np.eye(3)
    if S > 1:
        for i in range(3):
            H[np.arange(n), i, 6 + 3 * index + i] = 1.0
    F = np.tile(np.eye(d), (n - 1, 1, 1))
    F[:, :3, 3:6] = -np.diff(integral, axis=0)
    information = np.zeros(d)
    information[3:6] = 1.0 / GYRO_BIAS_SIGMA_RPS**2
    information[6:9] = 1e10  # of several sensors, the first one's slow error starts at zero
    information[9:] = _TURN_UNKNOWN
    mean = np.zeros(d)
    mean[3:6] = -bias
    return H, F, mean, information


def _prior(S: int, p: int) -> FloatArray:
    """Next to no information: 2 rad on rotations, 0.5 s on shifts; keeps lost ones finite. The matrix."""
    diagonal = np.full(p, 1.0 / 2.0**2)
    diagonal[3 : 4 * S : 4] = 1.0 / 0.5**2
    diagonal[4 * S :] = ENTRY_SIGMA**-2
    return np.diag(diagonal)
