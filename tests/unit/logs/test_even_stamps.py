"""Stamps taken on arrival are replaced by those of the device's even grid; others stay as they are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vical_daemon.bus.messages import decode_imu
from vical_daemon.logs import open_recording
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.even_stamps import even_stamps
from vical_daemon.logs.mcap import LogWriter

RATE_HZ = 200.0
COUNT = 12_000


@pytest.fixture
def rates() -> np.ndarray:
    """A minute of turning about all axes with the noise of a MEMS gyro, rad/s."""
    t_s = np.arange(COUNT) / RATE_HZ
    rng = np.random.default_rng(1)
    smooth = np.stack([np.sin(3.1 * t_s), 0.9 * np.cos(4.3 * t_s), 0.7 * np.sin(2.3 * t_s + 1)], axis=1)
    return smooth + rng.normal(0.0, 2e-3, smooth.shape)


def truth_ns(skew: float = 30e-6) -> np.ndarray:
    return 1_700_000_000_123_456_789 + np.round(np.arange(COUNT) * 1e9 / RATE_HZ * (1 + skew)).astype(
        np.int64
    )


def delayed_ns(mean_s: float, seed: int = 2) -> np.ndarray:
    """Arrivals one after the other, each late by an exponential delay."""
    delay = np.random.default_rng(seed).exponential(mean_s * 1e9, COUNT)
    return np.maximum.accumulate(truth_ns() + delay.astype(np.int64))


def errors_us(even, which=slice(None)) -> np.ndarray:
    assert even is not None
    return (even.t_ns - truth_ns()[which]) * 1e-3


def test_exponential_delays_are_taken_off(rates) -> None:
    even = even_stamps(delayed_ns(2e-3), rates)
    assert np.abs(errors_us(even)).max() < 60.0
    assert even.jitter_s == pytest.approx(2e-3, rel=0.05)
    assert 1e-6 < even.sigma_s < 50e-6
    assert "jitter by 1.99 ms" in even.describe("imu0")


def test_four_readings_that_arrive_at_once(rates) -> None:
    last = np.minimum(np.arange(COUNT) // 4 * 4 + 3, COUNT - 1)
    even = even_stamps(truth_ns()[last], rates)
    assert np.abs(errors_us(even)).max() < 1.0


@pytest.mark.parametrize("late_us", [20, 300])
def test_bursts_whose_stamps_differ_a_little(rates, late_us) -> None:
    place = np.arange(COUNT) % 4
    last = np.minimum(np.arange(COUNT) // 4 * 4 + 3, COUNT - 1)
    even = even_stamps(truth_ns()[last] + place * late_us * 1000, rates)
    assert errors_us(even).mean() == pytest.approx(3 * late_us, abs=2.0)  # the last one defines the arrival
    assert errors_us(even).std() < 2.0


def test_lost_readings_and_a_gap_stay_lost(rates) -> None:
    kept = np.setdiff1d(np.arange(COUNT), [2500, 5001, 5002, *range(8000, 8600)])
    even = even_stamps(delayed_ns(2e-3)[kept], rates[kept])
    wrong = np.abs(errors_us(even, kept)) > 100.0
    assert wrong.sum() <= 3  # where delays hide on which side of a loss a reading lies
    assert even.pieces == 4
    assert np.diff(even.t_ns).max() == pytest.approx(601 * 5e6, rel=1e-3)


def test_readings_recorded_in_order_whose_stamps_are_not(rates) -> None:
    jitter = np.random.default_rng(3).exponential(2e6, COUNT).astype(np.int64)
    stamps = truth_ns() + jitter
    assert (np.diff(stamps) < 0).any()
    assert np.abs(errors_us(even_stamps(stamps, rates))).max() < 60.0


def test_even_stamps_stay_as_they_are(rates) -> None:
    assert even_stamps(truth_ns(), rates) is None
    kept = np.setdiff1d(np.arange(COUNT), [700, 2500, *range(8000, 8600)])
    assert even_stamps(truth_ns()[kept], rates[kept]) is None


@pytest.mark.parametrize("unit_ns", [10_000, 100_000, 1_000_000])
def test_rounded_stamps_stay_as_they_are(rates, unit_ns) -> None:
    assert even_stamps(truth_ns() // unit_ns * unit_ns, rates) is None


@pytest.mark.parametrize("rate_hz", [80.0, 130.0, 250.0])
@pytest.mark.parametrize("up_ns", [0, 5_000_000], ids=["down", "to the nearest"])
def test_stamps_rounded_to_about_the_interval_are_not_late(rate_hz, up_ns) -> None:
    """As delays they had put the time shift 4.6 ms off at a sigma of 0.03 ms."""
    t_s = np.arange(8000) / rate_hz
    gyro = np.stack([np.sin(1.9 * t_s), np.sin(2.3 * t_s + 1.0), np.sin(3.1 * t_s + 2.0)], axis=1)
    true_ns = np.round(1e9 * t_s).astype(np.int64)
    unit_ns = 10_000_000
    even = even_stamps((true_ns + up_ns) // unit_ns * unit_ns, gyro)
    assert even is not None and not even.delays
    off_s = 1e-9 * (even.t_ns - true_ns)
    assert off_s.std() < 1e-4
    assert abs(off_s.mean()) < 2.0 * even.sigma_s
    assert even.sigma_s == pytest.approx(1e-2 / math.sqrt(12.0), rel=0.05)


def test_readings_that_were_taken_unevenly_stay_where_they_are(rates) -> None:
    t_s = np.arange(COUNT) / RATE_HZ + np.random.default_rng(4).normal(0.0, 7e-4, COUNT)
    at_s = np.arange(COUNT) / RATE_HZ
    there = np.stack([np.interp(t_s, at_s, rate) for rate in rates.T], axis=1)
    assert even_stamps(truth_ns()[0] + np.round(t_s * 1e9).astype(np.int64), there) is None


def test_a_timer_whose_delays_add_up_is_not_even(rates) -> None:
    steps = 5e6 + np.random.default_rng(5).exponential(1e6, COUNT)
    t_ns = np.round(np.cumsum(steps)).astype(np.int64)
    there = np.stack([np.interp(t_ns * 1e-9, np.arange(COUNT) / RATE_HZ, rate) for rate in rates.T], axis=1)
    assert even_stamps(t_ns[:8000], there[:8000]) is None


def test_a_rig_at_rest_decides_nothing() -> None:
    noise = np.random.default_rng(6).normal(0.0, 2e-3, (COUNT, 3))
    assert even_stamps(delayed_ns(2e-3), noise) is None


@pytest.mark.parametrize("count", [0, 1, 2, 3, 50])
def test_short_streams_stay_as_they_are(rates, count) -> None:
    assert even_stamps(delayed_ns(2e-3)[:count], rates[:count]) is None


def test_recordings_give_even_stamps_with_a_warning(tmp_path, a_motion, write_asl) -> None:
    t_ns, gyro, force = a_motion(seconds=20.0)
    late = t_ns + np.random.default_rng(7).exponential(2e6, len(t_ns)).astype(np.int64)
    late = np.maximum.accumulate(late) + np.arange(len(late))  # one after the other
    folder = write_asl(tmp_path / "asl", imu=(late, gyro, force))
    as_recorded = open_recording(folder, as_recorded=True)
    log = tmp_path / "a.mcap"
    with LogWriter(log) as writer:
        for key, payload in as_recorded.messages():
            writer.write(key, payload, stamp_of(payload))
    for path in (folder, log):
        recording = open_recording(path)
        assert any("jitter by" in warning for warning in recording.warnings)
        arrays = recording.imu_arrays("imu0")
        stamps = [decode_imu(p).stamp_ns for key, p in recording.messages() if "/imu/" in key]
        assert stamps == arrays.t_ns.tolist()
        assert np.abs(arrays.t_ns - t_ns[: len(stamps)]).max() < 200_000
        assert 0.0 < recording.stamp_sigma_s["imu0"] < 1e-4
        assert any("jitter by" in warning for warning in recording.warnings)  # still, after a walk
    kept = open_recording(log, as_recorded=True).imu_arrays("imu0").t_ns
    assert (kept == as_recorded.imu_arrays("imu0").t_ns).all()


def test_bursts_at_rest_are_not_taken_for_another_unit(tmp_path, a_motion, write_asl) -> None:
    t_ns, gyro, force = a_motion(seconds=20.0)
    place = np.arange(len(t_ns)) % 4
    stamps = t_ns - place * 5_000_000 + 15_000_000 + place * 3_000  # four readings in 10 us, every 20 ms
    still = np.random.default_rng(8).normal(0.0, 1e-3, gyro.shape)
    folder = write_asl(tmp_path / "asl", imu=(stamps, still, np.broadcast_to(force[0], force.shape)))
    assert len(open_recording(folder).imu_arrays("imu0").t_ns) == len(t_ns)
