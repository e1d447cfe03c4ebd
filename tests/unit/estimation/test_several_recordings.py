"""Several recordings of one rig, one calibration: biases, gravity and motion apart, the rest in common."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from vical_mocks.harness.feed import nees
from vical_mocks.points import SimulatedRun, simulate
from vical_mocks.rig import BiasWalk, nominal_gravity, reference_rig
from vical_mocks.rotations import exp_so3
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.result import Status
from vical_daemon.estimation.target_free import TargetFreeCalibrator

SHIFT_S = 0.01
APART_S = 10.0


def another(seed: int, **changes: object):
    """The same rig on another day: another motion, other biases, and the board leans elsewhere."""
    rng = np.random.default_rng([seed, 7])
    gravity = exp_so3(0.3 * rng.standard_normal(3)) @ nominal_gravity()
    biases = {
        "gyro_bias": BiasWalk(np.deg2rad(1.5) * rng.standard_normal(3), 2e-5, seed),
        "accel_bias": BiasWalk(0.15 * rng.standard_normal(3), 2e-4, seed + 1),
    }
    return reference_rig(
        seed, timeshift_cam_imu_s=SHIFT_S, **({"gravity_world_mps2": gravity} | biases | changes)
    )


def items(run: SimulatedRun, later_s: float = 0.0, begin_s: float = 0.0, end_s: float = np.inf):
    """(stamp in ns, reading or image) by stamp, of a part of a recording, with other stamps."""
    later, epoch = round(later_s * 1e9), run.options.epoch_ns
    out: list = [
        (int(t) + later, (w, f))
        for t, w, f in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True)
    ]
    out += [(f.t_cam_ns + later, f) for f in run.frames]
    part = (x for x in out if begin_s <= (x[0] - later - epoch) * 1e-9 < end_s)
    return sorted(part, key=lambda x: x[0])


def feed(c, stream) -> None:
    for stamp_ns, item in stream:
        if isinstance(item, tuple):
            c.add_imu(stamp_ns, *item)
        else:
            c.add_points(PointsFrame("cam0", stamp_ns, item.ids, item.uv_px))
            c.process()
    c.finish()


def calibrator(run: SimulatedRun, kind=Calibrator, **options):
    lens = run.rig.lens
    prior = {"cam0": CameraPrior((640, 480), tuple(lens.intrinsics), lens.model, tuple(lens.distortion))}
    chosen = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=ImuNoise(), **options)
    return Calibrator(chosen, prior, run.points_m) if kind is Calibrator else kind(chosen, prior)


def alone(run: SimulatedRun):
    c = calibrator(run)
    feed(c, items(run))
    return c.estimate()


def error_and_covariance(estimate, run):
    """Errors [position, rotation, time shift] and their covariance, shapes (7,) and (7, 7)."""
    camera, truth = estimate.cameras["cam0"], run.truth(0.0)["cameras"]["cam0"]
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = camera.T_imu_cam.covariance
    covariance[6, 6] = camera.timeshift_sigma_s**2
    R, R_true = (
        Rotation.from_quat(np.roll(q, -1)) for q in (camera.T_imu_cam.q_wxyz, truth["T_imu_cam"]["q_wxyz"])
    )
    moved = np.subtract(camera.T_imu_cam.p_m, truth["T_imu_cam"]["p_m"])
    shift_s = camera.timeshift_cam_imu_s - truth["timeshift_cam_imu_s"]
    return np.concatenate([moved, (R_true.inv() * R).as_rotvec(), [shift_s]]), covariance


@pytest.fixture(scope="module")
def first() -> SimulatedRun:
    return simulate(10, 16.0, timeshift_cam_imu_s=SHIFT_S, corner_sigma_px=0.3, camera_rate_hz=10.0)


@pytest.fixture(scope="module")
def second() -> SimulatedRun:
    return simulate(1010, 16.0, rig=another(1010), corner_sigma_px=0.3, camera_rate_hz=10.0)


@pytest.fixture(scope="module")
def after_first(first) -> bytes:
    """A calibrator that has seen the first recording, run once; each test goes on from a copy."""
    c = calibrator(first)
    feed(c, items(first))
    return pickle.dumps(c)


def test_two_recordings_tell_as_much_as_both_do(first, second, after_first) -> None:
    c = pickle.loads(after_first)
    assert c.can_go_on
    events = c.estimate().events
    c.next_recording()
    feed(c, items(second, later_s=16.0 + APART_S))
    together = c.estimate()
    assert together.status is Status.CONVERGED
    error, covariance = error_and_covariance(together, first)
    assert nees(error, covariance, 7) < chi2.isf(1e-3, 7)
    ends = (pickle.loads(after_first).estimate(), alone(second))
    one, other = (error_and_covariance(end, first)[1] for end in ends)
    both = np.linalg.inv(np.linalg.inv(one) + np.linalg.inv(other))
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(both)), rel=0.25)
    biases = second.truth()["imu"]
    assert together.imu is not None
    assert together.imu.gyro_bias_rps == pytest.approx(biases["gyro_bias_rps"], abs=1e-3)
    assert together.imu.accel_bias_mps2 == pytest.approx(biases["accel_bias_mps2"], abs=0.03)
    truth = second.rig.gravity_world_mps2
    assert together.gravity_world_mps2 == pytest.approx(truth, abs=0.03)
    assert not {e.kind for e in [*events, *together.events]} & {EventKind.IMU_GAP, EventKind.IMAGE_GAP}


def test_two_halves_are_the_whole(first, after_first) -> None:
    """But for biases and gravity, which the second half finds again: cov(halves - whole) = P_h - P_w."""
    whole = pickle.loads(after_first).estimate()
    c = calibrator(first)
    feed(c, items(first, end_s=8.0))
    c.next_recording()
    feed(c, items(first, later_s=APART_S, begin_s=8.0))
    halves = c.estimate()
    a, b = (error_and_covariance(e, first) for e in (whole, halves))
    whole_sigma, halves_sigma = (np.sqrt(np.diag(covariance)) for _, covariance in (a, b))
    lost = np.sqrt(np.maximum(halves_sigma**2 - whole_sigma**2, 0.0))
    assert (np.abs(a[0] - b[0]) < 3.0 * lost + 0.1 * whole_sigma).all()
    assert (halves_sigma < 1.3 * whole_sigma).all()  # two starts in 16 s


@pytest.mark.parametrize("later_s", [-86_400.0, 0.0, 16.01, 1e6])
def test_clocks_need_not_have_anything_to_do_with_each_other(first, second, after_first, later_s) -> None:
    """Another boot: stamps that overlap, lie before those of the recording before, or seem to go on."""
    c = pickle.loads(after_first)
    c.next_recording()
    feed(c, items(second, later_s=later_s))
    error, covariance = error_and_covariance(c.estimate(), first)
    assert nees(error, covariance, 7) < chi2.isf(1e-3, 7)
    assert c.evaluator.frames > 0.9 * (len(first.frames) + len(second.frames))


def test_images_that_come_before_the_first_reading_do_no_harm(first, second, after_first) -> None:
    c = pickle.loads(after_first)
    c.next_recording()
    stream = items(second, later_s=16.0 + APART_S)
    images = [x for x in stream if not isinstance(x[1], tuple)][:5]
    feed(c, images + stream)
    assert EventKind.STAMPS_STEPPED not in {e.kind for e in c.estimate().events}
    error, covariance = error_and_covariance(c.estimate(), first)
    assert nees(error, covariance, 7) < chi2.isf(1e-3, 7)


@pytest.mark.parametrize("shown_s", [0.0, 0.1, 2.0])  # no data at all; too few readings to know their rate
def test_a_recording_that_shows_nothing_is_left_behind(first, shown_s) -> None:
    c = calibrator(first)
    feed(c, items(first, end_s=shown_s))
    assert not c.can_go_on
    c.next_recording()
    feed(c, items(first, later_s=APART_S, begin_s=shown_s))
    estimate = c.estimate()
    assert estimate.status is Status.CONVERGED
    error, covariance = error_and_covariance(estimate, first)
    assert nees(error, covariance, 7) < chi2.isf(1e-3, 7)


def test_a_camera_that_was_moved_in_between_is_noticed(first, after_first) -> None:
    moved = another(2010, p_imu_cam=reference_rig(1).p_imu_cam + np.array([0.03, 0.0, 0.0]))
    run = simulate(2010, 16.0, rig=moved, corner_sigma_px=0.3, camera_rate_hz=10.0)
    c = pickle.loads(after_first)
    c.estimate()
    c.next_recording()
    feed(c, items(run, later_s=16.0 + APART_S))
    assert EventKind.BUMPED in {e.kind for e in c.estimate().events}


def test_clocks_that_drift_have_another_time_shift_in_the_next_recording() -> None:
    rig = replace(reference_rig(10, timeshift_cam_imu_s=SHIFT_S), clock_skew_ppm=100.0)
    first = simulate(10, 16.0, rig=rig, corner_sigma_px=0.3, camera_rate_hz=10.0)
    late = replace(another(1010), clock_skew_ppm=100.0, timeshift_cam_imu_s=SHIFT_S + 0.3)
    second = simulate(1010, 16.0, rig=late, corner_sigma_px=0.3, camera_rate_hz=10.0)
    c = calibrator(first)
    feed(c, items(first))
    c.next_recording()
    feed(c, items(second, later_s=16.0 + APART_S))
    camera = c.estimate().cameras["cam0"]
    assert camera.timeshift_cam_imu_s == pytest.approx(SHIFT_S + 0.3 + 16.0 * 1e-4, abs=3e-4)
    assert camera.T_imu_cam.p_m == pytest.approx(first.rig.p_imu_cam, abs=2e-3)


@pytest.mark.parametrize("late_s", [-0.3, 0.05, 0.4])
def test_another_clock_is_found_while_the_biases_are_not_known_either(after_first, late_s) -> None:
    """A bias by images that are late is off by up to 1 rad/s: no time shift fitted, the rig was `bumped`."""
    late = simulate(42, 8.0, rig=replace(another(42), timeshift_cam_imu_s=SHIFT_S + late_s))
    c = pickle.loads(after_first)
    before = len(c.estimate().events)
    c.next_recording(common_clock=False)
    feed(c, items(late, later_s=16.0 + APART_S))
    together = c.estimate()
    assert together.status is Status.CONVERGED
    error, covariance = error_and_covariance(together, late)
    assert nees(error, covariance, 7) < chi2.isf(1e-3, 7)
    assert not {e.kind for e in together.events[before:]} & {EventKind.BUMPED, EventKind.STARTED_ANEW}


def test_the_clocks_of_two_cameras_are_found_too() -> None:
    """Images of one in the order of its old time shift made those of the other be forgotten."""
    turned = exp_so3(np.deg2rad([3.0, -5.0, 4.0]))

    def both(seed: int, seconds: float, *late_s: float):
        rig = another(seed)
        beside = replace(rig, R_imu_cam=rig.R_imu_cam @ turned, p_imu_cam=rig.p_imu_cam + 0.05)
        rigs = [
            replace(r, timeshift_cam_imu_s=SHIFT_S + s) for r, s in zip((rig, beside), late_s, strict=True)
        ]
        return [simulate(seed + 100 * k, seconds, rig=r) for k, r in enumerate(rigs)]

    def take(c: Calibrator, runs, later_s: float) -> None:
        data = [(t, "", x) for t, x in items(runs[0], later_s) if isinstance(x, tuple)]
        for name, run in zip(("cam0", "cam1"), runs, strict=True):
            data += [(t, name, x) for t, x in items(run, later_s) if not isinstance(x, tuple)]
        for stamp_ns, name, x in sorted(data, key=lambda x: x[0]):
            if not name:
                c.add_imu(stamp_ns, *x)
            else:
                c.add_points(PointsFrame(name, stamp_ns, x.ids, x.uv_px))
                c.process()
        c.finish()

    runs = both(11, 12.0, 0.0, 0.05)
    lens = runs[0].rig.lens
    prior = CameraPrior((640, 480), tuple(lens.intrinsics), lens.model, tuple(lens.distortion))
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=ImuNoise())
    c = Calibrator(options, {"cam0": prior, "cam1": prior}, runs[0].points_m)
    take(c, runs, 0.0)
    before = len(c.estimate().events)
    c.next_recording(common_clock=False)
    take(c, both(43, 8.0, 0.3, -0.2), 20.0)
    together = c.estimate()
    assert together.status is Status.CONVERGED
    for name, late_s in (("cam0", 0.3), ("cam1", -0.2)):
        camera = together.cameras[name]
        off_s = camera.timeshift_cam_imu_s - SHIFT_S - late_s
        assert abs(off_s) < 4.0 * camera.timeshift_sigma_s < 2e-3, name
    assert not {e.kind for e in together.events[before:]} & {EventKind.BUMPED, EventKind.STARTED_ANEW}


def test_without_a_target_too() -> None:
    first = simulate_tracks(1, 14.0, rig=reference_rig(1, timeshift_cam_imu_s=SHIFT_S), camera_rate_hz=10.0)
    # the tracks of a room: the world's z is up, and stays so
    rig = another(1001, gravity_world_mps2=nominal_gravity())
    second = simulate_tracks(1001, 14.0, rig=rig, camera_rate_hz=10.0)
    calibrators = [calibrator(first, TargetFreeCalibrator, target_free=True) for _ in range(2)]
    for c, run in zip(calibrators, (first, second), strict=True):
        feed(c, items(run))
    both = pickle.loads(pickle.dumps(calibrators[0]))
    assert both.can_go_on
    both.next_recording()
    feed(both, items(second, later_s=14.0 + APART_S))
    sigmas = []
    for c in (*calibrators, both):
        error, covariance = error_and_covariance(c.estimate(), first)
        assert nees(error, covariance, 7) < chi2.isf(1e-3, 7)
        sigmas.append(np.sqrt(np.diag(covariance)))
    assert (sigmas[2] < 0.9 * np.minimum(*sigmas[:2])).all()
