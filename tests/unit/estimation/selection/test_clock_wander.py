"""A time shift that wanders (an exposure that adapts to the light) is followed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import simulate

from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.estimation.status.change_watch import DriftWatch

SIZE_S, PERIOD_S = 4e-3, 10.0


def wander_s(t_s: float) -> float:
    return SIZE_S * float(np.sin(2.0 * np.pi * t_s / PERIOD_S))


@pytest.mark.parametrize("seed", [41, 42, 43, 44])
def test_an_exposure_that_adapts_to_the_light(seed: int) -> None:
    run = simulate(seed, 30.0)
    late = [replace(f, t_cam_ns=f.t_cam_ns + round(1e9 * wander_s(f.t_s))) for f in run.frames]
    prior = camera_prior(run, seed, StartErrors(), exact_lens=True)
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=imu_noise(run))
    record = feed(replace(run, frames=late), CalibratorSubject(options, prior, run.points_m))
    kinds = {event.kind for _, event in record.events}
    assert EventKind.CLOCK_WANDER in kinds and EventKind.BUMPED not in kinds
    z = [(s.error[6] + wander_s(s.t_s)) / np.sqrt(s.covariance[6, 6]) for s in record.snapshots]
    shown = [abs(x) for x, s in zip(z, record.snapshots, strict=True) if s.t_s > 18.0]
    assert np.sqrt(np.mean(np.square(shown))) < 2.0 and max(shown) < 4.0  # 6.1 to 7.0 and 15 without


@pytest.mark.parametrize("seed", [41, 42])
def test_an_exposure_that_changes_too_fast_to_be_followed_is_named_and_does_not_converge(seed: int) -> None:
    """Up and down by 3 ms every 2 s; without being named, seconds of `converged` beyond 5 sigma."""
    run = simulate(seed, 20.0, camera_rate_hz=10.0)

    def late_s(t_s: float) -> float:
        return 3e-3 * float(np.sign(np.sin(2.0 * np.pi * t_s / 4.3)))

    late = [replace(f, t_cam_ns=f.t_cam_ns + round(1e9 * late_s(f.t_s))) for f in run.frames]
    prior = camera_prior(run, seed, StartErrors(), exact_lens=True)
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=imu_noise(run))
    record = feed(replace(run, frames=late), CalibratorSubject(options, prior, run.points_m))
    named = [(t_s, e) for t_s, e in record.events if e.kind is EventKind.TIMESHIFT_VARIES]
    ((t_s, event),) = named
    assert event.value == pytest.approx(3e-3, rel=0.5)
    after = [s for s in record.snapshots if s.t_s > t_s]
    assert all(s.status == "converging" for s in after)  # no motion shows better what varies
    z = [(s.error[6] + late_s(s.t_s)) / np.sqrt(s.covariance[6, 6]) for s in after]
    assert max(map(abs, z)) < 3.0  # 16 without their part in the sigma


def test_between_two_steps_and_the_next_nothing_is_converged() -> None:
    """A time shift that stepped twice may step again: to and fro by 4 ms, every 8 s."""
    run = simulate(45, 40.0)

    def late_s(t_s: float) -> float:
        return 4e-3 * float(int(t_s / 8.0) % 2)

    late = [replace(f, t_cam_ns=f.t_cam_ns + round(1e9 * late_s(f.t_s))) for f in run.frames]
    prior = camera_prior(run, 45, StartErrors(), exact_lens=True)
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=imu_noise(run))
    record = feed(replace(run, frames=late), CalibratorSubject(options, prior, run.points_m))
    steps = [t_s for t_s, e in record.events if e.kind is EventKind.TIMESHIFT_STEPPED]
    assert len(steps) == 4 and np.ptp(np.array(steps) - [8.0, 16.0, 24.0, 32.0]) <= 2.0
    status = {s.status for s in record.snapshots if s.t_s > steps[1] + 2.0}  # it holds for two seconds
    assert status == {"converging"}


def test_what_a_walk_explains_is_no_other_drift() -> None:
    rng = np.random.default_rng(1)
    values = np.cumsum(rng.standard_normal(200))
    watch = DriftWatch(1e-3)
    assert not any(watch.drifts(float(t), v, 0.1, 1.0, 1.0) for t, v in enumerate(values))
    watch = DriftWatch(1e-3)
    assert any(watch.drifts(float(t), v, 0.1, 1.0, 0.0) for t, v in enumerate(values))
