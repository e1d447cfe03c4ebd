"""Turns what is carried from window to window into the plain numbers of an estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.gyro_frame import turn
from vical_daemon.estimation.filter.unobservable_directions import held_covariance
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import RADTAN
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.model.imu_scale import matrices
from vical_daemon.estimation.model.retract import moved_camera
from vical_daemon.estimation.model.snapshot import camera_snapshot, imu_snapshot
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.result import CameraEstimate, ImuEstimate
from vical_daemon.estimation.selection.model_mixture import Block, Weights, mixture
from vical_daemon.estimation.smoother.clock_changes import Clock, over_clocks
from vical_daemon.estimation.smoother.marginal_prior import (
    ARM,
    CAMERA,
    IMU,
    INERTIAL,
    LENS,
    READOUT,
    SHIFT,
    TURN,
    MarginalPrior,
    calibration_root,
)

_GYRO = slice(IMU.start, IMU.start + 9)


class ReportedModels(NamedTuple):
    """How what is carried is to be reported.

    Attributes:
        factor: Measured variance over the stated one; multiplies the reported covariance.
        clocks: Hypotheses about the clocks; none: the drift is not estimated.
        every: What may be as specified: the imu, a fixed lens.
        weights: Probability of each hypothesis about these.
        gyro_frame: The camera is reported in the frame in which the gyro's matrix is symmetric.
        rolling: The shutter is known to be a rolling one: its readout is reported.
        lens: The lens, where it is fixed.
        term: The last coefficient of the lens is one more than its model has, and is not reported.
    """

    factor: float
    clocks: tuple[Clock, ...]
    every: Mapping[str, Block]
    weights: Weights
    gyro_frame: bool = False
    rolling: bool = True
    lens: FixedLens | None = None
    term: bool = False


def camera_estimate(
    carry: MarginalPrior,
    models: ReportedModels,
    sigma_px: float,
    rms_px: float,
    held: FloatArray | None = None,
) -> CameraEstimate:
    """The camera as it is known.

    Args:
        carry: What is known.
        models: See there.
        sigma_px: Pixel noise.
        rms_px: RMS of the residuals.
        held: Axis of the imu along which the lever arm is not known, unit, shape (3,); None: there is none.
    """
    camera, covariance = _averaged(carry, models)
    if held is not None:
        covariance[:3, :3] += held_covariance(np.outer(held, held))
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))  # rounding, where nothing is in doubt
    lens, lens_sigma = np.concatenate([camera.intrinsics, camera.distortion]), sigma[LENS]
    if models.lens is not None:
        lens, lens_sigma = models.lens.values, models.lens.reported(lens_sigma)
    if models.term:
        lens, lens_sigma = lens[:-1], lens_sigma[:-1]
        camera = replace(camera, distortion=lens[4:], distortion_model=RADTAN)
    reported = [*range(SHIFT + 1), *range(LENS.start, LENS.start + len(lens))]
    return camera_snapshot(
        camera,
        pose=covariance[:6, :6],
        timeshift_sigma_s=sigma[SHIFT],
        lens=lens,
        lens_sigma=lens_sigma,
        readout_sigma_s=sigma[READOUT],
        rms_px=rms_px,
        sigma_px=sigma_px,
        joint=covariance[np.ix_(reported, reported)],
        rolling=models.rolling,
    )


def _averaged(carry: MarginalPrior, models: ReportedModels) -> tuple[CameraState, FloatArray]:
    """Camera and covariance (n, n) over the models of imu, fixed lens and clock; see `model_mixture`."""
    d, S = _over_clocks(carry, models)
    every = {name: replace(b, values=b.values + d[b.where]) for name, b in models.every.items()}
    step, S = mixture(S, every, models.weights, models.factor)
    d = d + step
    camera, numbers = moved_camera(carry.camera, CAMERA, d), carry.imu + d[INERTIAL]
    if models.gyro_frame:
        camera, S = _in_gyro_frame(camera, numbers, S)
    return camera, models.factor * (S @ S.T)


def _over_clocks(carry: MarginalPrior, models: ReportedModels) -> tuple[FloatArray, FloatArray]:
    """What the mean moves by, shape (n,), and root of the covariance over its factor, over the clocks."""
    if not models.clocks:
        return np.zeros(len(carry.active)), calibration_root(carry)
    d, P = over_clocks(carry, models.clocks, models.factor)
    scale = np.where(carry.active, np.sqrt(np.maximum(np.diag(P), 1e-300)), 1.0)  # pixels and microseconds
    values, vectors = np.linalg.eigh(P / np.outer(scale, scale) / models.factor)
    return d, scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def _in_gyro_frame(camera: CameraState, numbers: FloatArray, S: FloatArray) -> tuple[CameraState, FloatArray]:
    """Mounting and lever arm in the frame in which M_g is symmetric, to first order in its entries."""
    J = np.eye(len(S))
    by_entries = turn(np.eye(9).reshape(3, 3, 9))
    J[TURN, _GYRO] = -camera.R_imu_cam.T @ by_entries
    J[ARM, _GYRO] = so3.hat(camera.p_imu_cam) @ by_entries
    back = so3.exp(-turn(numbers[:9].reshape(3, 3)))
    camera = replace(camera, R_imu_cam=back @ camera.R_imu_cam, p_imu_cam=back @ camera.p_imu_cam)
    return camera, J @ S


def imu_estimate(carry: MarginalPrior, *, matrices_asked: bool) -> ImuEstimate:
    """Biases and their sigmas; where asked for, the matrices."""
    sigma = np.sqrt(np.diag(carry.covariance())[5:11])
    return imu_snapshot(carry.bias, sigma, matrices(carry.imu) if matrices_asked else ())
