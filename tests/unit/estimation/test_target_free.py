"""The target-free calibrator from its input to its words."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from vical_mocks.curves import Pause
from vical_mocks.harness.feed import (
    CalibratorSubject,
    StartErrors,
    camera_prior,
    feed,
    imu_noise,
    nees,
    points_frame,
)
from vical_mocks.random_rigs import draw
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import room_landmarks, simulate_tracks
from vical_mocks.trajectory import one_axis, still

from tests.unit.estimation.some_layout import window_layout
from vical_daemon.estimation.events import ROLLING, EventKind
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.smoother import target_free_initializer
from vical_daemon.estimation.smoother.target_free_status import TargetFreeStatus
from vical_daemon.estimation.target_free import TargetFreeCalibrator


def subject_for(run, *, lens_known=True, seed=0, start=None, model="radtan", shift_s=None):
    prior = camera_prior(run, seed, start or StartErrors(0.05, 5.0), exact_lens=lens_known)
    if model != prior.distortion_model:
        prior = replace(prior, distortion_model=model, distortion=None)
    prior = replace(prior, readout_s=0.0, timeshift_cam_imu_s=shift_s)
    fix = frozenset({"intrinsics"}) if lens_known else frozenset()
    options = CalibrationOptions(fix=fix, target_free=True, imu_noise=imu_noise(run))
    return CalibratorSubject(options, prior, None)


def simulated(seed=4, seconds=12.0, shift_s=-0.03, **options):
    return simulate_tracks(
        seed, seconds, rig=reference_rig(seed, timeshift_cam_imu_s=shift_s), camera_rate_hz=10.0, **options
    )


def looking(seed, motion, *arguments):
    """A rig that moves as given while its camera looks into the room."""
    plain = reference_rig(seed)
    return replace(plain, trajectory=motion(*arguments, T_imu_cam=(plain.R_imu_cam, plain.p_imu_cam)))


@pytest.fixture(scope="module")
def followed():
    run = simulated(outlier_fraction=0.03)
    subject = subject_for(run)
    return run, subject, feed(run, subject)


def test_converges_from_nothing_and_is_right_within_its_sigmas(followed):
    _, _, record = followed
    last = record.snapshots[-1]
    assert last.status == "converged"
    assert record.started_s() <= 5.0
    assert nees(last.error, last.covariance, 7) < chi2.isf(1e-3, 7)
    assert np.sqrt(np.diag(last.covariance))[:3].max() < 1.5e-3
    assert abs(last.error[6]) < 3e-4


def test_every_answer_on_the_way_was_honest(followed):
    _, _, record = followed
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-5, 7), shot.t_s


def test_first_answers_allow_for_all_of_a_jitter():
    """At 7.5 images a second; the first window had found 0.29 ms of 1 ms, and NEES/7 was 7.1."""
    run, known = draw(502, 25.0, target_free=True)
    prior = camera_prior(run, 502, StartErrors(0.03, 0.01 * run.rig.lens.resolution[0]), exact_lens=known)
    options = CalibrationOptions(target_free=True, imu_noise=imu_noise(run))
    record = feed(run, CalibratorSubject(options, prior, None), until_s=6.0)
    assert len(record.snapshots) >= 2
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-4, 7), shot.t_s


@pytest.mark.parametrize("jitter_s", [2e-4, 1e-3])
def test_stamps_that_jitter_are_noticed_and_allowed_for(jitter_s):
    run = simulated(seed=7, seconds=14.0, stamp_jitter_s=jitter_s)
    subject = subject_for(run)
    record = feed(run, subject)
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-4, 7), shot.t_s
    # 0.2 ms are less than one image shows here: seen or not, they do no harm
    assert (
        (0.65 if jitter_s > 5e-4 else 0.0) * jitter_s
        <= subject.calibrator.evaluator.jitter_s
        < 1.5 * jitter_s
    )
    assert len([e for _, e in record.events if e.kind is EventKind.STAMP_JITTER]) == (jitter_s == 1e-3)


def test_images_that_shake_while_the_rig_comes_to_rest_are_not_called_late():
    """Images that shake by 0.1 px, at rest from 18 to 28 s: "stamps jitter by 1.1 ms" (or by 94)."""
    run, known = draw(6, 60.0, target_free=True, change=lambda rig: at_rest(rig, Pause(18.0, 28.0)))
    prior = camera_prior(run, 6, StartErrors(), exact_lens=known)
    fix = frozenset({"intrinsics"} if known else ())
    options = CalibrationOptions(fix=fix, target_free=True, imu_noise=imu_noise(run))
    record = feed(run, CalibratorSubject(options, prior, None), until_s=33.0)
    assert len(record.snapshots) > 20
    assert not [e for _, e in record.events if e.kind is EventKind.STAMP_JITTER]


def at_rest(rig, *pauses):
    return replace(rig, trajectory=rig.trajectory.with_pauses(pauses))


def test_good_stamps_are_believed(followed):
    _, subject, record = followed
    assert subject.calibrator.evaluator.jitter_s == 0.0
    assert not [e for _, e in record.events if e.kind is EventKind.STAMP_JITTER]


@pytest.mark.parametrize("seed", [27, 31])
def test_gross_outliers_and_broken_tracks_never_bend_an_answer(seed):
    run = simulated(seed=seed, seconds=16.0, outlier_fraction=0.03, missing_fraction=0.1)
    record = feed(run, subject_for(run))
    assert record.snapshots
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-5, 7), shot.t_s


@pytest.mark.parametrize("seed", [1, 2])
def test_starts_while_three_tenths_of_the_features_move(seed):
    run = simulated(seed=seed, seconds=9.0, moving_fraction=0.3)
    record = feed(run, subject_for(run))
    assert record.started_s() <= 7.0
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-5, 7), shot.t_s


@pytest.mark.parametrize(("seed", "rate_dps"), [(1, 8.0), (2, 10.0), (4, 10.0)])
def test_starts_in_slow_motion(seed, rate_dps):
    """A time shift known to 1 ms had been waited for, and windows had not settled along a curved valley."""
    rig = reference_rig(seed, mean_rate_dps=rate_dps, timeshift_cam_imu_s=-0.03)
    record = feed(run := simulate_tracks(seed, 12.0, rig=rig, camera_rate_hz=10.0), subject_for(run))
    assert record.started_s() <= 10.0
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-3, 7), shot.t_s


def test_a_window_far_from_settled_throws_no_good_observations_out():
    # a lens that nearly folds at the corners, roughly known: windows stop far from the truth with a quarter
    # of the good observations refused, and small sigmas (seed 2 of `benchmarks zoo --target-free`)
    run, _ = draw(2, 25.0, target_free=True)
    run.frames[:] = [f for f in run.frames if f.t_s < 4.7]
    prior = camera_prior(run, 2, StartErrors(0.03, 0.01 * run.rig.lens.resolution[0]), exact_lens=False)
    options = CalibrationOptions(target_free=True, imu_noise=imu_noise(run))
    for shot in feed(run, CalibratorSubject(options, prior, None)).snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-5, 7), shot.t_s


def test_features_at_the_horizon_hold_up_no_window():
    """Noise puts half of them beyond infinity, where no landmark may be."""
    rig = reference_rig(11, timeshift_cam_imu_s=0.01)
    near, way = room_landmarks(11, 150), np.random.default_rng(11).standard_normal((75, 3))
    far = 5e3 * way / np.linalg.norm(way, axis=1, keepdims=True)
    run = simulate_tracks(11, 14.0, rig=rig, camera_rate_hz=10.0, landmarks_m=np.concatenate([near, far]))
    record = feed(run, subject_for(run))
    assert record.snapshots[-1].status == "converged"
    assert not any(e.kind is EventKind.WENT_ON for _, e in record.events)
    last = record.snapshots[-1]
    assert nees(last.error, last.covariance, 7) < chi2.isf(1e-4, 7)


def test_says_what_the_commands_promise(followed):
    run, subject, _ = followed
    estimate = subject.calibrator.estimate()
    json.dumps(estimate.to_json())
    camera = estimate.cameras["cam0"]
    assert camera.corner_sigma_px == pytest.approx(run.options.corner_sigma_px, rel=0.1)
    assert camera.intrinsics_sigma == [0.0] * 4
    bias = np.array(estimate.imu.gyro_bias_rps) - run.rig.gyro_bias.value(run.duration_s)
    assert np.all(np.abs(bias) < 5 * np.array(estimate.imu.gyro_bias_sigma_rps))
    assert estimate.frames == len(run.frames)


def test_metric_scale_and_the_direction_of_gravity_are_right_within_their_sigmas(followed):
    run, subject, _ = followed
    carry = subject.calibrator.latest
    base_s = (int(run.t_imu_ns[0]) - run.options.epoch_ns) * 1e-9
    t = np.array([carry.t_cam_s + carry.camera.timeshift_s + base_s])
    R, v = run.rig.trajectory.R_world_imu(t)[0], run.rig.trajectory.v_world_imu(t)[0]
    g = run.rig.gravity_world_mps2
    up = -R.T @ g / np.linalg.norm(g)  # in the imu frame, which is what can be known
    tilt = np.cross(carry.R[2], up)
    P = carry.covariance()
    assert np.linalg.norm(tilt) < 4.0 * np.sqrt(np.trace(P[:2, :2]))
    assert np.sqrt(np.trace(P[:2, :2])) < np.deg2rad(0.1)
    # the speed in metres: scale from the accelerometer alone
    error = carry.speed - R.T @ v
    assert error @ np.linalg.solve(P[2:5, 2:5], error) < chi2.isf(1e-3, 3)
    assert np.sqrt(np.trace(P[2:5, 2:5])) < 0.02 * np.linalg.norm(v) + 5e-3


@pytest.mark.parametrize(("model", "sixth_power"), [("radtan", 0.0), ("plumb_bob", 0.05)])
def test_the_lens_is_found_too(model, sixth_power):
    plain = reference_rig(6, timeshift_cam_imu_s=-0.03)
    rig = replace(plain, lens=replace(plain.lens, sixth_power=sixth_power))
    run = simulate_tracks(6, 8.0, rig=rig, camera_rate_hz=10.0)
    record = feed(run, subject_for(run, lens_known=False, seed=6, model=model))
    last = record.snapshots[-1]
    unknowns = len(last.error)
    assert unknowns == 11 + len(COEFFICIENTS[model])
    assert nees(last.error, last.covariance, unknowns) < chi2.isf(1e-4, unknowns)
    assert np.abs(last.error[7:9]).max() < 2.0  # px, from five percent


def test_a_term_that_the_lens_model_lacks_is_announced_and_in_the_sigmas():
    plain = reference_rig(6, timeshift_cam_imu_s=-0.03)
    rig = replace(plain, lens=replace(plain.lens, sixth_power=0.15))
    run = simulate_tracks(6, 13.0, rig=rig, camera_rate_hz=10.0)
    subject = subject_for(run, lens_known=False, seed=6)
    record = feed(run, subject)
    assert [e.kind for _, e in record.events] == [EventKind.LENS_TERM_MISSING]
    assert subject.calibrator.estimate().cameras["cam0"].distortion_model == "radtan"
    last = record.snapshots[-1]
    assert nees(last.error, last.covariance, 15) < chi2.isf(1e-3, 15)


def test_a_fixed_lens_that_is_not_this_cameras_is_announced_and_its_errors_are_in_the_sigmas():
    run = simulated(seed=1, seconds=12.0)
    subject = subject_for(run)
    prior = camera_prior(run, 1, StartErrors(), exact_lens=True)
    fx, fy, cx, cy = prior.intrinsics
    prior = replace(prior, intrinsics=(1.01 * fx, 1.01 * fy, cx - 8.0, cy + 4.0), readout_s=0.0)
    record = feed(run, CalibratorSubject(subject.calibrator.options, prior, None))
    assert EventKind.FIXED_LENS in {event.kind for _, event in record.events}
    last = record.snapshots[-1]
    assert nees(last.error, last.covariance, 7) < chi2.isf(1e-3, 7)
    assert last.status == "converging"
    assert "the fixed lens of cam0 is not this camera's: estimate it" in record.statuses[-1][2]


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_a_rolling_shutter_of_which_nothing_was_said_is_found_and_told(axis):
    rig = reference_rig(2, timeshift_cam_imu_s=0.01, readout_s=0.02, readout_axis=axis)
    run = simulate_tracks(2, 8.0, rig=rig, camera_rate_hz=20.0)
    subject = subject_for(run, lens_known=False)
    record = feed(run, subject)
    assert any(e.kind is ROLLING[axis] and e.camera == "cam0" for _, e in record.events)
    for snapshot in record.snapshots:
        assert nees(snapshot.error, snapshot.covariance, 7) < chi2.isf(1e-4, 7)
    camera = subject.calibrator.estimate().cameras["cam0"]
    assert 0.0 < camera.readout_sigma_s < 5e-4
    assert abs(camera.readout_s - 0.02) < 4.0 * camera.readout_sigma_s


def test_nothing_is_told_of_the_readout_of_a_global_shutter(followed):
    _, subject, record = followed
    assert not any(e.kind in ROLLING.values() for _, e in record.events)
    camera = subject.calibrator.estimate().cameras["cam0"]
    assert camera.readout_s == camera.readout_sigma_s == 0.0


def test_waits_through_darkness_and_goes_on_with_what_it_knew():
    run = simulated(seed=5, seconds=15.0)
    run.frames[:] = [f for f in run.frames if not 7.0 < f.t_s < 10.5]
    subject = subject_for(run)
    record = feed(run, subject)
    dark = record.at(10.0)
    before = record.at(8.0)
    np.testing.assert_allclose(np.delete(dark.error, 6), np.delete(before.error, 6), rtol=1e-6, atol=1e-12)
    assert abs(dark.error[6] - before.error[6]) < np.sqrt(dark.covariance[6, 6])  # clocks may run apart
    assert any(e.kind is EventKind.WENT_ON for _, e in record.events)
    last = record.snapshots[-1]
    assert nees(last.error, last.covariance, 7) < chi2.isf(1e-4, 7)
    assert np.trace(last.covariance[:3, :3]) < np.trace(dark.covariance[:3, :3])


def test_after_a_change_of_the_rig_its_clock_is_judged_anew():
    evaluator = TargetFreeStatus(CalibrationOptions(target_free=True), window_layout())
    evaluator.models.drifting = True
    evaluator.changed()
    assert not evaluator.models.drifting


def test_a_drifting_clock_is_followed_also_over_darkness():
    run = simulate_tracks(
        6, 24.0, rig=reference_rig(6, timeshift_cam_imu_s=0.01, clock_skew_ppm=100.0), camera_rate_hz=10.0
    )
    run.frames[:] = [f for f in run.frames if not 12.0 < f.t_s < 15.0]
    record = feed(run, subject_for(run))
    assert any(e.kind is EventKind.CLOCK_DRIFT for _, e in record.events)
    late = [shot for shot in record.snapshots if shot.t_s > 10.0]
    assert len(late) > 5
    for shot in late:
        assert abs(shot.error[6]) < 4.0 * np.sqrt(shot.covariance[6, 6]), shot.t_s
    assert abs(late[-1].error[6]) < 2e-4  # 0.4 ms of drift in the darkness alone


def test_standing_still_gives_no_answer_and_says_what_to_do():
    rig = looking(2, still)
    run = simulate_tracks(2, 20.0, rig=rig, camera_rate_hz=5.0, imu_rate_hz=50.0)
    record = feed(run, subject_for(run))
    assert record.snapshots == []
    assert record.statuses[-1][1] == "degenerate"
    assert record.statuses[-1][2] == "the rig is at rest: move it to and fro while turning it"
    assert "turn it back and forth" in record.guidance


def test_in_motion_too_slow_for_an_answer_no_mounting_is_looked_for(monkeypatch):
    """At 1 deg/s every one of 600 mountings at 5 time shifts fits; each attempt took a second to see that."""
    run = simulate_tracks(4, 8.0, rig=reference_rig(4, mean_rate_dps=1.0), camera_rate_hz=10.0)
    monkeypatch.setattr(target_free_initializer, "likely_mountings", lambda *_: pytest.fail("looked for"))
    record = feed(run, subject_for(run))
    assert not record.snapshots
    assert "no motion" in record.statuses[-1][2] or "stands still" in record.statuses[-1][2]


@pytest.mark.parametrize("seed", [42, 405], ids=["features soon lost", "narrow lens"])
def test_rays_that_cross_by_a_quarter_of_a_degree_calibrate_a_camera_that_sees_that_well(seed):
    run, _ = draw(seed, 9.0, target_free=True)
    record = feed(run, subject_for(run))
    assert record.snapshots[0].t_s < 6.0
    last = record.snapshots[-1]
    sigma = np.sqrt(np.diag(last.covariance))[:7]
    assert sigma[:3].max() < 10e-3
    assert np.abs(last.error[:7] / sigma).max() < 4.0


def test_where_everything_is_far_away_there_is_no_answer_and_it_says_why():
    miles = room_landmarks(4, near_m=3e3, far_m=30e3)
    run = simulated(landmarks_m=miles)
    record = feed(run, subject_for(run), until_s=6.5)  # four attempts; each takes longer than the one before
    assert not record.snapshots
    reasons = {reason for _, _, reason in record.statuses}
    assert any("everything is far away, or features are lost before" in reason for reason in reasons)


def test_two_images_a_second_whose_stamps_jitter_are_no_gaps():
    """They ended as `collecting the first seconds`: every second interval was longer than half a second."""
    rig = reference_rig(4, timeshift_cam_imu_s=-0.03)
    run = simulate_tracks(4, 24.0, rig=rig, camera_rate_hz=2.0, stamp_jitter_s=2e-4)
    record = feed(run, subject_for(run))
    assert record.snapshots[-1].status == "converged" and record.started_s() <= 12.0
    assert all(nees(shot.error, shot.covariance, 7) < chi2.isf(1e-4, 7) for shot in record.snapshots)


def test_a_scene_with_too_few_features_is_told():
    """A lens of 12 degrees sees a few of them: 25 s of `collecting the first seconds`."""
    run = simulated(seconds=8.0)
    few = [replace(f, ids=f.ids[:5], uv_px=f.uv_px[:5]) for f in run.frames]
    record = feed(replace(run, frames=few), subject_for(run))
    assert record.statuses[-1][2].startswith("most images show only 5 features, fewer than 12: ")


def test_one_axis_is_never_called_converged():
    rig = looking(3, one_axis, 3, [0.3, 1.0, 0.2])
    run = simulate_tracks(3, 20.0, rig=rig, camera_rate_hz=8.0)
    record = feed(run, subject_for(run))
    assert "converged" not in {status for _, status, _ in record.statuses}
    assert record.statuses[-1][1] in ("degenerate", "converging", "initialising")
    assert record.statuses[-1][2] or record.guidance


def test_order_strangers_and_nonsense_are_only_counted():
    run = simulated(seconds=1.0)
    calibrator = subject_for(run).calibrator
    frame = points_frame(run.frames[3])
    calibrator.add_points(frame)
    calibrator.add_imu(int(run.t_imu_ns[0]), [0.0, 0.0, np.nan], [0.0, 0.0, 9.8])
    calibrator.add_imu(int(run.t_imu_ns[0]), [0.0, 0.0, 0.0], [0.0, 0.0, 9.8])
    calibrator.add_points(points_frame(run.frames[3], camera="other"))
    calibrator.add_points(frame)
    calibrator.add_points(frame)
    assert calibrator.process() == []
    left_out = calibrator.left_out
    assert (left_out["images_ignored"], left_out["imu_refused"]) == (3, 1)
    assert calibrator.estimate().cameras == {}


def test_two_cameras_are_for_a_rig_of_them():
    priors = {name: CameraPrior((640, 480)) for name in ("a", "b")}
    with pytest.raises(ValueError, match="one camera"):
        TargetFreeCalibrator(CalibrationOptions(target_free=True), priors)


@pytest.mark.parametrize(("seed", "shift_s"), [(4, -5.0), (6, 4.5)])
def test_a_time_shift_of_seconds_is_found_about_the_one_that_is_given(seed, shift_s):
    """Searched about zero: `too few features are followed`, or rotations that do not agree in direction."""
    subject = subject_for(run := simulated(seed, shift_s=shift_s), seed=seed, shift_s=shift_s + 0.4)
    record = feed(run, subject)
    assert record.snapshots[-1].status in ("converged", "converging")
    assert abs(record.snapshots[-1].error[6]) < 1e-3
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-4, 7), shot.t_s
