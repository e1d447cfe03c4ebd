"""The inertial buffer: exact ends, holes, and bounded memory."""

import pickle
from itertools import pairwise

import numpy as np
import pytest

from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.imu_model import influence, over_intervals, strapdown
from vical_daemon.estimation.measurements import ImuNoise


def rates(t):
    t = np.asarray(t)[..., None]
    return np.concatenate([0.9 * np.sin(3 * t), 0.7 * np.cos(2 * t), 0.5 * np.sin(4 * t + 1)], axis=-1)


def forces(t):
    t = np.asarray(t)[..., None]
    return np.concatenate([np.sin(2 * t), 9.8 + np.cos(3 * t), 0.5 * np.sin(5 * t)], axis=-1)


def filled(n=500, base=0):
    buffer = ImuBuffer(base)
    for k in range(n):
        t = 0.01 * k
        assert buffer.append(t, rates(t), forces(t))
    return buffer


def test_segment_starts_and_ends_exactly_where_asked():
    seg = filled().segment(0.123, 0.456)
    assert seg.t_s[0] == 0.123
    assert seg.t_s[-1] == 0.456
    straight = rates(0.12) + 0.3 * (rates(0.13) - rates(0.12))
    assert np.abs(seg.gyro[0] - rates(0.123)).max() < 0.02 * np.abs(straight - rates(0.123)).max()
    assert (np.diff(seg.t_s) > 0).all()


def test_a_quick_shake_is_not_shortened_by_straight_lines_between_samples():
    w, dt = 2 * np.pi * 3.0, 0.01
    buffer = ImuBuffer(0)
    for k in range(60):
        shake = np.array([np.sin(w * k * dt), 0.0, 0.0])
        buffer.append(k * dt, np.zeros(3), shake)
    seg = buffer.segment(0.1033, 0.1533)
    gained = strapdown(seg, np.zeros((1, 3)), np.zeros((1, 3))).dv[0, -1, 0]
    exact = (np.cos(w * 0.1033) - np.cos(w * 0.1533)) / w
    assert gained == pytest.approx(exact, rel=2e-4)
    plain = strapdown(seg._replace(gyro_slope=None, accel_slope=None), np.zeros((1, 3)), np.zeros((1, 3)))
    assert abs(plain.dv[0, -1, 0] / exact - 1.0) > 1.5e-3


def test_a_slow_imu_follows_a_quick_shake():
    """5 Hz at 50 readings a second; differences over one reading on either side miss four times as much."""
    w, dt, off = 2 * np.pi * 5.0, 0.02, []
    buffer = ImuBuffer(0)
    for k in range(60):
        buffer.append(k * dt, np.zeros(3), np.array([np.sin(w * k * dt), 0.0, 0.0]))
    for begin in np.arange(0.2, 0.4, 0.0037):
        gained = strapdown(buffer.segment(begin, begin + 0.1), *np.zeros((2, 1, 3))).dv[0, -1, 0]
        off.append(w * gained - (np.cos(w * begin) - np.cos(w * (begin + 0.1))))
    assert np.sqrt(np.mean(np.square(off))) < 1e-3


def test_what_is_settled_is_not_changed_by_later_readings():
    """An image taken as soon as readings cover it was integrated with a one-sided slope at its end."""
    buffer = ImuBuffer(0)
    assert buffer.settled_s == -np.inf
    for k in range(40):
        t = 0.02 * k
        buffer.append(t, rates(t), forces(t))
        seen_s = buffer.settled_s
        if k < 30:
            continue
        before = buffer.segment(seen_s - 0.033, seen_s)
        later = ImuBuffer(0)
        for row in (*buffer.rows, [t + 0.02, *rates(t + 0.02), *forces(t + 0.02)]):
            later.append(row[0], row[1:4], row[4:])
        np.testing.assert_array_equal(later.segment(seen_s - 0.033, seen_s).accel_slope, before.accel_slope)


def test_a_hole_in_the_data_is_bridged_by_straight_lines():
    buffer = ImuBuffer(0)
    for t in (0.0, 0.01, 0.02, 0.2, 0.21, 0.22):
        buffer.append(t, np.full(3, 1.0 + t), np.full(3, 5.0 * t))
    seg = buffer.segment(0.015, 0.205)
    np.testing.assert_allclose(seg.gyro_slope, 1.0, atol=1e-9)
    np.testing.assert_allclose(seg.accel[:, 0], 5.0 * seg.t_s, atol=1e-9)


def test_intervals_are_the_segments_between_their_instants():
    buffer = filled()
    t_s = np.array([0.123, 0.13, 0.131, 0.1345, 0.5, 0.5, 0.73])  # between readings, at them, of no length
    segment, begin = buffer.intervals(t_s)
    x = over_intervals(strapdown(segment, np.zeros((1, 3)), np.zeros((1, 3))), begin, errors=True)
    for k, (a, b) in enumerate(pairwise(t_s)):
        alone = buffer.segment(a, b)
        nodes = x.nodes[k]
        np.testing.assert_allclose(segment.t_s[nodes], alone.t_s, atol=1e-12)
        if a == b:
            continue
        np.testing.assert_allclose(segment.gyro[nodes], alone.gyro, atol=1e-9)
        np.testing.assert_allclose(segment.accel_slope[nodes], alone.accel_slope, atol=1e-7)
        motion = strapdown(alone, np.zeros((1, 3)), np.zeros((1, 3)))
        for found, wanted in ((x.dR, motion.dR), (x.dv, motion.dv), (x.dp, motion.dp)):
            np.testing.assert_allclose(found[k], wanted[0, -1], atol=1e-11)
        expected = influence(np.eye(3), motion)
        np.testing.assert_allclose(x.influences[k].at, expected.at, atol=1e-10)
        np.testing.assert_allclose(x.influences[k].noise(ImuNoise()), expected.noise(ImuNoise()), atol=1e-18)


@pytest.mark.parametrize("t_s", [[-0.1, 0.2], [0.2, 5.2], [0.3, 0.2]])
def test_no_intervals_beyond_the_readings_nor_backwards(t_s):
    assert filled().intervals(np.array(t_s)) is None


def test_two_readings_that_nearly_coincide_leave_the_slopes_of_others_alone():
    buffer = ImuBuffer(0)
    for t in (*np.arange(0.0, 0.2, 0.01), 0.1901, *np.arange(0.2, 0.3, 0.01)):
        buffer.append(t, np.full(3, t), np.full(3, t))
    np.testing.assert_allclose(buffer.segment(0.11, 0.28).gyro_slope, 1.0, atol=1e-9)


@pytest.mark.parametrize(("a", "b"), [(-0.1, 0.2), (0.2, 5.2), (0.3, 0.2)])
def test_segment_outside_the_data_is_none(a, b):
    assert filled().segment(a, b) is None


def test_segment_on_sample_instants_has_no_empty_interval():
    seg = filled().segment(0.1, 0.2)
    assert (np.diff(seg.t_s) > 0).all()
    np.testing.assert_allclose(seg.gyro[-1], rates(0.2), atol=1e-12)


def test_buffer_refuses_what_is_not_newer_and_stays_bounded_when_trimmed():
    buffer = ImuBuffer(0)
    for k in range(30_000):
        buffer.append(0.01 * k, np.zeros(3), np.zeros(3))
        buffer.trim(0.01 * k - 1.0)
    assert len(buffer) < 110
    assert len(buffer._rows) <= 4096
    assert not buffer.append(buffer.newest_s, np.zeros(3), np.zeros(3))
    assert buffer.segment(buffer.newest_s - 0.5, buffer.newest_s) is not None


def test_the_trend_is_that_at_the_instant_itself():
    """By the readings before it alone, it was that of 10 ms earlier, and time shifts were 4 sigma off."""
    w, buffer, t_s = 2 * np.pi * 2.0, ImuBuffer(0), 0.5123
    for k in range(100):
        t = 0.01 * k
        buffer.append(t, np.array([np.sin(w * t), np.cos(w * t), 0.2]), np.array([t, 3.0 * t, 9.8]))
    first, second = buffer.trend(t_s)
    sine, cosine = np.sin(w * t_s), np.cos(w * t_s)
    true = np.array([w * cosine, -w * sine, 0.0])
    np.testing.assert_allclose(first[:3], true, atol=0.03 * w)
    np.testing.assert_allclose(first[3:], [1.0, 3.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(
        second[:2], -w * w * np.array([np.sin(w * t_s), np.cos(w * t_s)]), atol=0.1 * w * w
    )
    assert buffer.segment(0.4, t_s).trend == pytest.approx(np.array([first, second]))
    assert ImuBuffer(0).trend(0.0) is None


@pytest.mark.parametrize("stamps", [[0.0, 1e-9, 0.01], [0.0, 0.01, 0.010001], [0.0, 1e-9, 0.01, 0.010001]])
def test_two_readings_that_nearly_coincide_are_one_for_the_trend(stamps):
    """By the normal equations a noise of 0.01 became 1e7 rad/s^2."""
    rng, buffer = np.random.default_rng(2), ImuBuffer(0)
    for t in stamps:
        buffer.append(t, 0.01 * rng.standard_normal(3), 0.01 * rng.standard_normal(3))
    first, second = np.abs(buffer.trend(0.01)).max(axis=1)
    assert first < 10.0 and second < 1000.0


def test_means_that_nearly_coincide_are_left_as_they_are():
    rng, buffer = np.random.default_rng(3), ImuBuffer(0)
    buffer.spread_s2 = 2e-6
    for k in range(20):
        for t in (0.01 * k, 0.01 * k + 1e-7):
            buffer.append(t, 0.01 * rng.standard_normal(3), np.zeros(3))
    assert np.abs(buffer.segment(0.04, 0.15).gyro).max() < 0.05


def test_turning_gives_the_turn_over_the_reach_exactly_and_shakes_in_between():
    w, half_s = 2 * np.pi * 8.0, 0.015  # a hand's tremor
    buffer = ImuBuffer(0)
    for k in range(120):
        buffer.append(0.01 * k, np.array([0.02 * np.sin(w * 0.01 * k), 0.3, 0.0]), np.zeros(3))
    t = np.array([0.0, 0.2137, 0.5, 0.9731])
    rate, change = (x[:, :3] for x in buffer.around(t, half_s))

    def turn(a, b):
        return np.stack([0.02 / w * (np.cos(w * a) - np.cos(w * b)), 0.3 * (b - a), 0.0 * a], axis=-1)

    for u in (-half_s, -0.6 * half_s, 0.6 * half_s, half_s):
        found = rate * u + 0.5 * change * u**2
        assert np.abs((found - turn(t, t + u))[1:]).max() < 2e-5  # of 3e-4: what a readout of 30 ms sees
    assert np.abs(rate[0] - [0.02 * np.sin(w * 1e-3) * 0.0, 0.3, 0.0]).max() < 2e-3  # at the first reading
    slow = filled()
    assert np.abs(slow.around(np.array([0.7, 2.0]), 0.01)[0][:, :3] - rates([0.7, 2.0])).max() < 1e-3


@pytest.mark.parametrize("readings", [0, 500])
@pytest.mark.parametrize("clipped", [False, True])
def test_a_saved_buffer_holds_its_readings_alone_and_goes_on(readings: int, clipped: bool) -> None:
    buffer = filled(readings)
    buffer.trim(2.0)
    if clipped:
        buffer.append(5.0, rates(5.0), forces(5.0), [0.1] * 6)
    saved = pickle.dumps(buffer)
    assert len(saved) < 1000 + 110 * len(buffer)  # 13 numbers a reading
    again = pickle.loads(saved)
    assert np.array_equal(again.rows, buffer.rows)
    for k in range(600):
        for each in (buffer, again):
            assert each.append(5.01 + 0.01 * k, rates(k), forces(k), [0.2] * 6 if clipped else None)
    a, b = (each.segment(5.1, 10.9) for each in (buffer, again))
    assert np.array_equal(a.gyro, b.gyro) and np.array_equal(a.accel_slope, b.accel_slope)
    assert (a.clipping_sigma is not None) == clipped and np.array_equal(a.clipping_sigma, b.clipping_sigma)
