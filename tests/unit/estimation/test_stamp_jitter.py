"""Jitter of stamps: found at its size, not found where there is none, and used with its full weight."""

import numpy as np
import pytest
from scipy.stats import chi2
from vical_mocks.points import simulate

from benchmarks.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
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


def test_images_used_before_the_jitter_was_known_pay_for_it_once():
    """A mean of 30 images believed to 50 us each, that jitter by 1 ms, is known to 1 ms / sqrt(30)."""
    rng = np.random.default_rng(8)
    jitter = StampJitter()
    assert jitter.owed() == 0.0
    size, none = 1.0 / 50e-6, np.zeros(3)
    for _ in range(30):
        late = 1e-3 * rng.standard_normal() + 50e-6 * rng.standard_normal()
        jitter.learn(np.array([late * size]), np.array([size]), none)
    assert jitter.sigma_s == pytest.approx(1e-3, rel=0.3)
    believed = jitter._usual[:30] + np.where(np.arange(30) < 20, 0.0, jitter.sigma_s**2)
    stated = 1.0 / np.sum(1.0 / believed)
    assert stated + jitter.owed() == pytest.approx(
        np.mean(believed[:20]) / 20 + jitter.sigma_s**2 / 20, rel=0.2
    )
    assert jitter.owed() == 0.0


def test_an_assumed_jitter_gives_way_to_what_the_images_said():
    rng = np.random.default_rng(9)
    assumed = {0.0: StampJitter.assumed(2e-3), 6e-4: StampJitter.assumed(2e-3)}
    for true, jitter in assumed.items():
        for _ in range(40):
            size = 1.0 / 50e-6
            late = true * rng.standard_normal() + 50e-6 * rng.standard_normal()
            jitter.learn(np.array([late * size]), np.array([size]), np.zeros(3))
        assert jitter.sigma_s == 2e-3
        jitter.begin()
        assert jitter.sigma_s == pytest.approx(true, rel=0.3, abs=3e-5)
        assert jitter.owed() == 0.0


@pytest.mark.parametrize(("rate_hz", "jitter_s"), [(7.5, 1e-3), (10.0, 2e-3)])
def test_sharp_corners_with_late_stamps_start(rate_hz, jitter_s):
    """Believed, such stamps contradict the images: there was no answer at all."""
    run = simulate(
        2,
        12.0,
        timeshift_cam_imu_s=0.02,
        camera_rate_hz=rate_hz,
        corner_sigma_px=0.1,
        stamp_jitter_s=jitter_s,
    )
    subject = CalibratorSubject(
        CalibrationOptions(imu_noise=imu_noise(run)),
        camera_prior(run, 2, StartErrors(0.02, 3.0), exact_lens=False),
        run.points_m,
    )
    record = feed(run, subject)
    assert record.snapshots
    for shot in record.snapshots:
        assert shot.error[:7] @ np.linalg.solve(shot.covariance[:7, :7], shot.error[:7]) < chi2.isf(1e-4, 7)
