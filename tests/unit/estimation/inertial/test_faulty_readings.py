"""Readings at a sensor's range are found, and spikes are left out; everything else is taken as it is."""

from __future__ import annotations

import numpy as np
import pytest

from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.inertial.faulty_readings import RangeLimits, SpikeFilter
from vical_daemon.estimation.inertial.imu_intake import ImuIntake

RATE_HZ = 200.0
GRAVITY = (0.0, 0.0, 0.0, 9.81, 0.0, 0.0)


def motion(seconds: float = 30.0, noise: float = 2e-3, step: float = 0.0) -> np.ndarray:
    """Rates, rad/s, and forces, m/s^2, of a rig that is waved about; shape (n, 6)."""
    t_s = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    phase = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    rates_hz = np.array([0.7, 0.9, 1.1, 0.8, 1.0, 1.2])
    six = np.sin(2.0 * np.pi * rates_hz * t_s[:, None] + phase) * [2.0, 1.8, 1.6, 3.0, 2.0, 2.5]
    six[:, 3] += 9.81
    six += np.random.default_rng(1).normal(0.0, noise, six.shape) * [1.0, 1.0, 1.0, 10.0, 10.0, 10.0]
    return np.round(six / step) * step if step else six


def at_range(six: np.ndarray) -> np.ndarray:
    """Which readings have a channel at its range; those that are held at the end are left away."""
    limits: RangeLimits[int] = RangeLimits()
    decided = [x for k, row in enumerate(six.tolist()) for x in limits.sift(row, k)]
    assert [k for _, k, _ in decided] == list(range(len(decided)))
    return np.array([bool(channels) for _, _, channels in decided])


@pytest.mark.parametrize("step", [0.0, 3.5e-4])
@pytest.mark.parametrize(("sensor", "at"), [(slice(0, 3), 1.0), (slice(3, 6), 10.5)])
def test_clipped_readings_are_found_from_the_first_run_on(step, sensor, at) -> None:
    six = motion(step=step)
    beyond = (np.abs(six[:, sensor]) >= at).any(axis=1)
    six[:, sensor] = np.clip(six[:, sensor], -at, at)
    found = at_range(six)
    assert not found[~beyond].any()
    missed = np.flatnonzero(beyond[: len(found)] & ~found)
    missed = missed[missed >= 100]  # it starts beyond the range
    # the first one at the end of the range is a peak like any other; the intake bridges it later
    assert len(missed) <= 1 and not found[: missed.max(initial=0)][100:].any()


@pytest.mark.parametrize("step", [0.0, 3.5e-4, 2e-3])
def test_readings_within_the_range_are_not(step) -> None:
    assert at_range(motion(step=step)).mean() < 1e-3


@pytest.mark.parametrize("further", [False, True])
def test_a_channel_is_not_at_its_range_where_another_has_been_further(further) -> None:
    """A crest of a sensor that counts in 0.5 deg/s had been one (EuRoC's, rounded)."""
    six = motion(4.0, step=2e-3)
    six[:, 1:3] = np.round(six[:, 1:3] / 4e-3) * 2e-3
    six[:, 0] = np.minimum(six[:, 0], 1.5)
    six[2, 2] = 2.2 if further else 1.2
    assert at_range(six).any() != further


@pytest.mark.parametrize("sensor", [slice(0, 3), slice(3, 6)])
def test_a_sensor_that_is_read_more_often_than_it_measures_is_not_at_its_range(sensor) -> None:
    six = motion()
    six[:, sensor] = six[np.arange(len(six)) // 5 * 5, sensor]
    assert not at_range(six).any()
    six[:, sensor] = np.clip(six[:, sensor], -9.5, 9.5)  # of the accelerometer only
    assert at_range(six).any() == (sensor.start == 3)


@pytest.mark.parametrize("step", [0.0, 1e-3, 1e-2, 0.1])
def test_a_coarse_sensor_at_rest_is_not_at_its_range(step) -> None:
    six = np.random.default_rng(2).normal(GRAVITY, 5e-3, (6000, 6))
    assert not at_range(np.round(six / step) * step if step else six).any()


@pytest.mark.parametrize("rate_hz", [0.1, 0.2, 0.4])
def test_the_crest_of_a_slow_swing_of_a_coarse_sensor_is_not_its_range(rate_hz) -> None:
    """Of 30 random rigs in steps of 0.1 deg/s and 0.04 m/s^2, 10 were announced as clipped."""
    six = motion(60.0, noise=1e-3)
    swing = np.sin(2.0 * np.pi * rate_hz * np.arange(len(six)) / RATE_HZ)
    six[:, 1], six[:, 4] = 2.5 * swing, 6.0 * swing
    steps = np.repeat([np.radians(0.1), 0.04], 3)
    assert not at_range(np.round(six / steps) * steps)[1000:].any()


def test_a_larger_value_shows_that_the_range_is_wider() -> None:
    six = motion()
    six[: len(six) // 2, :3] = np.clip(six[: len(six) // 2, :3], -1.0, 1.0)
    found = at_range(six)
    assert found[: len(six) // 2].mean() > 0.2
    assert found[len(six) // 2 + 200 :].mean() < 0.01


@pytest.mark.parametrize(("noise", "sign"), [(1e-3, 1.0), (0.0, -1.0)])
def test_a_stream_that_begins_at_the_end_of_its_range_shows_it(noise, sign) -> None:
    six = motion()[:100]
    six[:, 0] = 1.5 * np.cos(np.arange(100) * 0.05)
    six[:, 1:] += np.random.default_rng(5).normal(0.0, noise, (100, 5))
    clipped = six[:, 0] > 1.0
    six[:, 0] = sign * np.minimum(six[:, 0], 1.0)
    intake, _ = take(six)
    assert intake.left_out["imu_clipped"] == clipped.sum()


def test_a_coarse_sensor_that_rests_at_first_is_not_at_its_range() -> None:
    six = np.tile([0.01, 0.01, 0.01, 9.81, 0.01, 0.01], (300, 1))
    six[100:, 2] -= 0.1 * np.arange(200) % 1.0  # turns about one axis, and tilts at last
    six[200:, 0] -= 0.2
    limits: RangeLimits[int] = RangeLimits()
    assert not any(
        0 in channels for k, row in enumerate(six.tolist()) for *_, channels in limits.sift(row, k)
    )


def sifted(six: np.ndarray) -> list[int]:
    spikes: SpikeFilter[int] = SpikeFilter()
    taken = [k for i, row in enumerate(six.tolist()) for k in spikes.sift(row, i)]
    return [k for k in taken if k not in spikes.late]


def test_single_spikes_are_left_out_and_nothing_else() -> None:
    six = motion()
    rng = np.random.default_rng(3)
    at = np.sort(rng.choice(np.arange(100, len(six), 50), 40, replace=False))
    six[at, rng.integers(0, 3, 40)] += rng.choice([-1.0, 1.0], 40) * rng.uniform(3.0, 30.0, 40)
    assert sifted(six) == np.setdiff1d(np.arange(len(six)), at).tolist()


@pytest.mark.parametrize("second", [(1, -14.0), (0, 10.0), (0, 4.0)])
def test_two_spikes_in_a_row_are_left_out_and_hide_no_later_ones(second) -> None:
    six = motion()
    six[300, 0] += 9.0
    six[301, second[0]] += second[1]
    later = np.arange(320, 700, 20)
    six[later, 2] += 5.0
    assert sifted(six) == np.setdiff1d(np.arange(len(six)), [300, 301, *later]).tolist()


@pytest.mark.parametrize("first", [(0, 5, 18), (1, 2), (17, 18), (19, 20), (4, 12)])
def test_spikes_among_the_first_readings_are_left_out_and_hide_no_later_ones(first) -> None:
    six = motion()
    at = [*first, 60, 100, 140]
    six[at, 2] += 10.0
    assert sifted(six) == np.setdiff1d(np.arange(len(six)), at).tolist()


def test_a_motion_that_begins_at_once_and_a_shock_are_taken() -> None:
    rest = np.random.default_rng(4).normal(GRAVITY, 2e-3, (1000, 6))
    onset = rest.copy()
    onset[500:, 0] += 2.0
    assert sifted(onset) == list(range(1000))
    shock = rest.copy()
    shock[500] += [1.0, 0.5, 0.0, 30.0, 10.0, 0.0]  # gyro and accelerometer
    assert sifted(shock) == list(range(1000))


def take(six: np.ndarray) -> tuple[ImuIntake, list[EventKind]]:
    intake, kinds = ImuIntake(), []
    for i, row in enumerate(six):
        intake.take(round(i * 1e9 / RATE_HZ), row[:3], row[3:])
        kinds += [event.kind for event in intake.news()]
    return intake, kinds


def test_a_rate_that_is_reached_within_a_few_steps_of_a_coarse_sensor_is_no_range() -> None:
    six = np.random.default_rng(2).normal(GRAVITY, 1e-3, (2000, 6))
    six[500:, 2] += np.minimum(np.arange(1500) * 0.05, 1.0)  # a robot that turns at 1 rad/s
    assert not at_range(np.round(six / 0.01) * 0.01).any()


def test_clipping_is_announced_once_with_its_share_and_bridged_as_far_as_it_goes() -> None:
    true = motion()
    six = true.copy()
    beyond = (np.abs(six[:, :3]) >= 1.5).any(axis=1)
    six[:, :3] = np.clip(six[:, :3], -1.5, 1.5)
    intake, events = ImuIntake(), []
    for i, row in enumerate(six):
        intake.take(round(i * 1e9 / RATE_HZ), row[:3], row[3:])
        events += intake.news()
    assert [event.kind for event in events] == [EventKind.IMU_CLIPPED]
    assert events[0].value == pytest.approx(beyond[1000:].mean(), abs=0.1)
    assert intake.left_out["imu_clipped"] == pytest.approx(beyond.sum(), rel=0.1)
    assert intake.buffer is not None
    assert not intake.buffer.gap_within(0.0, intake.buffer.newest_s)
    error = intake.buffer.rows - np.column_stack([np.arange(len(six)) / RATE_HZ, true])[: len(intake.buffer)]
    segment = intake.buffer.segment(0.0, intake.buffer.newest_s)
    assert segment is not None
    assert segment.clipping_sigma is not None
    uncertain = segment.clipping_sigma > 0.0
    assert np.count_nonzero(error[:, 1:][~uncertain]) <= 1  # the first of all
    assert (uncertain.any(axis=1) == beyond[: len(uncertain)]).mean() > 0.999
    ratio = np.abs(error[:, 1:][uncertain]) / segment.clipping_sigma[uncertain]
    assert np.sqrt(np.mean(ratio**2)) < 1.0
    assert np.sqrt(np.mean(error[:, 1:][uncertain] ** 2)) < 0.1  # of up to 0.5 rad/s beyond


def test_spikes_leave_no_event_and_no_gap() -> None:
    six = motion()
    six[700, 1] -= 12.0
    intake, kinds = take(six)
    assert kinds == [] and intake.left_out["imu_spikes"] == 1
    assert intake.buffer is not None and len(intake.buffer) == len(six) - 1
    assert not intake.buffer.gap_within(3.4, 3.6)


def test_readings_that_wait_are_dropped_when_another_recording_follows() -> None:
    limits: RangeLimits[int] = RangeLimits()
    rates = [0.0, 0.001, *(0.1 * k for k in range(1, 12)), 1.1]  # at last twice the same: it may be the end
    for k, rate in enumerate(rates):
        decided = limits.sift((rate, 1e-3 * k, 0.0, 0.0, 0.0, 9.8), k)
    assert decided == []
    limits.restart()
    assert [k for _, k, _ in limits.sift((0.0, 0.0, 0.0, 0.0, 0.0, 9.8), 99)] == [99]


def test_a_spike_among_the_first_readings_leaves_the_buffer() -> None:
    six = motion()[:200]
    spiked = six.copy()
    spiked[[0, 7, 15], 2] += 10.0
    intake, _ = take(spiked)
    assert intake.left_out["imu_spikes"] == 3
    assert intake.buffer is not None
    assert np.array_equal(intake.buffer.rows[:, 1:], np.delete(six, [0, 7, 15], axis=0))


def test_more_clipping_than_announced_is_announced_again() -> None:
    six = motion(40.0)
    six[2000:, :3] *= 1.5
    intake, shares = ImuIntake(), []
    for i, row in enumerate(np.clip(six, [-1.9] * 3 + [-99.0] * 3, [1.9] * 3 + [99.0] * 3)):
        intake.take(round(i * 1e9 / RATE_HZ), row[:3], row[3:])
        shares += [event.value for event in intake.news() if event.kind is EventKind.IMU_CLIPPED]
    assert len(shares) == 2
    assert shares[1] == pytest.approx((np.abs(six[2000:, :3]) > 1.9).any(axis=1).mean(), abs=0.1)
