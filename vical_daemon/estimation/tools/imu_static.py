"""Calibration of an IMU by itself: held still in many positions, turned in between.

At rest the corrected specific force has the length of gravity; that gives the accelerometer. Between
two rests the corrected gyro must turn gravity's direction from the one to the other; that gives the gyro
(the multi-position method of Tedaldi, Pretto and Menegatti, ICRA 2014, in our own formulation).

Model, as in `imu_model`: f = M_a (f_m - b_a) with lower-triangular M_a, omega = M_g (omega_m - b_g) with
full M_g. The triangle says what the imu axes are: x is the axis of the x accelerometer, y lies in the plane
of the x and y accelerometers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_model import products
from vical_daemon.estimation.measurements import STANDARD_GRAVITY_MPS2, FloatArray
from vical_daemon.estimation.model.state import LOWER
from vical_daemon.estimation.temporal.orientation_problem import LEAST_NOISE_RAD

POSITIONS_MIN = 9  # unknowns of the accelerometer
MOTIONS_MIN = 6  # twelve directions for nine unknowns of the gyro
REST_FACTOR = 3.0  # a window is at rest when it is at most this much livelier than the quietest ones


class PoorMotionError(ValueError):
    """The recording cannot give the answer; the message says which motion is missing."""


@dataclass(frozen=True, slots=True)
class Rest:
    """One interval at rest.

    Attributes:
        start: First sample, stop: one past the last.
        stop: One past the last sample.
        gyro_rps: Mean measured rate, rad/s, shape (3,).
        accel_mps2: Mean measured specific force, m/s^2, shape (3,).
        gyro_sigma: Standard error of that mean rate, rad/s, shape (3,).
        accel_sigma: Standard error of that mean force, m/s^2, shape (3,).
    """

    start: int
    stop: int
    gyro_rps: FloatArray
    accel_mps2: FloatArray
    gyro_sigma: FloatArray
    accel_sigma: FloatArray


@dataclass(frozen=True, slots=True)
class SensorCalibration:
    """Correction of one triad: corrected = matrix @ (measured - bias).

    Attributes:
        matrix: Scale and misalignment, shape (3, 3).
        matrix_sigma: Standard deviations, 0 where fixed by the gauge, shape (3, 3).
        bias: In the unit of the sensor, shape (3,).
        bias_sigma: Standard deviations, shape (3,).
        residual_rms: RMS of the whitened residuals: 1 when the errors are as large as the noise says.
    """

    matrix: FloatArray
    matrix_sigma: FloatArray
    bias: FloatArray
    bias_sigma: FloatArray
    residual_rms: float


@dataclass(frozen=True, slots=True)
class ImuCalibration:
    """Both triads and what they were found from; `gyro` keeps M_g = I where the turns did not suffice."""

    accel: SensorCalibration
    gyro: SensorCalibration
    gyro_matrix_found: bool
    positions: int
    motions: int


def find_rests(
    gyro_rps: FloatArray, accel_mps2: FloatArray, rate_hz: float, min_rest_s: float = 1.0
) -> list[Rest]:
    """Find the intervals in which the imu lay still.

    Args:
        gyro_rps: Evenly sampled rates, rad/s, shape (n, 3).
        accel_mps2: Specific forces, m/s^2, shape (n, 3).
        rate_hz: Sampling rate.
        min_rest_s: Shorter rests are ignored.

    Returns:
        Rests in order. Both ends are trimmed by 0.1 s, where the hand still moves.
    """
    width = max(int(0.2 * rate_hz), 8)
    lively = _liveliness(gyro_rps, width) | _liveliness(accel_mps2, width)
    margin, shortest = int(0.1 * rate_hz), int(min_rest_s * rate_hz)
    edges = np.flatnonzero(np.diff(np.concatenate(([True], lively, [True])).astype(np.int8)))
    rests = []
    for first, last in edges.reshape(-1, 2) * width:
        start, stop = int(first) + margin, min(int(last), len(gyro_rps)) - margin
        if stop - start >= shortest:
            rests.append(_rest(gyro_rps, accel_mps2, start, stop))
    return rests


def _liveliness(signal: FloatArray, width: int) -> npt.NDArray[np.bool_]:
    """Tell for each window of `width` samples whether it is livelier than the quietest tenth."""
    windows = len(signal) // width
    blocks = signal[: windows * width].reshape(windows, width, 3)
    spread = np.sqrt(blocks.var(axis=1).sum(axis=1))
    return np.asarray(spread > REST_FACTOR * max(float(np.percentile(spread, 10.0)), 1e-9))


def _rest(gyro: FloatArray, accel: FloatArray, start: int, stop: int) -> Rest:
    return Rest(
        start, stop,
        gyro[start:stop].mean(axis=0), accel[start:stop].mean(axis=0),
        _standard_error(gyro[start:stop]), _standard_error(accel[start:stop]),
    )  # fmt: skip


def _standard_error(samples: FloatArray) -> FloatArray:
    """Standard error of the mean from ten block means: right for correlated (filtered) samples too."""
    blocks = min(10, len(samples) // 4)
    means = samples[: len(samples) // blocks * blocks].reshape(blocks, -1, 3).mean(axis=1)
    return np.asarray(means.std(axis=0, ddof=1) / np.sqrt(blocks), dtype=np.float64)


def calibrate_imu(
    gyro_rps: FloatArray, accel_mps2: FloatArray, rate_hz: float, gravity_mps2: float = STANDARD_GRAVITY_MPS2,
    min_rest_s: float = 1.0, gravity_sigma_mps2: float = 0.0,
) -> ImuCalibration:  # fmt: skip
    """Calibrate both triads from one recording of rests and turns.

    Args:
        gyro_rps: Evenly sampled rates, rad/s, shape (n, 3).
        accel_mps2: Specific forces, m/s^2, shape (n, 3).
        rate_hz: Sampling rate.
        gravity_mps2: Local gravity: the scale of everything the accelerometer says.
        min_rest_s: Shorter rests are ignored.
        gravity_sigma_mps2: How well it is known, one sigma.

    Raises:
        PoorMotionError: Too few positions, or positions too much alike.
    """
    rests = find_rests(gyro_rps, accel_mps2, rate_hz, min_rest_s)
    if len(rests) < POSITIONS_MIN:
        raise PoorMotionError(
            f"only {len(rests)} rests of {min_rest_s:g} s found, {POSITIONS_MIN} needed: hold the IMU still "
            "on each of its six faces and some edges in between"
        )
    accel = calibrate_accelerometer(rests, gravity_mps2)
    gyro, found, motions = calibrate_gyro(gyro_rps, rests, accel, rate_hz)
    # gravity scales all of M_a; the bias and the gyro, which use directions alone, do not have its error
    by_gravity = accel.matrix * (gravity_sigma_mps2 / gravity_mps2)
    accel = replace(accel, matrix_sigma=np.hypot(accel.matrix_sigma, by_gravity))
    return ImuCalibration(accel, gyro, found, len(rests), motions)


def calibrate_accelerometer(
    rests: list[Rest], gravity_mps2: float = STANDARD_GRAVITY_MPS2
) -> SensorCalibration:
    """Fit M_a (lower triangular) and b_a so that every rest shows gravity's length.

    Raises:
        PoorMotionError: The positions do not determine all nine unknowns to 2 %.
    """
    measured = np.array([r.accel_mps2 for r in rests])
    noise = _pooled(np.array([r.accel_sigma for r in rests]))

    def residuals(x: FloatArray) -> FloatArray:
        force = (measured - x[6:]) @ _lower(x[:6]).T
        return np.asarray((np.linalg.norm(force, axis=1) - gravity_mps2) / noise)

    start = np.concatenate([np.eye(3)[LOWER[:, 0], LOWER[:, 1]], np.zeros(3)])
    x, sigma, rms = _solve(residuals, start)
    if not np.all(np.isfinite(sigma)) or np.max(sigma[:6]) > 0.02:
        raise PoorMotionError(
            "the positions are too similar to separate the axes: put the IMU on all six faces, "
            "each way up, and on some edges"
        )
    return SensorCalibration(_lower(x[:6]), _lower(sigma[:6]), x[6:], sigma[6:], rms)


def calibrate_gyro(
    gyro_rps: FloatArray, rests: list[Rest], accel: SensorCalibration, rate_hz: float
) -> tuple[SensorCalibration, bool, int]:
    """Fit M_g so that the turns between rests carry gravity's direction along; the bias is that at rest.

    Turns about the vertical say nothing (gravity does not move): mix the axes. The Earth's rotation
    (7e-5 rad/s) stays in the bias.

    Returns:
        The calibration, whether M_g was found (else it is I), and the number of turns used.
    """
    bias, bias_sigma = _rest_bias(rests)
    motions = [(a, b) for a, b in pairwise(rests) if _turned(a, b, accel) > 0.1]
    fixed = SensorCalibration(np.eye(3), np.zeros((3, 3)), bias, bias_sigma, float("nan"))
    if len(motions) < MOTIONS_MIN:
        return fixed, False, len(motions)
    padded = _padded_motions(gyro_rps, motions)
    before = _directions([a for a, _ in motions], accel)
    after = _directions([b for _, b in motions], accel)
    noise = _turn_noise(motions, rate_hz, accel)

    def residuals(x: FloatArray) -> FloatArray:
        R_start_end = products(so3.exp(padded @ x.reshape(3, 3).T / rate_hz))[:, -1]
        predicted = np.matvec(R_start_end.mT, before)
        return np.asarray(np.cross(predicted, after) / noise[:, None]).ravel()

    x, sigma, rms = _solve(residuals, np.eye(3).ravel(), rank_deficit=len(motions))
    if not np.all(np.isfinite(sigma)) or np.max(sigma) > 0.02:
        return fixed, False, len(motions)
    return SensorCalibration(x.reshape(3, 3), sigma.reshape(3, 3), bias, bias_sigma, rms), True, len(motions)


def _solve(
    residuals: Callable[[FloatArray], FloatArray], start: FloatArray, rank_deficit: int = 0
) -> tuple[FloatArray, FloatArray, float]:
    """Least squares with standard deviations; the sigmas grow with residuals above the noise, never shrink.

    `rank_deficit` counts residuals that carry no information (a cross product has one per direction).
    """
    solution = least_squares(residuals, start, method="trf", x_scale="jac", xtol=1e-12, ftol=1e-12)
    surplus = len(solution.fun) - rank_deficit - len(start)
    rms = float(np.sqrt(solution.fun @ solution.fun / max(surplus, 1)))
    values, vectors = np.linalg.eigh(solution.jac.T @ solution.jac)
    with np.errstate(divide="ignore"):
        spread = np.where(values > values[-1] * 1e-14, 1.0 / values, np.inf)
    variance = np.einsum("ij,j,ij->i", vectors, spread, vectors)
    return np.asarray(solution.x), np.sqrt(variance) * max(rms, 1.0), rms


def _lower(x: FloatArray) -> FloatArray:
    matrix = np.zeros((3, 3))
    matrix[LOWER[:, 0], LOWER[:, 1]] = x
    return matrix


def _pooled(sigma: FloatArray) -> FloatArray:
    """Noise of each rest, m/s^2, at least half the median: ten blocks estimate a standard error poorly."""
    each = np.sqrt(np.mean(sigma**2, axis=1))
    return np.asarray(np.maximum(each, 0.5 * np.median(each)) + 1e-9)


def _rest_bias(rests: list[Rest]) -> tuple[FloatArray, FloatArray]:
    """Mean rate over all rests weighted by length; sigma from the larger of scatter and standard error."""
    length = np.array([r.stop - r.start for r in rests], dtype=np.float64)
    weight = (length / length.sum())[:, None]
    means = np.array([r.gyro_rps for r in rests])
    bias = (weight * means).sum(axis=0)
    scatter = np.sqrt((weight * (means - bias) ** 2).sum(axis=0) / max(len(rests) - 1, 1))
    error = np.sqrt(((weight * np.array([r.gyro_sigma for r in rests])) ** 2).sum(axis=0))
    return bias, np.maximum(scatter, error)


def _directions(rests: list[Rest], accel: SensorCalibration) -> FloatArray:
    force = (np.array([r.accel_mps2 for r in rests]) - accel.bias) @ accel.matrix.T
    return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))


def _turned(a: Rest, b: Rest, accel: SensorCalibration) -> float:
    """Angle between gravity's directions in two rests, rad."""
    u, v = _directions([a, b], accel)
    return float(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v))


def _padded_motions(gyro_rps: FloatArray, motions: list[tuple[Rest, Rest]]) -> FloatArray:
    """Bias-free rates from the middle of one rest to the middle of the next, padded with zeros.

    The bias of each turn is the mean of its two rests, so a slow drift does not matter.
    """
    pieces = []
    for a, b in motions:
        start, stop = (a.start + a.stop) // 2, (b.start + b.stop) // 2
        pieces.append(gyro_rps[start:stop] - 0.5 * (a.gyro_rps + b.gyro_rps))
    padded = np.zeros((len(pieces), max(len(p) for p in pieces), 3))
    for row, piece in zip(padded, pieces, strict=True):
        row[: len(piece)] = piece
    return padded


def _turn_noise(motions: list[tuple[Rest, Rest]], rate_hz: float, accel: SensorCalibration) -> FloatArray:
    """Angle noise of each turn, rad: integrated gyro noise, bias error and the two gravity directions."""
    noise = []
    for a, b in motions:
        duration = 0.5 * (b.start + b.stop - a.start - a.stop) / rate_hz
        rest_s = np.array([(r.stop - r.start) / rate_hz for r in (a, b)])
        density = np.sqrt(
            np.mean([np.mean(r.gyro_sigma**2) * t for r, t in zip((a, b), rest_s, strict=True)])
        )
        integrated = density**2 * duration
        drift = np.mean(a.gyro_sigma**2 + b.gyro_sigma**2) * (0.5 * duration) ** 2
        direction = np.mean(a.accel_sigma**2 + b.accel_sigma**2) / np.sum(a.accel_mps2**2)
        # The accelerometer's own calibration error turns both directions.
        matrix = np.mean(accel.matrix_sigma[LOWER[:, 0], LOWER[:, 1]] ** 2)
        noise.append(np.sqrt(integrated + drift + direction + matrix + LEAST_NOISE_RAD**2))
    return np.array(noise)
