"""Jitter of stamps: found at its size, not found where there is none, and used with its full weight."""

import numpy as np
import pytest
from vical_mocks.points import simulate

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.stamp_jitter import StampJitter


def learnt(rng, jitter_s, images=200, corners=40, outliers=0.0):
    """Images whose corners move at 300 px/s or so, with unit noise and a pose that is not quite known."""
    jitter = StampJitter()
    for _ in range(images):
        by_shift = 500.0 * rng.standard_normal(2 * corners)
        linear = 0.2 * rng.standard_normal((2 * corners, 6))
        e = jitter_s * rng.standard_normal() * (20.0 if rng.uniform() < outliers else 1.0)
        innovation = by_shift * e + linear @ rng.standard_normal(6) + rng.standard_normal(2 * corners)
        jitter.learn(innovation, by_shift, by_shift @ linear)
    return jitter.sigma_s


def test_good_stamps_pay_nothing():
    found = [learnt(np.random.default_rng(seed), 0.0) for seed in range(40)]
    assert np.count_nonzero(found) <= 1


@pytest.mark.parametrize("jitter_s", [3e-4, 1e-3, 5e-3])
def test_jitter_is_found_at_its_size(jitter_s):
    found = [learnt(np.random.default_rng(seed), jitter_s) for seed in range(10)]
    assert np.mean(found) == pytest.approx(jitter_s, rel=0.15)
    assert learnt(np.random.default_rng(1), jitter_s, outliers=0.01) < 2.0 * jitter_s


def test_an_image_without_motion_says_nothing():
    jitter = StampJitter()
    jitter.learn(np.ones(8), np.zeros(8), np.zeros(3))
    assert jitter.images == 0


def test_a_jittering_camera_is_calibrated_with_the_weight_it_deserves():
    run = simulate(5, 12.0, timeshift_cam_imu_s=0.01, stamp_jitter_s=1e-3)
    lens = run.rig.lens
    prior = CameraPrior(lens.resolution, tuple(lens.intrinsics), lens.model, tuple(lens.distortion))
    c = Calibrator(CalibrationOptions(fix=frozenset({"intrinsics"})), {"cam0": prior}, run.points_m)
    events = []
    frames = iter(run.frames)
    frame = next(frames)
    for t, w, f in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True):
        while frame is not None and frame.t_cam_ns <= t:
            c.add_points(PointsFrame("cam0", frame.t_cam_ns, frame.ids, frame.uv_px))
            c.process()
            events += c.estimate().events
            frame = next(frames, None)
        c.add_imu(int(t), w, f)
    c.finish()
    estimate = c.estimate().cameras["cam0"]
    assert c.filter.jitter["cam0"].sigma_s == pytest.approx(1e-3, rel=0.3)
    assert c.filter.consistency["cam0"].scale == 1.0  # not taken for noise of another kind
    assert any("jitter" in event for event in events)
    error = np.array(estimate.T_imu_cam.p_m) - run.rig.p_imu_cam
    sigma = np.sqrt(np.diag(estimate.T_imu_cam.covariance)[:3])
    assert (np.abs(error) < 4.0 * sigma).all()
    assert np.linalg.norm(sigma) < 2e-3
    assert abs(estimate.timeshift_cam_imu_s - 0.01) < 4.0 * estimate.timeshift_sigma_s
