"""Turns the filter's state into the plain numbers of an estimate."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.snapshot import camera_snapshot, imu_snapshot
from vical_daemon.estimation.model.state import ACCEL_BIAS, GYRO_BIAS, CameraSlices
from vical_daemon.estimation.noise.lens_limit import limit as lens_limit
from vical_daemon.estimation.result import CameraEstimate, ImuEstimate


def camera_estimate(f: CalibrationFilter, name: str, reprojection_rms_px: float) -> CameraEstimate:
    """One camera as it is known now.

    Sigmas are the filter's times the square root of the measured correlation factor: errors that last for
    several images count less than the filter thinks (see `consistency`); those of the lens at least as
    much as stretches of the data disagree about it (see `lens_agreement`), and as detectors allow
    (`lens_limit`).
    """
    camera, where, held = f.state.cameras[name], f.layout.cameras[name], f.layout.held.get(name)
    lens = np.concatenate([camera.intrinsics, camera.distortion]) if held is None else held.values
    spread = float(np.sqrt(f.consistency[name].factor))
    sigma = spread * f.sigmas()
    lens_sigma = _lens_sigmas(f, name, spread)
    return camera_snapshot(
        camera,
        pose=spread**2 * pose_covariance(f, where),
        timeshift_sigma_s=_timeshift_sigma(f, sigma, where),
        lens=lens,
        lens_sigma=lens_sigma,
        readout_sigma_s=float(sigma[where.readout]) if where.readout is not None else 0.0,
        rms_px=reprojection_rms_px,
        sigma_px=f.corner_noise[name].sigma_px,
        joint=_calibration_covariance(f, name, spread, lens_sigma),
        jitter_s=f.shared[name].jitter_found_s if name in f.shared else 0.0,
    )


def _calibration_covariance(
    f: CalibrationFilter, name: str, spread: float, lens_sigma: FloatArray
) -> FloatArray:
    """Of [lever arm, rotation, time shift, lens], with the filter's correlations, zeros where not estimated.

    A lens that is free has the sigmas that are published: what those exceed the filter's is error of the lens
    model, which is not correlated with the pose. A lens that is held has the filter's own: what the pose
    would be for another lens follows from its correlation with the pose.
    """
    where, free = f.layout.cameras[name], f.layout.lens_free(name)
    places = (where.position, where.rotation, where.timeshift, where.intrinsics, where.distortion)
    first = np.cumsum([0, 3, 3, 1, 4])
    rows: list[int] = []
    at: list[int] = []
    for place, begin in zip(places, first, strict=True):
        if place is not None:
            found = [place] if isinstance(place, int) else list(range(place.start, place.stop))
            rows += found
            at += range(begin, begin + len(found))
    out = np.zeros((7 + len(lens_sigma),) * 2)
    if rows:
        out[np.ix_(at, at)] = spread**2 * f.covariance(rows)
    if free:
        lens = slice(7, None)
        out[lens, lens] += np.diag(np.maximum(lens_sigma**2 - np.diag(out)[lens], 0.0))
    if f.unobservable is not None:
        out[:6, :6] += f.unobservable.covariance()
        out[6, 6] += f.unobservable.timeshift_sigma_s**2
    return out


def _lens_sigmas(f: CalibrationFilter, name: str, spread: float) -> FloatArray:
    """Of fx fy cx cy and the distortion, shape (n,); where held: as far as images contradict the values."""
    camera, where = f.state.cameras[name], f.layout.cameras[name]
    if where.intrinsics is None or where.distortion is None:
        return np.zeros(4 + len(camera.distortion))
    raw = f.sigmas()
    if name in f.layout.held:
        return f.layout.held[name].reported(spread * raw[f.layout.lens(name)])
    agreement = f.agreement[name]
    filtered = np.maximum(np.sqrt(agreement.factors), spread) * np.concatenate(
        [raw[where.intrinsics], raw[where.distortion]]
    )
    return np.asarray(np.sqrt(filtered**2 + agreement.moved**2 + lens_limit(camera) ** 2))


def _timeshift_sigma(f: CalibrationFilter, sigma: FloatArray, where: CameraSlices) -> float:
    if where.timeshift is None:
        return 0.0
    hidden_s = 0.0 if f.unobservable is None else f.unobservable.timeshift_sigma_s
    return float(np.hypot(sigma[where.timeshift], hidden_s))


def imu_estimate(f: CalibrationFilter, *, matrices: bool) -> ImuEstimate:
    """Biases and, where asked for, the matrices."""
    sigma, state = f.sigmas(), f.state
    return imu_snapshot(
        np.concatenate([state.gyro_bias, state.accel_bias]),
        np.concatenate([sigma[GYRO_BIAS], sigma[ACCEL_BIAS]]),
        (state.gyro_matrix, state.accel_matrix) if matrices else (),
    )


def pose_covariance(f: CalibrationFilter, where: CameraSlices) -> FloatArray:
    """What is not known of T_imu_cam, order [px py pz rx ry rz], shape (6, 6).

    The filter's covariance and what it holds; zeros where all is fixed.
    """
    if where.position is None or where.rotation is None:
        return np.zeros((6, 6))
    rows = [
        *range(where.position.start, where.position.stop),
        *range(where.rotation.start, where.rotation.stop),
    ]
    covariance = f.covariance(rows)
    if f.unobservable is not None:
        covariance += f.unobservable.covariance()
    return covariance
