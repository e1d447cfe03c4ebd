"""What enters the buffer of inertial readings, and what is reported, for streams as devices make them."""

import numpy as np
import pytest

from vical_daemon.estimation.inertial.imu_intake import ImuIntake
from vical_daemon.estimation.wording import event_text

PERIOD_NS = 5_000_000
RNG = np.random.default_rng(0)
READINGS = RNG.standard_normal((4000, 6))


def feed(stamps_ns, readings=READINGS):
    intake, added = ImuIntake(), []
    for t, six in zip(stamps_ns, readings, strict=False):
        added += intake.take(int(t), six[:3], six[3:])
    return intake, added


def even(n, start_ns=0):
    return start_ns + PERIOD_NS * np.arange(n)


def test_an_even_stream_enters_as_it_is():
    intake, added = feed(even(400))
    assert len(added) == 400
    np.testing.assert_allclose(intake.buffer.rows[:, 0], 0.005 * np.arange(400), atol=1e-12)
    assert intake.news() == []
    assert intake.shift_s == 0.0


def test_a_gap_is_reported_once_with_its_length():
    intake, added = feed(np.concatenate([even(300), even(300, 300 * PERIOD_NS + 2_000_000_000)]))
    assert len(added) == 600
    assert [event_text(e) for e in intake.news()] == ["2.0 s without inertial data"]
    assert intake.gap_end_s == pytest.approx(300 * 0.005 + 2.0)
    assert intake.buffer.gap_within(1.0, 4.0)
    assert not intake.buffer.gap_within(0.2, 1.4)
    assert not intake.buffer.gap_within(3.6, 4.5)


def test_lost_samples_that_interpolation_bridges_are_no_gap():
    stamps = np.delete(even(400), np.r_[200:208])
    intake, added = feed(stamps)
    assert len(added) == 392
    assert intake.news() == []


def test_a_frozen_imu_is_a_gap():
    readings = READINGS[:800].copy()
    readings[301:501] = readings[300]
    intake, added = feed(even(800), readings)
    assert len(added) == 600
    assert intake.repeated == 200
    assert [event_text(e) for e in intake.news()] == ["1.0 s in which the IMU repeated one reading"]


def test_one_wrong_stamp_is_left_out():
    stamps = even(400)
    stamps[200] += 600_000_000_000
    intake, added = feed(stamps)
    assert len(added) == 399
    assert intake.refused == 1
    assert intake.news() == []


def test_swapped_and_repeated_stamps_are_left_out():
    stamps = even(400)
    stamps[[200, 201]] = stamps[[201, 200]]
    stamps[300] = stamps[299]
    intake, added = feed(stamps)
    assert len(added) == 398
    assert intake.refused == 2
    assert np.all(np.diff(intake.buffer.rows[:, 0]) > 0)


@pytest.mark.parametrize("back_s", [0.1, 1.0, 3600.0])
def test_a_clock_set_back_is_followed(back_s):
    later = even(300, 300 * PERIOD_NS - round(back_s * 1e9))
    intake, added = feed(np.concatenate([even(300), later]))
    assert len(added) == 600
    assert [event_text(e) for e in intake.news()] == [
        f"the IMU's stamps went back by {back_s:.1f} s: its clock was set"
    ]
    np.testing.assert_allclose(np.diff(intake.buffer.rows[:, 0]), 0.005, atol=1e-9)
    assert intake.shift_s == pytest.approx(-back_s, abs=1e-9)  # t_imu = t_cam + shift, by present stamps


def test_a_rate_that_changes_is_no_stream_of_gaps():
    slow = 300 * PERIOD_NS + 100_000_000 * np.arange(60)
    intake, added = feed(np.concatenate([even(300), slow]))
    assert len(added) == 360 - 1  # the newest is held until the next
    assert len(intake.news()) <= 60
    assert feed(100_000_000 * np.arange(200))[0].news() == []


def test_values_that_are_not_finite_are_counted():
    readings = READINGS[:50].copy()
    readings[20, 4] = np.inf
    readings[21, 0] = np.nan
    intake, added = feed(even(50), readings)
    assert len(added) == 48
    assert intake.refused == 2


@pytest.mark.parametrize("forwards_s", [0.5, 3600.0])
def test_a_clock_set_forwards_is_told_from_a_gap_by_the_next_image(forwards_s):
    for ahead_s, said in ((-forwards_s, []), (0.01, [f"{forwards_s:.1f} s without inertial data"])):
        intake, _ = feed(np.concatenate([even(300), even(10, 300 * PERIOD_NS + round(forwards_s * 1e9))]))
        assert intake.news() == []  # not yet
        intake.saw_image(ahead_s)
        assert [event_text(e) for e in intake.news()] == said
        assert intake.news() == []
