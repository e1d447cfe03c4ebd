"""Late stamps and shifted images: found at their size, separated, used; nothing found where nothing is."""

import numpy as np
import pytest
from scipy.stats import chi2
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import simulate

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.noise.shared_errors import JITTERS_S, SHIFTS_PX, SharedErrors
from vical_daemon.estimation.noise.variance_components import of_window


def learnt(rng, jitter_s=0.0, shift_px=0.0, images=200, corners=40, outliers=0.0):
    """Images whose corners move at 300 px/s or so, with noise of 0.5 px and a pose not quite known."""
    shared = SharedErrors()
    for _ in range(images):
        ways = np.zeros((corners, 2, 3))
        ways[..., 0] = 200.0 * rng.standard_normal(2) + 100.0 * rng.standard_normal((corners, 2))
        ways[:, 0, 1] = ways[:, 1, 2] = 1.0
        ways = ways.reshape(-1, 3) / 0.5
        linear = 0.2 * rng.standard_normal((2 * corners, 6))
        e = np.array([jitter_s, shift_px, shift_px]) * rng.standard_normal(3)
        e *= 20.0 if rng.uniform() < outliers else 1.0
        innovation = ways @ e + linear @ rng.standard_normal(6) + rng.standard_normal(2 * corners)
        shared.learn(0.0, innovation, ways, ways.T @ linear)
    return shared


def test_good_images_lose_next_to_nothing():
    """Corners, 0.5 px at 240 px/s, and the pose show one stamp to some 0.6 ms, and one shift to 0.15 px."""
    found = [learnt(np.random.default_rng(seed)) for seed in range(40)]
    assert not any(f.jitter_found_s for f in found)
    assert np.mean([f.jitter_s**2 for f in found]) < 0.05 * 0.6e-3**2
    assert np.mean([f.shift_px**2 for f in found]) < 0.05 * 0.15**2


@pytest.mark.parametrize("jitter_s", [3e-4, 1e-3, 5e-3])
def test_jitter_is_found_at_its_size(jitter_s):
    found = [learnt(np.random.default_rng(seed), jitter_s) for seed in range(10)]
    assert np.mean([f.jitter_s for f in found]) == pytest.approx(jitter_s, rel=0.15)
    assert np.median([f.shift_px for f in found]) < 0.05
    assert jitter_s < 1e-3 or all(f.jitter_found_s for f in found)
    assert learnt(np.random.default_rng(1), jitter_s, outliers=0.01).jitter_s < 2.0 * jitter_s


@pytest.mark.parametrize("shift_px", [0.1, 0.3, 2.0])
def test_a_shift_of_whole_images_is_found_and_not_blamed_on_stamps(shift_px):
    found = [learnt(np.random.default_rng(seed), shift_px=shift_px) for seed in range(10)]
    assert np.mean([f.shift_px for f in found]) == pytest.approx(shift_px, rel=0.15)
    assert np.median([f.jitter_s for f in found]) < 1e-4
    assert not any(f.jitter_found_s or f.wander_px for f in found)


def test_both_at_once_are_told_apart():
    found = [learnt(np.random.default_rng(seed), 1e-3, 0.3) for seed in range(10)]
    assert np.mean([f.jitter_s for f in found]) == pytest.approx(1e-3, rel=0.15)
    assert np.mean([f.shift_px for f in found]) == pytest.approx(0.3, rel=0.15)


def test_an_image_that_moves_in_no_way_says_nothing():
    shared = SharedErrors()
    shared.learn(0.0, np.ones(8), np.zeros((8, 3)), np.zeros((3, 3)))
    assert shared.images == 0


def test_where_the_time_shift_is_held_shifts_are_found_all_the_same():
    rng = np.random.default_rng(2)
    shared = SharedErrors()
    for _ in range(60):
        ways = np.concatenate([np.zeros((2, 1)), 20.0 * np.eye(2)], axis=1)
        shared.learn(
            0.0, ways[:, 1:] @ (0.5 * rng.standard_normal(2)) + rng.standard_normal(2), ways, np.zeros((3, 1))
        )
    assert shared.jitter_found_s == 0.0
    assert shared.shift_px == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize("lens_known", [True, False])
def test_a_camera_that_shakes_is_calibrated_and_its_stamps_are_not_blamed(lens_known):
    run = simulate(3, 9.0, timeshift_cam_imu_s=0.01, corner_sigma_px=0.1, frame_sigma_px=0.3)
    subject = CalibratorSubject(
        CalibrationOptions(
            imu_noise=imu_noise(run), fix=frozenset({"intrinsics"}) if lens_known else frozenset()
        ),
        camera_prior(run, 3, StartErrors(0.02, 3.0), exact_lens=lens_known),
        run.points_m,
    )
    record = feed(run, subject)
    assert record.started_s() <= 6.0
    for shot in record.snapshots:
        assert shot.error[:7] @ np.linalg.solve(shot.covariance[:7, :7], shot.error[:7]) < chi2.isf(1e-4, 7)
    f = subject.calibrator.filter
    assert f.shared["cam0"].shift_px == pytest.approx(0.3, rel=0.25)
    assert f.shared["cam0"].jitter_s < 1e-4
    assert f.shared["cam0"].jitter_found_s == 0.0
    assert f.consistency["cam0"].scale == 1.0
    assert not [e for _, e in record.events if e.kind is EventKind.STAMP_JITTER]


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
    assert c.filter.shared["cam0"].jitter_s == pytest.approx(1e-3, rel=0.3)
    assert c.filter.consistency["cam0"].scale == 1.0  # not taken for noise of another kind
    assert any(e.kind is EventKind.STAMP_JITTER for e in events)
    error = np.array(estimate.T_imu_cam.p_m) - run.rig.p_imu_cam
    sigma = np.sqrt(np.diag(estimate.T_imu_cam.covariance)[:3])
    assert (np.abs(error) < 4.0 * sigma).all()
    assert np.linalg.norm(sigma) < 2e-3
    assert abs(estimate.timeshift_cam_imu_s - 0.01) < 4.0 * estimate.timeshift_sigma_s


def one_late(late_s, size):
    """An image that shows nothing but how late it is, with a variance of 1 / size^2."""
    return np.array([late_s * size]), np.array([[size, 0.0, 0.0]]), np.zeros((3, 1))


def test_images_of_the_start_do_not_count_twice():
    """What they say together is known; the same images, taken in again one by one, change nothing."""
    rng, size = np.random.default_rng(9), 1.0 / 50e-6
    late = (6e-4**2 + 50e-6**2) ** 0.5 * rng.standard_normal(30) * size**2
    S = np.zeros((90, 90))
    S[::3, ::3] = size**2 * np.eye(30)
    s = np.zeros(90)
    s[::3] = late
    jitter = SharedErrors()
    jitter.begin(of_window(S, s, JITTERS_S, SHIFTS_PX), until_s=30.0)
    known = jitter.jitter_s
    assert known == pytest.approx(6e-4, rel=0.3)
    for k in range(40):
        jitter.learn(float(k), *one_late(0.0, size))
    assert jitter.images == 9
    assert jitter.jitter_s == known
    for k in range(5):  # the clock of the camera was set back
        jitter.learn(float(k), *one_late(0.0, size))
    assert jitter.images == 14


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


@pytest.mark.parametrize("images", [150, 1000])
@pytest.mark.parametrize(("memory", "jitters"), [(0.0, True), (0.9, False)])
def test_only_what_is_independent_from_image_to_image_is_a_jitter_of_the_stamps(memory, jitters, images):
    """Errors of a lens or an imu make neighbours late alike: for 0.2 to 0.3 s on EuRoC."""
    rng, late_s, shared = np.random.default_rng(4), 0.0, SharedErrors()
    for _ in range(images):
        late_s = memory * late_s + np.sqrt(1.0 - memory**2) * 1e-3 * rng.standard_normal()
        ways = np.zeros((60, 3))
        ways[:, 0] = 1000.0 * rng.standard_normal(60)  # of corners of 0.3 px at 300 px/s
        ways[::2, 1] = ways[1::2, 2] = 3.0
        shared.learn(0.0, ways[:, 0] * late_s + rng.standard_normal(60), ways, np.zeros((3, 1)))
    assert shared.jitter_s == pytest.approx(1e-3, rel=0.4)
    assert (shared.jitter_found_s > 0.0) == jitters


def test_nothing_is_blamed_on_the_stamps_before_it_is_known_whether_neighbours_are_late_alike():
    rng, shared = np.random.default_rng(5), SharedErrors()
    for _ in range(40):
        ways = np.zeros((60, 3))
        ways[:, 0] = 1000.0 * rng.standard_normal(60)
        shared.learn(
            0.0, ways[:, 0] * 1e-3 * rng.standard_normal() + rng.standard_normal(60), ways, np.zeros((3, 1))
        )
    assert shared.jitter_s > 0.0
    assert shared.jitter_found_s == 0.0


@pytest.mark.parametrize(("interval_s", "varies"), [(0.05, True), (0.2, False)])
def test_delays_that_errors_of_an_imu_make_from_image_to_image_are_no_varying_time_shift(interval_s, varies):
    """EuRoC at 5 Hz, whose images are triggered: 0.56 ms. 0.2 % of a rate, over 0.2 s, is 0.4 ms."""
    rng, late_s, shared = np.random.default_rng(6), 0.0, SharedErrors()
    for k in range(300):
        late_s = 0.9 * late_s + np.sqrt(0.19) * 8e-4 * rng.standard_normal()
        ways = np.zeros((60, 3))
        ways[:, 0] = 1000.0 * rng.standard_normal(60)
        ways[::2, 1] = ways[1::2, 2] = 3.0
        innovation = ways[:, 0] * late_s + rng.standard_normal(60)
        shared.learn(k * interval_s, innovation, ways, np.zeros((3, 1)))
    assert shared.correlation_known and 6e-4 < shared.jitter_s < 1.1e-3
    assert (shared.wander_s > 0.0) == varies
