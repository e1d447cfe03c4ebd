"""Which images of a fast camera are used, and how many in slow motion."""

import numpy as np
import pytest

from vical_daemon.estimation.filter.image_pace import ImagePace, Thinning, interval_s
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import ImuNoise
from vical_daemon.estimation.status.excitation import RunningMotion

DENSITY = 2e-4  # of a gyro, rad/s/sqrt(Hz)


def stamps(rate_hz: float, jitter_s: float = 0.0, seconds: float = 60.0):
    true = np.arange(0.0, seconds, 1.0 / rate_hz)
    return true, true + np.random.default_rng(3).normal(0.0, jitter_s, len(true))


@pytest.mark.parametrize(
    ("rate_hz", "share"), [(10.0, 1), (20.0, 1), (23.0, 1), (25.0, 2), (30.0, 2), (60.0, 3), (200.0, 9)]
)
def test_no_more_images_than_wanted_are_taken(rate_hz, share):
    true, _ = stamps(rate_hz)
    thinning, least_s = Thinning(), 1.0 / 23.0
    taken = [t for t in true if thinning.takes(t, least_s)]
    assert len(taken) == pytest.approx(len(true) / share, abs=8)
    assert np.allclose(np.diff(taken[10:]), share / rate_hz)


@pytest.mark.parametrize("rate_hz", [20.0, 40.0, 60.0])
def test_images_are_not_chosen_by_the_error_of_their_stamps(rate_hz):
    """Taken by the interval to the last one, those that stay would be stamped 0.1 ms late on average."""
    true, seen = stamps(rate_hz, 1e-3, 600.0)
    thinning, least_s = Thinning(), 1.0 / 21.0
    late = np.array([s - t for t, s in zip(true, seen, strict=True) if thinning.takes(s, least_s)])
    assert abs(late.mean()) < 4.0 * 1e-3 / np.sqrt(len(late))


def test_a_camera_that_changes_its_rate_is_followed():
    thinning, least_s = Thinning(), 1.0 / 23.0
    slow, fast = np.arange(0.0, 10.0, 0.1), np.arange(10.0, 20.0, 0.01)
    assert [thinning.takes(t, least_s) for t in slow] == [True] * len(slow)
    assert sum(thinning.takes(t, least_s) for t in fast) == pytest.approx(200, abs=20)


def sweep(amplitude_rps: float, rate_hz: float = 200.0, seconds: float = 8.0):
    """A rig that turns to and fro about one axis at 0.3 Hz, and its gyro's noise."""
    t = np.arange(0.0, seconds, 1.0 / rate_hz)
    gyro = np.random.default_rng(5).normal(0.0, DENSITY * np.sqrt(rate_hz), (len(t), 3))
    gyro[:, 0] += amplitude_rps * np.sin(0.6 * np.pi * t)
    motion, buffer = RunningMotion(), ImuBuffer(0)
    for t_s, rates in zip(t.tolist(), gyro, strict=True):
        motion.add(t_s, rates)
        buffer.append(t_s, rates, np.zeros(3))
    return motion.rate_change_rps2, buffer


def test_the_rate_changes_by_twice_its_noise_between_images():
    amplitude_rps = 0.2
    change, buffer = sweep(amplitude_rps)
    wanted_s = interval_s(ImuNoise(gyro_density=DENSITY), change, buffer)
    slope = 0.6 * np.pi * amplitude_rps / np.sqrt(2.0)
    assert wanted_s == pytest.approx(2.0 * np.sqrt(4.0 * DENSITY**2 * 200.0) / slope, rel=0.15)


@pytest.mark.parametrize(("amplitude_rps", "share"), [(2.0, 1), (0.2, 3), (0.0, 6)])
def test_slow_motion_takes_fewer_images(amplitude_rps, share):
    """Of 60 a second all in fast motion, ten at rest."""
    change, buffer = sweep(amplitude_rps)
    pace = ImagePace(ImuNoise(gyro_density=DENSITY))
    times = np.arange(0.0, 10.0, 1.0 / 60.0)
    taken = [t for t in times if pace.takes("cam0", float(t), change, buffer)]
    assert len(taken) == pytest.approx(len(times) / share, abs=4)


def test_all_images_are_taken_while_nothing_is_known_of_the_motion():
    pace = ImagePace(ImuNoise())
    assert all(pace.takes("cam0", 0.01 * k, None, None) for k in range(100))
