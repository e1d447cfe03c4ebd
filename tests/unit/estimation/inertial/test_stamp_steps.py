"""Steps in an IMU's stamps: followed where stamps are otherwise even, and nothing else is touched."""

from dataclasses import replace

import numpy as np
import pytest
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.inertial.stamp_steps import StampSteps
from vical_daemon.estimation.measurements import CalibrationOptions


def followed(t_s):
    """Stamps on the even axis, and what followed them."""
    steps = StampSteps()
    return np.array([steps.even(float(t)) for t in t_s]), steps


def stepped(t_s, at, step_s):
    return t_s + np.where(np.arange(len(t_s)) >= at, step_s, 0.0)


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
@pytest.mark.parametrize("step_s", [-4e-4, 3e-4])
def test_a_step_is_taken_out_and_told(rate_hz, step_s):
    rng = np.random.default_rng(1)
    even = np.arange(600) / rate_hz + rng.uniform(-5e-6, 5e-6, 600)
    out, steps = followed(stepped(even, 200, step_s))
    assert np.abs(out - even).max() < 2e-5
    assert steps.total_s == pytest.approx(step_s, abs=2e-5)
    (event,) = steps.news()
    assert event.kind is EventKind.IMU_CLOCK_REMAPPED
    assert event.value == pytest.approx(step_s, abs=2e-5)
    assert steps.news() == []


def test_a_step_that_a_driver_spreads_over_readings_is_one():
    # a driver never lets stamps go back: at 1000 Hz, 3 ms are made up by intervals of half a millisecond
    even = np.arange(900) * 1e-3
    late = np.clip(3e-3 - 5e-4 * (np.arange(900) - 400), 0.0, 3e-3)
    out, steps = followed(even + late)
    np.testing.assert_allclose(out, even + 3e-3, atol=1e-9)
    assert len(steps.news()) == 1


def test_steps_within_what_the_driver_states_of_its_stamps_are_no_news():
    # a mapping that is known to 0.1 ms moves to and fro as arrivals jitter; then it moves by more
    even = np.arange(4000) * 0.01
    moved, told, steps = even.copy(), [], StampSteps()
    for k, step_s in enumerate([3e-4, -2e-4, -3e-4, 2e-4, 3.5e-4, 3.5e-4, 7e-4]):
        moved[400 * k + 200 :] += step_s
    for t_s in moved:
        steps.even(float(t_s))
        told += steps.news(1e-4)
    (event,) = told
    assert event.value == pytest.approx(7e-4, abs=1e-7)
    assert steps.total_s == pytest.approx(14e-4, abs=1e-7)  # the time shift follows each of them


def test_steps_between_which_the_mapping_slides_back_are_not_added_up():
    """A driver's line on a busy computer slides by 0.2 ms in 20 s and steps back: 0.7 ms were announced."""
    t_s, told, steps = np.arange(12_000) * 0.01, [], StampSteps()
    for stamp_s in t_s + 1e-5 * (t_s % 20.0):
        steps.even(float(stamp_s))
        told += steps.news(1e-4 if steps.total_s > -7e-4 else 5e-5)  # the computer is idle again
    assert steps.total_s == pytest.approx(-10e-4, abs=2e-5)
    assert told == []


def test_a_single_late_stamp_is_put_right_and_leaves_nothing_behind():
    even = np.arange(400) * 0.01
    late = even.copy()
    late[[100, 250]] += 3e-3
    out, steps = followed(late)
    np.testing.assert_allclose(out, even, atol=1e-9)
    assert steps.total_s == 0.0
    assert steps.news() == []


@pytest.mark.parametrize("jitter_s", [1e-4, 2e-3])
def test_stamps_taken_on_arrival_are_left_alone(jitter_s):
    rng = np.random.default_rng(2)
    t = np.arange(2000) * 0.01 + rng.exponential(jitter_s, 2000)
    t[700:] += 4e-3
    out, steps = followed(np.sort(t))
    np.testing.assert_array_equal(out, np.sort(t))
    assert steps.news() == []


def test_missing_readings_are_no_step():
    t = np.delete(np.arange(1000) * 0.01, [100, 300, 301, 302, 500])
    out, steps = followed(t)
    np.testing.assert_array_equal(out, t)
    assert steps.total_s == 0.0


@pytest.mark.parametrize("rates_hz", [(100.0, 200.0), (100.0, 125.0), (100.0, 80.0), (500.0, 250.0, 333.3)])
def test_another_rate_is_no_step(rates_hz):
    """Each interval was taken for one more step: the time shift was 24 s off after half a minute."""
    rng = np.random.default_rng(3)
    t = np.cumsum(np.concatenate([np.full(600, 1.0 / rate_hz) for rate_hz in rates_hz]))
    t += rng.uniform(-5e-6, 5e-6, len(t))
    out, steps = followed(t)
    assert steps.total_s == 0.0 and steps.news() == []
    assert np.count_nonzero(out != t) <= 20 * (len(rates_hz) - 1)
    assert np.abs(out - t).max() <= 20 * 0.5 / rates_hz[0] + 1e-4
    stepped_out, again = followed(stepped(t, len(t) - 100, 3e-4))
    assert again.total_s == pytest.approx(3e-4, abs=2e-5)  # steps are followed at the new rate, too
    assert np.abs(stepped_out[-90:] - t[-90:]).max() < 2e-5


def test_a_slow_drift_of_the_mapping_is_left_to_the_filter():
    t = np.arange(6000) * 0.01 * (1.0 + 1e-4)
    out, steps = followed(t)
    np.testing.assert_array_equal(out, t)
    assert steps.total_s == 0.0


def calibrated(run, *, target_free=False):
    """The last estimate, and all events."""
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"}), target_free=target_free, imu_noise=imu_noise(run)
    )
    prior = camera_prior(run, 1, StartErrors(0.05, 5.0), exact_lens=True)
    subject = CalibratorSubject(options, prior, None if target_free else run.points_m)
    record = feed(run, subject)
    return subject.calibrator.estimate(), [event.kind for _, event in record.events]


@pytest.mark.parametrize("target_free", [False, True])
def test_a_calibration_goes_on_as_if_nothing_had_happened(target_free):
    make = simulate_tracks if target_free else simulate
    rate = {"camera_rate_hz": 10.0} if target_free else {}
    run = make(3, 10.0, rig=reference_rig(3, timeshift_cam_imu_s=0.01), **rate)
    run = replace(run, frames=[f for f in run.frames if f.t_s > 0.1])  # readings cover all of them either way
    step_ns = np.where(run.t_imu_ns < run.t_imu_ns[0] + 1_200_000_000, 3_000_000, 0)
    step_ns += np.where(run.t_imu_ns < run.t_imu_ns[0] + 7_000_000_000, 0, 500_000)
    even, _ = calibrated(run, target_free=target_free)
    moved, events = calibrated(replace(run, t_imu_ns=run.t_imu_ns + step_ns), target_free=target_free)
    assert events.count(EventKind.IMU_CLOCK_REMAPPED) == 2
    a, b = even.cameras["cam0"], moved.cameras["cam0"]
    np.testing.assert_allclose(b.T_imu_cam.p_m, a.T_imu_cam.p_m, atol=1e-7)
    # by the stamps of now, which are half a millisecond later than the even ones
    assert b.timeshift_cam_imu_s - a.timeshift_cam_imu_s == pytest.approx(5e-4, abs=1e-7)
    assert b.timeshift_sigma_s == pytest.approx(a.timeshift_sigma_s, rel=1e-3)
