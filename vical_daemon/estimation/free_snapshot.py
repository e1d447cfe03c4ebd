"""Turns what is carried from window to window into the plain numbers of an estimate."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation import so3
from vical_daemon.estimation.clock_drift import evidence, probability
from vical_daemon.estimation.free_carry import DRIFT, LENS, READOUT, SHIFT, Carry, moved
from vical_daemon.estimation.imu_scale import matrices
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.result import CameraEstimate, ImuEstimate, PoseEstimate
from vical_daemon.estimation.state import CameraState
from vical_daemon.estimation.unshown_axes import held_covariance


def drift_evidence(carry: Carry, factor: float) -> float:
    """Return how much more likely a drift of the clocks is than none (Bayes factor); 0: not estimated.

    Args:
        carry: What is known.
        factor: Measured variance over the stated one.
    """
    if not carry.active[DRIFT]:
        return 0.0
    return evidence(carry.camera.skew, factor * float(carry.calibration()[DRIFT, DRIFT]))


def camera_estimate(
    carry: Carry,
    factor: float,
    drifting: bool,
    sigma_px: float,
    rms_px: float,
    held: FloatArray | None = None,
) -> CameraEstimate:
    """The camera as it is known.

    Args:
        carry: What is known.
        factor: Measured variance over the stated one; multiplies what is told.
        drifting: Its clock is known to run apart from the imu's.
        sigma_px: Pixel noise.
        rms_px: RMS of the residuals.
        held: Axis of the imu along which the lever arm is not known, unit, shape (3,); None: there is none.
    """
    camera, covariance = _told(carry, factor, drifting)
    if held is not None:
        covariance[:3, :3] += held_covariance(np.outer(held, held))
    sigma = np.sqrt(np.diag(covariance))
    q = so3.quat_from_matrix(camera.R_imu_cam)
    return CameraEstimate(
        PoseEstimate(camera.p_imu_cam.tolist(), q.tolist(), covariance[:6, :6].tolist()),
        float(camera.timeshift_s),
        float(sigma[SHIFT]),
        camera.intrinsics.tolist(),
        sigma[LENS][:4].tolist(),
        camera.distortion_model,
        camera.distortion.tolist(),
        sigma[LENS][4:].tolist(),
        rms_px,
        sigma_px,
        [],
        float(camera.readout_s),
        float(sigma[READOUT]),
    )


def _told(carry: Carry, factor: float, drifting: bool) -> tuple[CameraState, FloatArray]:
    """Camera and covariance (FULL, FULL) over both hypotheses about its clock; see `clock_drift`."""
    camera, P = carry.camera, carry.calibration() * factor
    if drifting or not carry.active[DRIFT]:
        return camera, P
    p = probability(drift_evidence(carry, factor))
    sigma = float(np.sqrt(P[DRIFT, DRIFT]))
    k, z = P[:, DRIFT] / sigma, camera.skew / sigma
    return moved(camera, -(1.0 - p) * z * k), P - (1.0 - p) * (1.0 - p * z * z) * np.outer(k, k)


def imu_estimate(carry: Carry) -> ImuEstimate:
    """Biases and their sigmas; where estimated, the matrices."""
    sigma = np.sqrt(np.diag(carry.covariance())[5:11])
    told = [m.tolist() for m in matrices(carry.imu)] if len(carry.imu) else [[], []]
    bias = carry.bias
    return ImuEstimate(bias[:3].tolist(), bias[3:].tolist(), sigma[:3].tolist(), sigma[3:].tolist(), *told)
