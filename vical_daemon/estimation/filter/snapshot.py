"""Turns the filter's state into the plain numbers of an estimate."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.next_term import onto_model, reported_camera
from vical_daemon.estimation.model.snapshot import camera_snapshot, imu_snapshot, joint_covariance
from vical_daemon.estimation.model.state import ACCEL_BIAS, GYRO_BIAS, CameraState
from vical_daemon.estimation.noise.lens_limit import limit as lens_limit
from vical_daemon.estimation.result import CameraEstimate, ImuEstimate


def camera_estimate(f: CalibrationFilter, name: str, reprojection_rms_px: float) -> CameraEstimate:
    """One camera as it is known now.

    Sigmas are the filter's times the square root of the measured correlation factor: errors that last for
    several images count less than the filter thinks (see `consistency`); those of the lens at least as
    much as stretches of the data disagree about it (see `lens_agreement`), and as detectors allow
    (`lens_limit`).
    """
    where, held = f.layout.cameras[name], f.layout.held.get(name)
    onto = _onto(f, name)
    camera = reported_camera(f.state.cameras[name], onto)
    lens = np.concatenate([camera.intrinsics, camera.distortion])
    lens = lens if held is None else held.values[: len(lens)]
    spread = float(np.sqrt(f.consistency[name].factor))
    lens_sigma = _lens_sigmas(f, name, spread, onto, camera)
    return camera_snapshot(
        camera,
        joint=_calibration_covariance(f, name, spread, lens_sigma, onto),
        lens=lens,
        lens_sigma=lens_sigma,
        readout_sigma_s=0.0 if where.readout is None else spread * float(f.sigmas()[where.readout]),
        rms_px=reprojection_rms_px,
        sigma_px=f.corner_noise[name].sigma_px,
        jitter_s=f.shared[name].jitter_found_s if name in f.shared else 0.0,
        model_fits=f.consistency[name].fits,
    )


def _onto(f: CalibrationFilter, name: str) -> FloatArray:
    """See `onto_model`."""
    agreement = f.agreement.get(name)
    return onto_model(f.state.cameras[name], np.zeros((1, 1)) if agreement is None else agreement.seen)


def _calibration_covariance(
    f: CalibrationFilter, name: str, spread: float, lens_sigma: FloatArray, onto: FloatArray
) -> FloatArray:
    """See `joint_covariance`; with what the filter holds because the motion does not show it.

    A lens that is free has the sigmas that are published: what those exceed the filter's is error of the lens
    model, which is not correlated with the pose. A lens that is held has the filter's own: what the pose
    would be for another lens follows from its correlation with the pose.
    """
    out = spread**2 * joint_covariance(f.S, f.layout.cameras[name], onto)
    if f.layout.lens_free(name):
        lens = slice(7, None)
        out[lens, lens] += np.diag(np.maximum(lens_sigma**2 - np.diag(out)[lens], 0.0))
    if f.unobservable is not None:
        out[:6, :6] += f.unobservable.covariance()
        out[6, 6] += f.unobservable.timeshift_sigma_s**2
    if name in f.shared:  # the time shift of one instant, not only its mean
        out[6, 6] += f.shared[name].wander_s ** 2
    return out


def _lens_sigmas(
    f: CalibrationFilter, name: str, spread: float, onto: FloatArray, camera: CameraState
) -> FloatArray:
    """Of fx fy cx cy and the distortion, shape (n,); where held: as far as images contradict the values."""
    where = f.layout.cameras[name]
    if where.intrinsics is None or where.distortion is None:
        return np.zeros(4 + len(camera.distortion))
    raw = np.linalg.norm(onto @ f.S[f.layout.lens(name)], axis=1)
    if name in f.layout.held:
        return f.layout.held[name].reported(spread * raw)
    agreement, limit = f.agreement[name], lens_limit(camera)
    filtered = np.maximum(np.sqrt(agreement.factors), spread) * raw
    return np.asarray(np.sqrt(filtered**2 + agreement.moved**2 + limit**2))


def imu_estimate(f: CalibrationFilter, asked: Collection[str], axes_m: FloatArray | None) -> ImuEstimate:
    """Biases; where asked for, the matrices; positions of the accelerometer's axes, where they are given."""
    spread = math.sqrt(max(camera.factor for camera in f.consistency.values()))
    sigma, state = spread * f.sigmas(), f.state
    return imu_snapshot(
        np.concatenate([state.gyro_bias, state.accel_bias]),
        np.concatenate([sigma[GYRO_BIAS], sigma[ACCEL_BIAS]]),
        (state.gyro_matrix, state.accel_matrix) if "imu_intrinsics" in asked else (),
        axes_m,
    )
