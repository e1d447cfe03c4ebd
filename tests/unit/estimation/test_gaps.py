"""Gaps, frozen sensors and clocks that are set: the motion is found anew, the calibration is kept."""

import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.points import simulate
from vical_mocks.rig import Bump, reference_rig

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.init.motion_restart import MotionRestart
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.result import Status

BEGIN_S, END_S, RATE_HZ = 14.0, 22.0, 10.0
COMMON_S = BEGIN_S - 0.5
BACK_S = 3.0  # after a disturbance all must be as before


@pytest.fixture(scope="module")
def run():
    return simulate(5, END_S, timeshift_cam_imu_s=-0.035, camera_rate_hz=RATE_HZ)


def stream(run):
    """(true time s, kind, stamp ns, content) in order of arrival."""
    epoch = run.options.epoch_ns
    items = [
        ((int(t) - epoch) * 1e-9, 0, int(t), (w, f))
        for t, w, f in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True)
    ]
    items += [(f.t_s, 1, f.t_cam_ns, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px)) for f in run.frames]
    return sorted(items, key=lambda item: item[:2])


def calibrate(run, change=lambda items: items, so_far=None, until_s=END_S):
    """Feed a recording, or what follows `COMMON_S`; the last estimate, all events, and all estimates."""
    c, events, shots = pickle.loads(so_far) if so_far else (calibrator(run), [], [])
    items = change([x for x in stream(run) if x[0] < until_s])
    follow(c, events, shots, [x for x in items if x[0] >= COMMON_S] if so_far else items)
    c.finish()
    estimate = c.estimate()
    return estimate, events + estimate.events, shots


def calibrator(run):
    lens = run.rig.lens
    prior = {"cam0": CameraPrior((640, 480), tuple(lens.intrinsics), lens.model, tuple(lens.distortion))}
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=ImuNoise())
    return Calibrator(options, prior, run.points_m)


def follow(c, events, shots, items):
    for n, (t_s, kind, stamp_ns, content) in enumerate(items):
        if kind:
            c.add_points(replace(content, t_cam_ns=stamp_ns))
            c.process()
        else:
            c.add_imu(stamp_ns, *content)
        if n % 20 == 0:
            estimate = c.estimate()
            events += estimate.events
            shots.append((t_s, estimate))


@pytest.fixture(scope="module")
def so_far(run):
    """What all disturbed recordings have in common, followed once."""
    c, events, shots = calibrator(run), [], []
    follow(c, events, shots, [x for x in stream(run) if x[0] < COMMON_S])
    return pickle.dumps((c, events, shots))


@pytest.fixture(scope="module")
def whole(run, so_far):
    """What is known at some time without any disturbance."""
    return cache(lambda until_s: calibrate(run, so_far=so_far, until_s=until_s)[0])


def without(kinds, seconds):
    return lambda items: [x for x in items if not (x[1] in kinds and BEGIN_S <= x[0] < BEGIN_S + seconds)]


def stepped(kind, step_s):
    step_ns = round(step_s * 1e9)
    return lambda items: [
        (t, k, stamp + (step_ns if k == kind and t >= BEGIN_S else 0), x) for t, k, stamp, x in items
    ]


def frozen(kind, seconds):
    def change(items):
        last, out = None, []
        for t, k, stamp, x in items:
            if k == kind and not BEGIN_S <= t < BEGIN_S + seconds:
                last = x
            out.append((t, k, stamp, last if k == kind else x))
        return out

    return change


def sigmas(estimate):
    e = estimate.cameras["cam0"]
    return np.sqrt([*np.diag(e.T_imu_cam.covariance), e.timeshift_sigma_s**2])


def distance_m(a, b):
    return float(
        np.linalg.norm(np.subtract(a.cameras["cam0"].T_imu_cam.p_m, b.cameras["cam0"].T_imu_cam.p_m))
    )


STARTS = {EventKind.BUMPED, EventKind.STARTED_OVER, EventKind.STARTED_ANEW}
CHANGES = {*STARTS, EventKind.POSE_LOST, EventKind.TIMESHIFT_STEPPED, EventKind.STAMPS_STEPPED}


def before(shots):
    return [e for t, e in shots if t < BEGIN_S][-1]


@pytest.mark.parametrize(
    ("kinds", "seconds", "said"),
    [
        ((0,), 0.1, EventKind.IMU_GAP),
        ((0,), 2.0, EventKind.IMU_GAP),
        ((1,), 2.0, EventKind.IMAGE_GAP),
        ((0, 1), 1.0, EventKind.IMU_GAP),
        ((0, 1), 5.0, EventKind.IMU_GAP),
    ],
    ids=["imu 0.1 s", "imu 2 s", "camera 2 s", "both 1 s", "both 5 s"],
)
def test_a_gap_costs_the_motion_and_not_the_calibration(run, so_far, whole, kinds, seconds, said):
    until_s = BEGIN_S + seconds + BACK_S
    estimate, events, shots = calibrate(run, without(kinds, seconds), so_far, until_s)
    (gap,) = (e for e in events if e.kind is said)
    own = [t for t, kind, *_ in without(kinds, seconds)(stream(run)) if kind == kinds[0]]
    assert gap.value == pytest.approx(np.max(np.diff(own)), abs=0.05)
    assert not CHANGES & {e.kind for e in events}
    assert estimate.status == Status.CONVERGED
    assert all(e.status == Status.CONVERGED for t, e in shots if t > BEGIN_S + seconds + 2.0)
    grown = sigmas(before(shots))
    if seconds > 2.0:  # a clock may have drifted meanwhile, by what was known of it
        grown[6] = np.hypot(grown[6], seconds * 3e-6)
    assert all(np.all(sigmas(e) < 1.02 * grown) for t, e in shots if t > BEGIN_S)
    assert distance_m(estimate, whole(until_s)) < 3e-4


@pytest.mark.parametrize(
    ("kind", "seconds", "said"),
    [(0, 1.0, EventKind.IMU_REPEATED), (1, 3.0, EventKind.IMAGE_REPEATED)],
    ids=["imu", "camera"],
)
def test_a_frozen_sensor_is_a_gap(run, so_far, whole, kind, seconds, said):
    until_s = BEGIN_S + seconds + BACK_S
    estimate, events, _ = calibrate(run, frozen(kind, seconds), so_far, until_s)
    assert [e.kind for e in events].count(said) == 1
    assert not CHANGES & {e.kind for e in events}
    assert estimate.status == Status.CONVERGED
    assert distance_m(estimate, whole(until_s)) < 3e-4


@pytest.mark.parametrize("step_s", [0.02, -0.02, 0.5, -0.5, 3600.0, -3600.0])
@pytest.mark.parametrize("kind", [0, 1], ids=["imu", "camera"])
def test_a_clock_that_is_set_moves_the_time_shift_alone(run, so_far, whole, kind, step_s):
    until_s = BEGIN_S + 5.0  # where images were lost while the time shift was sought
    estimate, events, _ = calibrate(run, stepped(kind, step_s), so_far, until_s)
    shift_s = run.rig.timeshift_cam_imu_s + (step_s if kind == 0 else -step_s)
    e = estimate.cameras["cam0"]
    assert not STARTS & {e.kind for e in events}
    assert estimate.status == Status.CONVERGED
    assert distance_m(estimate, whole(until_s)) < 3e-4
    assert abs(e.timeshift_cam_imu_s - shift_s) < 4.5 * e.timeshift_sigma_s
    assert e.timeshift_sigma_s < 3e-4


def test_a_gap_while_starting_delays_the_start_and_no_more(run):
    def change(items):
        return [x for x in items if not 2.0 <= x[0] < 3.0]

    estimate, events, _ = calibrate(run, change, until_s=16.0)
    e = estimate.cameras["cam0"]
    truth = run.truth()["cameras"]["cam0"]
    error = np.subtract(e.T_imu_cam.p_m, truth["T_imu_cam"]["p_m"]) / sigmas(estimate)[:3]
    assert [round(e.value, 1) for e in events if e.kind is EventKind.IMU_GAP] == [1.0]
    assert estimate.status == Status.CONVERGED
    assert np.abs(error).max() < 4.5


def test_a_bump_inside_a_gap_is_announced_soon_after_it():
    rig = reference_rig(6, bumps=(Bump(BEGIN_S + 1.0, (0.02, 0.02, -0.02), (0.006, -0.006, 0.006)),))
    bumped = simulate(6, BEGIN_S + 7.0, rig=rig, camera_rate_hz=RATE_HZ)
    _, events, shots = calibrate(bumped, without((0, 1), 3.0))
    when = [t for t, e in shots if any(x.kind is EventKind.BUMPED for x in e.events)]
    assert sum(e.kind is EventKind.BUMPED for e in events) == 1
    assert BEGIN_S + 3.0 < when[0] < BEGIN_S + 6.0


@pytest.mark.parametrize("seed", [2, 3])
def test_a_camera_that_was_moved_inside_a_gap_is_not_believed_where_it_was(seed):
    """The motion after the gap is taken with the old mounting and hides the move: 7 to 10 sigma, no bump."""
    move_m = np.array([[-6e-3, 5e-3, 6e-3], [5e-3, 6e-3, -6e-3]])[seed - 2]
    rig = reference_rig(seed, bumps=(Bump(BEGIN_S + 1.0, translation_m=tuple(move_m.tolist())),))
    moved = simulate(seed, BEGIN_S + 16.0, rig=rig, camera_rate_hz=20.0)
    _, events, shots = calibrate(moved, without((0, 1), 10.0), until_s=BEGIN_S + 16.0)
    far = []
    for t_s, e in shots:
        if t_s > BEGIN_S + 10.0 + BACK_S and e.status is Status.CONVERGED:
            camera = e.cameras["cam0"].T_imu_cam
            off_m = np.subtract(camera.p_m, rig.p_imu_cam + move_m)
            far.append(float(np.abs(off_m / np.sqrt(np.diag(camera.covariance))[:3]).max()))
    assert sum(e.kind is EventKind.BUMPED for e in events) == 1
    assert max(far, default=0.0) < 5.0


def test_two_cameras_go_on_together_after_a_gap(run):
    lens = run.rig.lens
    prior = CameraPrior((640, 480), tuple(lens.intrinsics), lens.model, tuple(lens.distortion))
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=ImuNoise())
    c = Calibrator(options, {"cam0": prior, "cam1": prior}, run.points_m)
    rng, events = np.random.default_rng(0), []
    for n, (t_s, kind, stamp_ns, content) in enumerate(without((0, 1), 1.0)(stream(run))):
        if t_s > BEGIN_S + 1.0 + BACK_S:
            break
        if kind:
            c.add_points(content)
            c.add_points(replace(content, camera="cam1", uv_px=content.uv_px + 0.2 * rng.standard_normal(2)))
            c.process()
        else:
            c.add_imu(stamp_ns, *content)
        if n % 50 == 0:
            events += c.estimate().events
    c.finish()
    assert not any(e.kind is EventKind.BUMPED for e in events)
    assert c.estimate().status == Status.CONVERGED


def test_a_camera_whose_clock_is_set_just_before_it_dies_does_not_hold_up_the_other(run):
    lens = run.rig.lens
    prior = CameraPrior((640, 480), tuple(lens.intrinsics), lens.model, tuple(lens.distortion))
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=ImuNoise())
    c = Calibrator(options, {"cam0": prior, "cam1": prior}, run.points_m)
    left = 3  # images of it, from then on
    for t_s, kind, stamp_ns, content in stream(run):
        if not kind:
            c.add_imu(stamp_ns, *content)
            continue
        if t_s > BEGIN_S and left == 3:
            c.process()
            c._clock_was_set("cam1")
        if t_s < BEGIN_S or left:
            c.add_points(replace(content, camera="cam1"))
            left -= t_s > BEGIN_S
        elif t_s > BEGIN_S + 1.0:
            c.do_without(frozenset({"cam1"}))
        c.add_points(content)
        c.process()
    c.finish()
    assert c.filter is not None
    assert c.filter.state.t_s > END_S - 0.5


def test_the_motion_found_anew_is_the_true_one(run, so_far):
    c, events, shots = pickle.loads(so_far)
    follow(c, events, shots, [x for x in stream(run) if COMMON_S <= x[0] < BEGIN_S + BACK_S])
    f, base_s = c.filter, (int(run.t_imu_ns[0]) - run.options.epoch_ns) * 1e-9
    restart = MotionRestart(run.points_m, {})
    frames = [x for x in run.frames if BEGIN_S + BACK_S - 1.5 < x.t_s < BEGIN_S + BACK_S - 0.5][:5]
    for x in frames:
        t_cam_s = (x.t_cam_ns - int(run.t_imu_ns[0])) * 1e-9
        restart.take(PointsFrame("cam0", x.t_cam_ns, x.ids, x.uv_px), t_cam_s, f.state, c._buffer)
    motion = restart.motion(f, c._buffer)
    tau = np.array([motion.t_s + base_s])
    truth = run.rig.trajectory
    turn = np.arccos(np.clip((np.trace(truth.R_world_imu(tau)[0].T @ motion.R_world_imu) - 1) / 2, -1, 1))
    assert turn < 0.3 * motion.sigmas[0]
    assert np.abs(truth.p_world_imu(tau)[0] - motion.p_world_imu).max() < 0.5 * motion.sigmas[3]
    assert np.abs(truth.v_world_imu(tau)[0] - motion.v_world_imu).max() < motion.sigmas[6]


def test_motion_before_a_board_that_was_turned_is_by_gravity_in_its_new_frame(run, so_far):
    """Gravity off by 20 deg is up to 1 m/s of velocity over 0.6 s."""
    turn = Rotation.from_rotvec([0.2, -0.25, 0.12]).as_matrix()
    points_m = run.points_m @ turn.T
    turned = simulate(
        5, BEGIN_S + BACK_S, timeshift_cam_imu_s=-0.035, points_m=points_m, camera_rate_hz=RATE_HZ
    )
    c, events, shots = pickle.loads(so_far)
    images_end_s = BEGIN_S + 1.0
    items = [x for x in stream(run) if COMMON_S <= x[0] < BEGIN_S + BACK_S]
    follow(c, events, shots, [x for x in items if x[1] == 0 or x[0] < images_end_s])
    restart = MotionRestart(run.points_m, {}, jumped=True)
    for x in [x for x in turned.frames if images_end_s <= x.t_s < BEGIN_S + BACK_S - 0.5][::4][:4]:
        t_cam_s = (x.t_cam_ns - int(run.t_imu_ns[0])) * 1e-9
        restart.take(PointsFrame("cam0", x.t_cam_ns, x.ids, x.uv_px), t_cam_s, c.filter.state, c._buffer)
    motion = restart.motion(c.filter, c._buffer)
    tau = np.array([motion.t_s + (int(run.t_imu_ns[0]) - run.options.epoch_ns) * 1e-9])
    expected = turn.T @ run.rig.trajectory.v_world_imu(tau)[0]
    assert np.abs(expected - motion.v_world_imu).max() < 0.3 * motion.sigmas[6]


def test_images_that_hardly_show_the_pose_begin_no_motion_until_better_ones_come(run, so_far):
    """A corner of the board, where innovations have shown that the images of the camera are off by more."""
    c, events, shots = pickle.loads(so_far)
    follow(c, events, shots, [x for x in stream(run) if COMMON_S <= x[0] < BEGIN_S + BACK_S])
    f = c.filter
    f.consistency["cam0"].scale, f.consistency["cam0"].factor = 12.0, 6.0
    frames = [x for x in run.frames if BEGIN_S < x.t_s < BEGIN_S + BACK_S - 0.5]

    def collected(images, ids):
        restart = MotionRestart(run.points_m, {})
        for x in images:
            seen = np.isin(x.ids, ids)
            t_cam_s = (x.t_cam_ns - int(run.t_imu_ns[0])) * 1e-9
            restart.take(
                PointsFrame("cam0", x.t_cam_ns, x.ids[seen], x.uv_px[seen]), t_cam_s, f.state, c._buffer
            )
        return restart

    corner, everything = [0, 1, 2, 3, 9, 10, 11, 12], np.arange(len(run.points_m))
    few = collected(frames[:10], corner)
    assert len(few.frames) >= 3
    assert few.motion(f, c._buffer) is None
    late = collected(frames, corner)
    assert late.motion(f, c._buffer).sigmas[0] > 0.03
    whole = collected(frames[:10], everything)
    assert whole.motion(f, c._buffer).sigmas[0] == pytest.approx(0.03)


@pytest.fixture(scope="module")
def before_a_step():
    c, events, shots = calibrator(run := simulate(141, BEGIN_S + 6.0)), [], []
    follow(c, events, shots, [x for x in stream(run) if x[0] < COMMON_S])
    return pickle.dumps((c, events, shots))


@pytest.mark.parametrize("step_s", [2e-3, 5e-3])
def test_a_step_of_milliseconds_is_a_step_and_no_bump(before_a_step, step_s):
    rig = reference_rig(141, bumps=(Bump(BEGIN_S, timeshift_s=step_s),))
    stepped = simulate(141, BEGIN_S + 6.0, rig=rig)
    estimate, events, _ = calibrate(stepped, so_far=before_a_step)
    found = [e for e in events if e.kind is EventKind.TIMESHIFT_STEPPED]
    assert not any(
        e.kind in (EventKind.BUMPED, EventKind.STARTED_OVER, EventKind.CLOCK_WANDER) for e in events
    )
    assert [e.value for e in found] == pytest.approx([step_s], abs=3e-4)
    cam = estimate.cameras["cam0"]
    assert abs(cam.timeshift_cam_imu_s - rig.timeshift_cam_imu_s - step_s) < 4.0 * cam.timeshift_sigma_s


@pytest.mark.parametrize(("every", "widened"), [(1, 1), (6, 0)], ids=["10 Hz", "1.7 Hz"])
def test_motion_is_less_certain_after_a_gap_than_errors_that_last_make_it(run, monkeypatch, every, widened):
    """Not at the usual interval of a slow camera, though it is as long as a gap of another."""
    sigmas = []

    def doubt_motion(f):
        f.consistency["cam0"].factor = 4.0
        before = f.sigmas()
        widen(f)
        sigmas.append(f.sigmas() / before)

    widen = CalibrationFilter.doubt_motion
    monkeypatch.setattr(CalibrationFilter, "doubt_motion", doubt_motion)

    def change(items):
        images = [x for x in items if x[1]]
        gone = {x[2] for k, x in enumerate(images) if k % every or 17.0 < x[0] < 18.0}
        return [x for x in items if x[2] not in gone or not x[1]]

    estimate, events, _ = calibrate(run, change)
    assert [round(float(s[3]), 6) for s in sigmas] == [2.0] * widened and estimate.cameras
    for s in sigmas:
        np.testing.assert_allclose(s, [2.0] * 9 + [1.0] * (len(s) - 9), rtol=1e-6)
    assert [e.kind for e in events] == [EventKind.IMAGE_GAP] * widened
