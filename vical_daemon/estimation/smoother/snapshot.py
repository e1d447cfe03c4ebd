"""Turns what is carried from window to window into the plain numbers of an estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.gyro_frame import turn
from vical_daemon.estimation.filter.unobservable_directions import held_covariance
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.estimation.model.imu_scale import matrices
from vical_daemon.estimation.model.retract import moved_camera
from vical_daemon.estimation.model.snapshot import camera_snapshot, imu_snapshot
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.result import CameraEstimate, ImuEstimate
from vical_daemon.estimation.selection.clock_drift import evidence, probability
from vical_daemon.estimation.smoother.marginal_prior import (
    ARM,
    CAMERA,
    DRIFT,
    IMU,
    INERTIAL,
    LENS,
    READOUT,
    SHIFT,
    TURN,
    MarginalPrior,
)

_GYRO = slice(IMU.start, IMU.start + 9)


class Doubts(NamedTuple):
    """How what is carried is to be reported.

    Attributes:
        factor: Measured variance over the stated one; multiplies the reported covariance.
        drifting: The camera's clock is known to run apart from the imu's.
        stated: Probabilities, each with the errors that are zero then: what of the imu is as specified.
        gyro_frame: The camera is reported in the frame in which the gyro's matrix is symmetric.
        rolling: The shutter is known to be a rolling one: its readout is reported.
    """

    factor: float = 1.0
    drifting: bool = False
    stated: tuple[tuple[float, IntArray], ...] = ((1.0, np.zeros(0, np.intp)),)
    gyro_frame: bool = False
    rolling: bool = True


def camera_estimate(
    carry: MarginalPrior, doubts: Doubts, sigma_px: float, rms_px: float, held: FloatArray | None = None
) -> CameraEstimate:
    """The camera as it is known.

    Args:
        carry: What is known.
        doubts: See there.
        sigma_px: Pixel noise.
        rms_px: RMS of the residuals.
        held: Axis of the imu along which the lever arm is not known, unit, shape (3,); None: there is none.
    """
    camera, covariance = _averaged(carry, doubts)
    if held is not None:
        covariance[:3, :3] += held_covariance(np.outer(held, held))
    reported = [*range(SHIFT + 1), *range(LENS.start, len(covariance))]
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))  # rounding, where nothing is in doubt
    return camera_snapshot(
        camera,
        pose=covariance[:6, :6],
        timeshift_sigma_s=sigma[SHIFT],
        lens=np.concatenate([camera.intrinsics, camera.distortion]),
        lens_sigma=sigma[LENS],
        readout_sigma_s=sigma[READOUT],
        rms_px=rms_px,
        sigma_px=sigma_px,
        joint=covariance[np.ix_(reported, reported)],
        rolling=doubts.rolling,
    )


def _averaged(carry: MarginalPrior, doubts: Doubts) -> tuple[CameraState, FloatArray]:
    """Camera and covariance (n, n) over the models of imu and clock; see `model_selection`."""
    camera, numbers, P = _over_imu(carry, doubts)
    if doubts.gyro_frame:
        camera, P = _in_gyro_frame(camera, numbers, P)
    if doubts.drifting or not carry.active[DRIFT]:
        return camera, P
    p = probability(evidence(camera.skew, float(P[DRIFT, DRIFT])))
    sigma = float(np.sqrt(P[DRIFT, DRIFT]))
    k, z = P[:, DRIFT] / sigma, camera.skew / sigma
    return moved_camera(camera, CAMERA, -(1.0 - p) * z * k), P - (1.0 - p) * (1.0 - p * z * z) * np.outer(
        k, k
    )


def _over_imu(carry: MarginalPrior, doubts: Doubts) -> tuple[CameraState, FloatArray, FloatArray]:
    """Camera, errors of the imu, and covariance over the hypotheses about these."""
    P = carry.calibration() * doubts.factor
    numbers, mean, mixed = np.zeros(len(P)), np.zeros(len(P)), np.zeros_like(P)
    numbers[INERTIAL] = carry.imu
    for p, at in doubts.stated:
        gain = np.linalg.solve(P[np.ix_(at, at)], P[at]).T
        d = -gain @ numbers[at]
        mean += p * d
        mixed += p * (P - gain @ P[at] + np.outer(d, d))
    return moved_camera(carry.camera, CAMERA, mean), carry.imu + mean[INERTIAL], mixed - np.outer(mean, mean)


def _in_gyro_frame(camera: CameraState, numbers: FloatArray, P: FloatArray) -> tuple[CameraState, FloatArray]:
    """Mounting and lever arm in the frame in which M_g is symmetric, to first order in its entries."""
    J = np.eye(len(P))
    by_entries = turn(np.eye(9).reshape(3, 3, 9))
    J[TURN, _GYRO] = -camera.R_imu_cam.T @ by_entries
    J[ARM, _GYRO] = so3.hat(camera.p_imu_cam) @ by_entries
    back = so3.exp(-turn(numbers[:9].reshape(3, 3)))
    camera = replace(camera, R_imu_cam=back @ camera.R_imu_cam, p_imu_cam=back @ camera.p_imu_cam)
    return camera, J @ P @ J.T


def imu_estimate(carry: MarginalPrior, *, matrices_asked: bool) -> ImuEstimate:
    """Biases and their sigmas; where asked for, the matrices."""
    sigma = np.sqrt(np.diag(carry.covariance())[5:11])
    return imu_snapshot(carry.bias, sigma, matrices(carry.imu) if matrices_asked else ())
