"""Registration of camera orientations with a rotation curve by closest points (ICP in the rotation group).

The model (t_imu = t_cam + shift): `R_world_cam(t) = R_world_ref R_ref_imu(t + shift) R_imu_cam`. Each camera
orientation is paired with the nearest point of the curve within a window that shrinks; pairs give the shift,
then the rotations, in turns. `rotation_start` finds where to begin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.robust import geman_mcclure_weight, median
from vical_daemon.estimation.temporal.rotation_curves import RotationCurve
from vical_daemon.estimation.temporal.rotation_start import Start, angles_between

_WORLD_RAD = 0.2  # orientations that miss the usual one by more count less and less


@dataclass(frozen=True)
class Registration:
    """Rotations and shift that carry the curve onto the camera's orientations.

    Attributes:
        timeshift_s: t_imu - t_cam, s.
        R_imu_cam: Mounting, shape (3, 3).
        R_world_ref: Orientation of the curve's reference frame in the camera's world, shape (3, 3).
        bias_rps: Residual gyro bias relative to the one the curve was integrated with, shape (3,).
        weight: Robust weight of each orientation, 0 to 1, shape (n,).
        iterations: Rounds of pairing and registering.
    """

    timeshift_s: float
    R_imu_cam: FloatArray
    R_world_ref: FloatArray
    bias_rps: FloatArray
    weight: FloatArray
    iterations: int


def mean_rotation(q: FloatArray) -> FloatArray:
    """Return the robust mean of quaternions (n, 4): largest eigenvector, reweighted; shape (4,)."""
    weight = np.ones(len(q))
    mean: FloatArray = q[0]
    for _ in range(10):
        mean = np.asarray(np.linalg.eigh((q * weight[:, None]).T @ q)[1][:, -1], dtype=np.float64)
        weight = geman_mcclure_weight((angles_between(q, mean) / _WORLD_RAD) ** 2)
    return mean


def closest_points(
    curve: RotationCurve, q_target: FloatArray, times_s: FloatArray, window_s: float
) -> tuple[FloatArray, FloatArray]:
    """Find for each orientation the instant within +- window at which the curve is nearest to it.

    A scan over the window, then two Newton steps: on a short piece with rate w the nearest point lies
    `w . r / |w|^2` further, r the rotation vector from the curve to the target.

    Returns:
        Instants (n,), and rates there in the imu frame (n, 3).
    """
    low, high = curve.span_s
    scan = np.clip(times_s[:, None] + np.linspace(-window_s, window_s, 13), low, high)
    nearest = np.argmin(angles_between(curve.quaternion(scan), q_target[:, None]), axis=1)
    tau = scan[np.arange(len(scan)), nearest]
    rate = np.zeros((len(tau), 3))
    for _ in range(2):
        R, rate, _ = curve.at(tau)
        r = so3.turn_between(so3.quat_from_matrix(R), q_target)
        step = np.vecdot(rate, r) / (np.vecdot(rate, rate) + 1e-6)
        tau = np.clip(tau + np.clip(step, -window_s / 6, window_s / 6), low, high)
    return np.clip(tau, times_s - window_s, times_s + window_s), rate


def closest_point_registration(
    curve: RotationCurve, t_cam_s: FloatArray, q_world_cam: FloatArray, start: Start
) -> Registration:
    """Iterate pairing and registering until the shift rests (1 us) and the rotations do (1e-6 rad).

    Closest points pull the shift towards whatever makes residuals small, so its last digits are biased: the
    final polish of `td_icp` drops the pairs. This phase is for its width: it walks in from 100 ms off.
    """
    shift, bias = start.timeshift_s, start.bias_rps
    q_imu_cam = so3.quat_from_matrix(start.R_imu_cam)
    q_ref_cam = so3.quat_multiply(curve.quaternion(t_cam_s + shift), q_imu_cam)
    q_world_ref = mean_rotation(so3.quat_multiply(q_world_cam, so3.quat_conjugate(q_ref_cam)))
    window = 0.08
    weight = np.ones(len(t_cam_s))
    rounds, done = 0, False
    while rounds < 15 and not done:
        rounds += 1
        q_target = so3.quat_multiply(
            so3.quat_conjugate(q_world_ref), so3.quat_multiply(q_world_cam, so3.quat_conjugate(q_imu_cam))
        )
        # the curve was integrated with another bias: carry the targets along with its drift
        drift = curve.at(np.clip(t_cam_s + shift, *curve.span_s))[2] @ bias
        q_target = so3.quat_multiply(so3.quat_from_rotvec(drift), q_target)
        tau, rate = closest_points(curve, q_target, t_cam_s + shift, window)
        step = _shift_step(tau - t_cam_s - shift, rate, weight, window)
        shift += step
        turn, d_world, bias, weight = _register(curve, t_cam_s + shift, q_world_cam, q_world_ref, q_imu_cam)
        q_imu_cam = so3.quat_multiply(q_imu_cam, so3.quat_from_rotvec(turn))
        q_world_ref = so3.quat_multiply(so3.quat_from_rotvec(d_world), q_world_ref)
        window = max(0.5 * window, 0.005)
        done = abs(step) < 1e-6 and float(np.abs(turn).max()) < 1e-6
    return Registration(
        shift, so3.matrix_from_quat(q_imu_cam), so3.matrix_from_quat(q_world_ref), bias, weight, rounds
    )


def _shift_step(offset: FloatArray, rate: FloatArray, weight: FloatArray, window: float) -> float:
    """Robust mean of the pairs' time offsets, weighted with the squared rate; edge pairs do not count."""
    w = weight * np.vecdot(rate, rate) * (np.abs(offset) < 0.98 * window)
    if w.sum() <= 0.0:
        return 0.0
    step = 0.0
    for _ in range(4):
        spread = np.sqrt(np.sum(w * (offset - step) ** 2) / w.sum()) + 1e-9
        wr = w * geman_mcclure_weight(((offset - step) / (2.0 * spread)) ** 2)
        step = float(np.sum(wr * offset) / np.sum(wr))
    return step


def _register(
    curve: RotationCurve,
    tau: FloatArray,
    q_world_cam: FloatArray,
    q_world_ref: FloatArray,
    q_imu_cam: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """One robust Gauss-Newton step over mounting, reference and bias for fixed pairs.

    Returns:
        Local step of R_imu_cam (3,), world step of R_world_ref (3,), bias (3,), weights (n,).
    """
    R, _, integral = curve.at(tau)
    R_world_ref = so3.matrix_from_quat(q_world_ref)
    predicted = so3.quat_multiply(q_world_ref, so3.quat_multiply(so3.quat_from_matrix(R), q_imu_cam))
    e = so3.rotvec_from_quat(so3.quat_multiply(q_world_cam, so3.quat_conjugate(predicted)))
    J = np.empty((len(e), 3, 9))
    J[:, :, :3] = so3.matrix_from_quat(predicted)
    J[:, :, 3:6] = np.eye(3)
    J[:, :, 6:] = -R_world_ref @ integral
    x: FloatArray = np.zeros(9)
    weight = np.ones(len(e))
    for _ in range(4):
        r = np.linalg.norm(e - J @ x, axis=1)
        scale = max(3.0 * median(r), 1e-6)
        weight = geman_mcclure_weight((r / scale) ** 2)
        JtW = (J * weight[:, None, None]).reshape(-1, 9).T
        A = JtW @ J.reshape(-1, 9)
        A[np.arange(9), np.arange(9)] += 1e-9 * np.trace(A) / 9 + 1e-12
        x = np.asarray(np.linalg.solve(A, JtW @ e.ravel()), np.float64)
    return x[:3], x[3:6], x[6:], weight
