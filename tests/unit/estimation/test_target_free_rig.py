"""Several cameras without a target: each as if it were alone, and one answer for all."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from vical_mocks.harness.feed import StartErrors, camera_prior, imu_noise, points_frame
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.guidance import Guidance, Verb
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.estimation.target_free_rig import TargetFreeRig, together
from vical_daemon.estimation.wording import guidance_text


@pytest.fixture(scope="module")
def pair():
    """One imu and two cameras that look to different sides, stamped by clocks of their own."""
    left = reference_rig(8, timeshift_cam_imu_s=0.02)
    turn = Rotation.from_rotvec([0.0, 0.4, 0.1]).as_matrix()
    right = replace(
        left,
        R_imu_cam=left.R_imu_cam @ turn,
        p_imu_cam=left.p_imu_cam + np.array([0.0, -0.11, 0.01]),
        timeshift_cam_imu_s=-0.035,
    )
    runs = {
        name: simulate_tracks(8, 13.0, rig=rig, camera_rate_hz=rate)
        for name, rig, rate in (("left", left, 10.0), ("right", right, 8.0))
    }
    np.testing.assert_array_equal(runs["left"].gyro_rps, runs["right"].gyro_rps)
    return runs


def rig_of(runs):
    first = next(iter(runs.values()))
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), target_free=True, imu_noise=imu_noise(first))
    priors = {name: camera_prior(run, 8, StartErrors(), exact_lens=True) for name, run in runs.items()}
    return TargetFreeRig(options, priors)


def play(rig, runs, blind=()):
    """Push everything in by its stamp; returns reports and events."""
    first = next(iter(runs.values()))
    frames = [
        points_frame(f, camera=name) for name, run in runs.items() for f in run.frames if name not in blind
    ]
    reports, events, k = [], [], 0
    for frame in sorted(frames, key=lambda f: f.t_cam_ns):
        while k < len(first.t_imu_ns) and first.t_imu_ns[k] < frame.t_cam_ns + 150_000_000:
            rig.add_imu(int(first.t_imu_ns[k]), first.gyro_rps[k], first.specific_force_mps2[k])
            k += 1
        rig.add_points(frame)
        reports += rig.process()
        events += rig.estimate().events
    return reports + rig.finish(), events


@pytest.fixture(scope="module")
def played(pair):
    rig = rig_of(pair)
    return (rig, *play(rig, pair))


def test_both_cameras_are_found_within_their_sigmas(pair, played):
    estimate = played[0].estimate()
    assert estimate.status == Status.CONVERGED
    assert set(estimate.cameras) == {"left", "right"}
    for name, run in pair.items():
        camera = estimate.cameras[name]
        w, *v = camera.T_imu_cam.q_wxyz
        R = Rotation.from_quat([*v, w]).as_matrix()
        e = np.concatenate(
            [
                camera.T_imu_cam.p_m - run.rig.p_imu_cam,
                Rotation.from_matrix(run.rig.R_imu_cam.T @ R).as_rotvec(),
            ]
        )
        assert e @ np.linalg.solve(np.array(camera.T_imu_cam.covariance), e) < chi2.isf(1e-4, 6)
        late = camera.timeshift_cam_imu_s - run.rig.timeshift_cam_imu_s
        assert abs(late) < 4.0 * camera.timeshift_sigma_s


def test_each_is_calibrated_as_if_it_were_alone(pair, played):
    alone = rig_of({"right": pair["right"]})
    play(alone, {"right": pair["right"]})
    a, b = (rig.estimate().cameras["right"] for rig in (alone, played[0]))
    assert a.T_imu_cam == b.T_imu_cam
    assert a.timeshift_cam_imu_s == b.timeshift_cam_imu_s


def test_reports_and_counts_are_of_all_images(pair, played):
    rig, reports, _ = played
    assert {r.camera for r in reports} == {"left", "right"}
    estimate = rig.estimate()
    assert estimate.frames == sum(len(run.frames) for run in pair.values())
    assert estimate.imu_samples == rig.parts["left"].estimate().imu_samples
    assert 0.3 < estimate.nis_per_dof < 3.0


def test_a_blind_camera_holds_up_no_other_and_is_named(pair):
    rig = rig_of(pair)
    play(rig, pair, blind=("right",))
    estimate = rig.estimate()
    assert estimate.status == Status.WAITING
    assert estimate.reason.startswith("right: no features")
    assert set(estimate.cameras) == {"left"}


def test_a_camera_that_is_not_connected_is_not_waited_for(pair, played):
    rig = rig_of(pair)
    rig.do_without(frozenset({"right"}))
    play(rig, pair, blind=("right",))
    estimate = rig.estimate()
    assert estimate.status == Status.CONVERGED and "right" not in estimate.reason
    played[0].do_without(frozenset({"right"}))  # what is known of it stays
    assert set(played[0].estimate().cameras) == {"left", "right"}
    played[0].do_without(frozenset())
    rig.do_without(frozenset())
    assert rig.estimate().status == Status.WAITING


def test_strangers_are_counted_and_no_camera_is_refused(pair):
    rig = rig_of(pair)
    rig.add_points(points_frame(pair["left"].frames[0], camera="rear"))
    assert rig.left_out["images_ignored"] == 1
    with pytest.raises(ValueError, match="no camera"):
        TargetFreeRig(CalibrationOptions(target_free=True), {})
    options = CalibrationOptions(target_free=True, estimate=frozenset({"target_scale"}))
    with pytest.raises(ValueError, match="target_scale"):
        TargetFreeRig(options, {"a": CameraPrior((640, 480)), "b": CameraPrior((640, 480))})


def test_announcements_bear_the_name_of_their_camera():
    def said(*events):
        return CalibrationEstimate(
            1, Status.CONVERGED, "", 1.0, "", 1.0, 5, 9, {}, None, [], 1.0, 0.0, list(events)
        )

    gap, bump = Event(EventKind.IMU_GAP, value=2.0), Event(EventKind.BUMPED, "a")
    lags = [Event(EventKind.ACCEL_LAG, value=v) for v in (1e-4, 2e-4)]
    jitter = Event(EventKind.STAMP_JITTER, "b2", 1e-3)
    both = together({"a": said(gap, bump, lags[0]), "b2": said(replace(gap, t_s=1.0), lags[1], jitter)})
    named = [replace(lag, camera=name) for lag, name in zip(lags, ("a", "b2"), strict=True)]
    assert both.events == [gap, bump, named[0], named[1], jitter]


def test_of_several_cameras_the_one_whose_axes_are_to_be_turned_about_is_named():
    value = CalibrationEstimate(1, Status.CONVERGING, "", 0.5, "", 1.0, 5, 9, {}, None, [], 1.0, 0.0, [])
    turn = Guidance(Verb.TURN, ("x",))
    behind = replace(value, guidance=guidance_text(turn), next_motion=turn)
    both = together({"a": value, "b": behind})
    assert both.next_motion == replace(turn, camera="b")
    assert both.guidance == "rotate about the image's x axis (nod) of b"
    assert together({"b": behind}) == behind
