"""White noise of the inertial readings themselves, from the upper half of their spectrum.

Hands and robots move at some hertz: above that a spectrum shows the noise. Where it is flat there, its level
is the density, whatever a data sheet says. Where it is not, a vibration is seen, or a filter in the sensor,
and nothing is known of the density.
[Welch, "The use of fast Fourier transform for the estimation of power spectra", 1967]
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vical_daemon.estimation.inertial.imu_buffer import EVEN
from vical_daemon.estimation.measurements import FloatArray, ImuNoise, MeasuredNoise

_LENGTH = 64  # readings of a stretch
_LEAST = 6  # stretches: with 16 frequencies and three channels the density is known to 5 %
_MOTION_HZ = 12.0  # the tremor of hands ends there; slower IMUs do not tell noise from motion
_BANDS = 4  # parts of the upper half of the spectrum that are compared
_MORE = 1.5
"""Times what a start shows: later motion may be rougher. EuRoC has up to 1.2 times the noise of its first 3 s
as a whole."""
_GYRO, _ACCEL = slice(1, 4), slice(4, 7)  # columns of readings
_FLAT = 2.0  # ratio of the largest to the smallest density of them


def measured_noise(stated: ImuNoise, rows: FloatArray) -> ImuNoise:
    """Return noise densities in which white noise is what the readings show, or a little more if stated.

    Args:
        stated: Of the data sheet or the config.
        rows: Readings: t_s, gyro xyz, rad/s, accelerometer xyz, m/s^2; shape (n, 7).
    """
    gyro, accel = white_noise(rows)
    kind = ImuNoise if gyro is None or accel is None else MeasuredNoise
    return kind(
        _within(stated.gyro_density, gyro),
        stated.gyro_walk,
        _within(stated.accel_density, accel),
        stated.accel_walk,
        stated.rate_hz,
    )


def measured_gyro_density(stated: ImuNoise, rows: FloatArray) -> float:
    """Return the gyro's density of `measured_noise` alone, rad/s/sqrt(Hz)."""
    return _within(stated.gyro_density, _of_sensor(rows, _GYRO))


def _within(stated: float, measured: float | None) -> float:
    return stated if measured is None else min(max(stated, measured), _MORE * measured)


def at_least_measured(stated: ImuNoise, rows: FloatArray) -> ImuNoise:
    """As `measured_noise`, but a larger stated density is kept.

    Without a board images have errors that last along tracks. A looser IMU absorbs them: with the measured
    density, a quarter of the default, halves of a tablet's recording differ by 3.6 instead of 0.9 joint
    sigma (`python -m benchmarks phone`).
    """
    gyro, accel = white_noise(rows)
    return replace(
        stated,
        gyro_density=max(stated.gyro_density, gyro or 0.0),
        accel_density=max(stated.accel_density, accel or 0.0),
    )


def white_noise(rows: FloatArray) -> tuple[float | None, float | None]:
    """Densities of gyro, rad/s/sqrt(Hz), and accelerometer, m/s^2/sqrt(Hz), root mean square over the axes.

    Args:
        rows: See `measured_noise`.

    Returns:
        None for a spectrum that is not flat, and for too few readings without a gap.
    """
    return _of_sensor(rows, _GYRO), _of_sensor(rows, _ACCEL)


def _of_sensor(rows: FloatArray, columns: slice) -> float | None:
    """Density of one sensor, see `white_noise`."""
    if len(rows) < _LENGTH:
        return None
    t_s, values = rows[:, 0], rows[:, columns]
    step_s = float(np.median(np.diff(t_s)))
    first = max(_LENGTH // 4, math.ceil(_MOTION_HZ * step_s * _LENGTH)) + 1
    # a gap, or a reading that was written twice: the sensor measures less often than it is read
    broken = (np.diff(t_s) > EVEN * step_s) | (np.diff(values, axis=0) == 0.0).all(axis=1)
    whole = ~sliding_window_view(broken, _LENGTH - 1)[:: _LENGTH // 2].any(axis=1)
    if whole.sum() < _LEAST or first > _LENGTH * 3 // 8:
        return None
    stretches = np.ascontiguousarray(sliding_window_view(values, _LENGTH, axis=0)[:: _LENGTH // 2][whole])
    window = np.hanning(_LENGTH)
    spectrum = np.abs(np.fft.rfft(_detrended(stretches) * window)) ** 2 / float(window @ window)
    bands = np.array_split(spectrum[:, :, first:-1], _BANDS, axis=2)
    # each is the variance of one reading times an exponential deviate, whose median is ln 2
    variances = np.array([np.median(band, axis=(0, 2)) for band in bands]).mean(axis=1) / math.log(2.0)
    return _level(np.sqrt(step_s * variances))


def _detrended(stretches: FloatArray) -> FloatArray:
    """Stretches without their straight lines, by least squares along the last axis.

    As `scipy.signal.detrend`, which takes 0.5 s to load.
    """
    at = np.arange(stretches.shape[-1]) - 0.5 * (stretches.shape[-1] - 1)
    slopes = stretches @ (at / float(at @ at))
    return np.asarray(stretches - stretches.mean(axis=-1, keepdims=True) - slopes[..., None] * at)


def _level(densities: FloatArray) -> float | None:
    """Root mean square of the densities of some bands; None where they differ by too much."""
    if not 0.0 < densities.max() < _FLAT * densities.min():
        return None
    return float(np.sqrt((densities**2).mean()))
