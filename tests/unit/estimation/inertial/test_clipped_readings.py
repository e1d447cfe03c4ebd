"""What becomes of readings at the end of a sensor's range."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from vical_daemon.estimation.inertial.clipped_readings import Bridged, ClippedReadings
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import ImuNoise
from vical_daemon.estimation.model.inertial_links import make_links

PERIOD_NS = 5_000_000
RAIL = 1.0


def bridged(rate: np.ndarray, other: np.ndarray | None = None) -> list[Bridged]:
    """Rates about x (and y), rad/s, of a gyro that ends at 1 rad/s."""
    six = np.zeros((len(rate), 6))
    six[:, 0] = rate
    six[:, 1] = 0.0 if other is None else other
    six = np.clip(six, -RAIL, RAIL)
    bridges, out = ClippedReadings(), []
    for k, row in enumerate(six.tolist()):
        out += bridges.take(k * PERIOD_NS, row, tuple(np.flatnonzero(np.abs(row) == RAIL).tolist()))
    out += bridges.rest()
    assert [x.t_ns for x in out] == [k * PERIOD_NS for k in range(len(rate))]
    return out


def test_readings_within_the_range_pass_at_once_and_unchanged() -> None:
    bridges = ClippedReadings()
    six = (0.1, 0.2, 0.3, 1.0, 2.0, 9.8)
    assert bridges.take(7, six, ()) == [Bridged(7, six)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_cubic_motion_is_restored_exactly_and_bounded_by_the_range(sign) -> None:
    t = np.arange(100) * 5e-3
    rate = sign * (1.3 - 12.0 * (t - 0.25) ** 2 - 10.0 * (t - 0.25) ** 3)
    out = bridged(rate)
    np.testing.assert_allclose([x.six[0] for x in out], rate, atol=1e-9)
    clipping_sigma = {round(x.clipping_sigma[0], 9) for x in out if x.clipping_sigma is not None}
    assert clipping_sigma == {round(float(np.abs(rate).max() - RAIL) / np.sqrt(3.0), 9)}
    assert [x.clipping_sigma is not None for x in out] == (np.abs(rate) > RAIL).tolist()


def test_two_channels_wait_for_each_other_and_keep_their_own_runs() -> None:
    t = np.arange(216) * 5e-3  # ends within the range of both
    a, b = 1.3 * np.sin(8.0 * t), 1.2 * np.sin(8.0 * t + 0.6)
    out = bridged(a, b)
    for channel, rate in ((0, a), (1, b)):
        uncertain = np.array([x.clipping_sigma is not None and x.clipping_sigma[channel] > 0.0 for x in out])
        assert (uncertain == (np.abs(rate) > RAIL)).all()
        error = np.array([x.six[channel] for x in out]) - rate
        assert np.abs(error).max() < 0.06
        assert not error[~uncertain].any()


def test_a_run_without_an_end_is_released_and_may_be_twice_the_range() -> None:
    rate = np.concatenate([np.linspace(0.0, 0.99, 50), np.full(500, 1.5)])
    out = bridged(rate)
    assert out[-1].six[0] == 1.5 * RAIL
    assert out[-1].clipping_sigma is not None
    assert out[-1].clipping_sigma[0] == pytest.approx(0.5 * RAIL / np.sqrt(3.0))
    bridges = ClippedReadings()
    held = [len(bridges.take(k * PERIOD_NS, (RAIL, 0.0, 0.0, 0.0, 0.0, 9.8), (0,))) for k in range(500)]
    assert sum(held) >= 500 - 202  # one second


def test_a_reading_that_comes_off_the_range_for_a_moment_keeps_its_value() -> None:
    t = np.arange(100) * 5e-3
    rate = 1.3 - 12.0 * (t - 0.25) ** 2
    rate[50] = 0.95
    out = bridged(rate)
    assert out[50].six[0] == 0.95
    assert out[50].clipping_sigma is None
    assert out[49].clipping_sigma is not None


def test_intervals_have_the_sigma_of_their_segments():
    rng, buffer = np.random.default_rng(0), ImuBuffer(0)
    for k in range(100):
        clipping_sigma = rng.random(6).tolist() if 40 < k < 60 else None
        buffer.append(0.01 * k, rng.standard_normal(3), rng.standard_normal(3), clipping_sigma)
    t_s = np.array([0.353, 0.4021, 0.47, 0.553, 0.6604])
    found, begin = buffer.intervals(t_s)
    alone = [buffer.segment(a, b) for a, b in pairwise(t_s)]
    expected = [np.zeros((len(x.t_s), 6)) if x.clipping_sigma is None else x.clipping_sigma for x in alone]
    np.testing.assert_allclose(found.t_s, np.concatenate([x.t_s for x in alone]))
    np.testing.assert_allclose(found.clipping_sigma, np.concatenate(expected))
    assert [int(k) for k in begin] == np.cumsum([0, *(len(x.t_s) for x in alone[:-1])]).tolist()


@pytest.mark.parametrize("imu", [6, 22])
def test_links_over_clipped_readings_know_less(imu):
    """What the clipped readings miss is common to them: a turn of its mean over the time."""
    rng, missed_rps = np.random.default_rng(1), 0.05
    plain, clipped = ImuBuffer(0), ImuBuffer(0)
    for k in range(60):
        rate, force = rng.standard_normal(3), rng.standard_normal(3)
        plain.append(0.01 * k, rate, force)
        clipped.append(0.01 * k, rate, force, [missed_rps, 0, 0, 0, 0, 0] if 20 <= k <= 30 else None)
    noise = ImuNoise()
    ends_s = np.array([0.15, 0.35])
    known, less = (make_links(x, ends_s, np.zeros((1, imu)), noise).root[0] for x in (plain, clipped))
    more = np.linalg.inv(less.T @ less) - np.linalg.inv(known.T @ known)
    assert np.sqrt(np.trace(more[:3, :3])) == pytest.approx(0.11 * missed_rps, rel=0.05)
