"""White noise is measured in the readings where their spectrum is flat, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from vical_daemon.estimation.inertial.white_noise import at_least_measured, measured_noise, white_noise
from vical_daemon.estimation.measurements import ImuNoise

GYRO, ACCEL = 3e-4, 2e-3  # rad/s/sqrt(Hz), m/s^2/sqrt(Hz)


def rows(rate_hz: float = 200.0, seconds: float = 10.0, *, seed: int = 1) -> np.ndarray:
    """Readings of a hand-held rig with white noise of known density; shape (n, 7)."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    rates_hz, phase = np.array([0.7, 0.9, 1.1, 1.8, 2.0, 2.4]), np.arange(6.0)
    six = np.sin(2.0 * np.pi * rates_hz * t_s[:, None] + phase) * [2.0, 1.8, 1.6, 5.0, 4.0, 3.0]
    six += rng.standard_normal(six.shape) * np.sqrt(rate_hz) * np.repeat([GYRO, ACCEL], 3)
    return np.column_stack([t_s, six])


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 200.0, 1000.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_density_is_found_whatever_the_rate(rate_hz, seed) -> None:
    gyro, accel = white_noise(rows(rate_hz, seed=seed))
    assert gyro == pytest.approx(GYRO, rel=0.12) and accel == pytest.approx(ACCEL, rel=0.12)


def test_what_is_stated_gives_way_to_what_is_measured() -> None:
    for factor, expected in ((0.1, 1.0), (1.0, 1.0), (1.3, 1.3), (10.0, 1.5)):
        stated = ImuNoise(factor * GYRO, 1e-5, factor * ACCEL, 1e-4)
        found = measured_noise(stated, rows())
        assert found.gyro_density == pytest.approx(expected * GYRO, rel=0.1)
        assert found.accel_density == pytest.approx(expected * ACCEL, rel=0.1)
        assert (found.gyro_walk, found.accel_walk) == (1e-5, 1e-4)
    cautious = ImuNoise(10.0 * GYRO, 1e-5, 0.1 * ACCEL, 1e-4)
    kept = at_least_measured(cautious, rows())
    assert kept.gyro_density == cautious.gyro_density
    assert kept.accel_density == pytest.approx(ACCEL, rel=0.1)


def test_a_vibration_is_no_noise() -> None:
    shaken = rows()
    shaken[:, 1:] += np.sin(2.0 * np.pi * 87.0 * shaken[:, :1]) * np.repeat([0.1, 3.0], 3)
    assert white_noise(shaken) == (None, None)


def test_a_filter_in_the_sensor_hides_the_noise() -> None:
    smooth = rows()
    b, a = butter(2, 0.3)
    smooth[:, 1:4] = lfilter(b, a, smooth[:, 1:4], axis=0)
    gyro, accel = white_noise(smooth)
    assert gyro is None and accel == pytest.approx(ACCEL, rel=0.1)


def test_a_sensor_that_is_read_more_often_than_it_measures_says_nothing() -> None:
    held = rows()
    held[:, 4:] = held[np.arange(len(held)) // 3 * 3, 4:]
    gyro, accel = white_noise(held)
    assert gyro == pytest.approx(GYRO, rel=0.1) and accel is None


def test_readings_that_are_too_few_slow_or_full_of_gaps_say_nothing() -> None:
    assert white_noise(rows()[:100]) == (None, None)
    assert white_noise(rows(25.0, 60.0)) == (None, None)  # motion reaches half the rate
    assert white_noise(np.delete(rows(), slice(0, None, 30), axis=0)) == (None, None)


def test_one_gap_and_one_shock_do_not_matter() -> None:
    readings = rows()
    readings[700:705, 1:] += 20.0
    readings = np.delete(readings, slice(1200, 1300), axis=0)
    gyro, accel = white_noise(readings)
    assert gyro == pytest.approx(GYRO, rel=0.12) and accel == pytest.approx(ACCEL, rel=0.12)
