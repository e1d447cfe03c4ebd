"""Fast readings are averaged over 5 ms; others are left as they are, gaps end a block."""

from dataclasses import replace

import numpy as np
import pytest
from vical_mocks.points import simulate
from vical_mocks.rig import ImuDensities, reference_rig

from tests.unit.estimation.test_calibrator import calibrate, errors
from vical_daemon.estimation.inertial.imu_intake import BlockMeans, ImuIntake

SIX = np.arange(6.0)


def means(rate_hz, count=60):
    blocks = BlockMeans()
    taken = (blocks.take(k / rate_hz, (SIX * k).tolist(), None) for k in range(count))
    return [mean for mean in taken if mean is not None]


@pytest.mark.parametrize(("rate_hz", "joined"), [(100, 1), (200, 1), (250, 1), (400, 2), (500, 2), (1000, 5)])
def test_readings_of_at_most_5_ms_are_joined(rate_hz, joined):
    later = means(rate_hz)[1:]  # the interval before the first one is not known
    for k, mean in enumerate(later):
        middle = 1 + joined * k + (joined - 1) / 2
        assert mean.t_s == pytest.approx(middle / rate_hz)
        assert np.allclose(mean.six, SIX * middle)


def test_what_clipped_readings_leave_open_is_averaged_too():
    blocks = BlockMeans()
    blocks.take(0.0, SIX, None)
    for k in range(1, 5):
        assert blocks.take(1e-3 * k, SIX, None if k % 2 else [5.0] * 6) is None
    assert blocks.take(5e-3, SIX, None).clipping_sigma == pytest.approx([2.0] * 6)  # two of five


def test_a_gap_ends_a_block():
    intake = ImuIntake()
    t_ms = [*range(1, 1003), *range(2000, 2400)]
    for t in t_ms:
        intake.take(1_000_000 * t, [0.001 * t, 0.0, 0.0], [0.0, 0.0, 9.8])
    t_s = intake.buffer.rows[:, 0]
    assert intake.gap_end_s == pytest.approx(1.999)
    assert t_s[t_s < 1.5].max() > 0.999
    assert t_s[t_s > 1.5].min() < 2.002
    assert np.allclose(intake.buffer.rows[:, 1], t_s + 0.001)  # nothing of either side in the other


def test_segments_have_what_was_measured_at_the_instants_of_the_means():
    """A swing of 5 Hz and 5 rad/s loses 5 mrad/s in a mean of 5 ms: one per mille, like a wrong scale."""
    intake, turn = ImuIntake(), 10.0 * np.pi

    def rate_at(t_s):
        return 5.0 * np.sin(turn * t_s)

    for t in range(1, 600):
        intake.take(1_000_000 * t, [rate_at(1e-3 * t), 0.0, 0.0], [0.0, 0.0, 9.8])
    begin = 1e-3  # times are from the first reading on
    rows = intake.buffer.rows
    assert np.abs(rows[:, 1] - rate_at(rows[:, 0] + begin)).max() > 4e-3
    segment = intake.buffer.segment(0.1003, 0.5002)
    assert np.abs(segment.gyro[:, 0] - rate_at(segment.t_s + begin)).max() < 5e-5


def test_noise_of_a_fast_gyro_is_not_taken_for_motion():
    """At 30 deg/s the time shift was 11 sigma off, and the accelerometer's lag was blamed."""
    usual = ImuDensities()
    noisy = replace(usual, gyro=3.0 * usual.gyro)  # as consumer devices
    rig = reference_rig(5, mean_rate_dps=30.0, timeshift_cam_imu_s=0.03, densities=noisy)
    run = simulate(5, 14.0, rig=rig, imu_rate_hz=1000.0, camera_rate_hz=60.0)
    worst, events = 0.0, []

    def look(c):
        nonlocal worst
        estimate = c.estimate()
        events.extend(estimate.events)
        if estimate.cameras:
            x, sigma = errors(estimate, run)
            worst = max(worst, float(np.abs(x / sigma).max()))

    calibrate(run, each=look)
    assert 0.0 < worst < 5.0
    assert not events
