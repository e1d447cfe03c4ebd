"""A camera that sees the target later than the others joins them, against the truth of both."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.init.late_camera import LateCameras
from vical_daemon.estimation.measurements import (
    CalibrationOptions,
    CameraPrior,
    ConvergenceTargets,
    PointsFrame,
)
from vical_daemon.estimation.result import Status

SEED, LENGTH_S, RATE_HZ = 1, 24.0, 10.0
COMMON = 890  # readings: 8.9 s
TURN = Rotation.from_euler("yx", [15.0, 5.0], degrees=True).as_matrix()


@pytest.fixture(scope="module")
def runs():
    """Two cameras on one rig: the same motion and readings, corner noise of their own."""
    first = reference_rig(SEED)
    second = replace(
        first,
        R_imu_cam=first.R_imu_cam @ TURN,
        p_imu_cam=first.p_imu_cam + np.array([0.08, -0.02, 0.03]),
        timeshift_cam_imu_s=0.012,
    )
    return {
        "cam0": simulate(SEED, LENGTH_S, rig=first, camera_rate_hz=RATE_HZ),
        "cam1": simulate(SEED + 1, LENGTH_S, rig=second, camera_rate_hz=RATE_HZ),
    }


def calibrate(runs, seen, renumber=None, alike=False, silent=(), blank=False, targets=None, so_far=None):
    """Feed both cameras where `seen(name, seconds)`; cam1 numbers by `renumber`. Estimates, one a second.

    `blank`: where it is not seen, images without points come, as from a detector. `so_far`: of `first_alone`.
    """
    c, estimates, images = pickle.loads(so_far) if so_far else (calibrator(runs, alike, targets), [], 0)
    c.do_without(frozenset(silent))
    frames = images_of(runs, seen, renumber, blank=blank)
    follow(c, estimates, runs["cam0"], frames[images:], begin=COMMON if so_far else 0)
    c.finish()
    return [*estimates, c.estimate()]


def calibrator(runs, alike=False, targets=None):
    lens = runs["cam0"].rig.lens
    known = CameraPrior((640, 480), tuple(lens.intrinsics), lens.model, tuple(lens.distortion))
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"}), target_alike=alike, targets=targets or ConvergenceTargets()
    )
    return Calibrator(options, dict.fromkeys(runs, known), runs["cam0"].points_m)


def images_of(runs, seen, renumber=None, *, blank=False):
    begin_ns, nothing = int(runs["cam0"].t_imu_ns[0]), (np.empty(0, np.int64), np.empty((0, 2)))
    frames = []
    for name, run in runs.items():
        for f in run.frames:
            ids = f.ids if name == "cam0" or renumber is None else renumber(f.ids)
            shown = seen(name, 1e-9 * (f.t_cam_ns - begin_ns))
            if shown or blank:
                frames.append(PointsFrame(name, f.t_cam_ns, *((ids, f.uv_px) if shown else nothing)))
    return sorted(frames, key=lambda f: f.t_cam_ns)


def follow(c, estimates, data, frames, begin=0, end=None):
    """Feed readings and the images between them; the number of these."""
    k = 0
    readings = zip(data.t_imu_ns, data.gyro_rps, data.specific_force_mps2, strict=True)
    for n, (t, w, f) in list(enumerate(readings))[begin:end]:
        c.add_imu(int(t), w, f)
        while k < len(frames) and frames[k].t_cam_ns <= t:
            c.add_points(frames[k])
            c.process()
            k += 1
        if n % 100 == 99:
            estimates.append(c.estimate())
    return k


@pytest.fixture(scope="module")
def first_alone(runs):
    """The first seconds of all recordings in which the second camera comes later, followed once."""
    c, estimates = calibrator(runs), []
    frames = images_of(runs, lambda name, t_s: name == "cam0")
    images = follow(c, estimates, runs["cam0"], frames, end=COMMON)
    return pickle.dumps((c, estimates, images))


def largest_z(estimate, runs):
    """Largest error over its sigma, of lever arm, mounting and time shift of all cameras."""
    worst = 0.0
    for name, e in estimate.cameras.items():
        rig = runs[name].rig
        turn = rig.R_imu_cam.T @ Rotation.from_quat(np.roll(e.T_imu_cam.q_wxyz, -1)).as_matrix()
        error = np.concatenate(
            [
                np.array(e.T_imu_cam.p_m) - rig.p_imu_cam,
                Rotation.from_matrix(turn).as_rotvec(),
                [e.timeshift_cam_imu_s - rig.timeshift_cam_imu_s],
            ]
        )
        sigma = np.sqrt([*np.diag(e.T_imu_cam.covariance), e.timeshift_sigma_s**2])
        worst = max(worst, float(np.abs(error / sigma).max()))
    return worst


@pytest.mark.parametrize(
    "seen",
    [
        lambda name, t_s: name == "cam0" or t_s > 9.0,
        lambda name, t_s: t_s < 9.0 if name == "cam0" else t_s > 11.0,
    ],
    ids=["both from 9 s on", "never both"],
)
def test_a_camera_that_comes_later_joins_those_that_are_calibrated(runs, first_alone, seen):
    estimates = calibrate(runs, seen, so_far=first_alone)
    alone = [e for e in estimates if list(e.cameras) == ["cam0"]]
    assert alone
    assert all(e.reason.startswith("cam1: target not in view yet") for e in alone[3:])
    assert list(estimates[-1].cameras) == ["cam0", "cam1"]
    assert estimates[-1].status is Status.CONVERGED
    assert max(largest_z(e, runs) for e in estimates) < 4.0  # 14 numbers, 20 estimates: 1 in 500 by chance
    both = next(e for e in estimates if len(e.cameras) == 2)
    sigma_m = np.sqrt(np.diag(both.cameras["cam0"].T_imu_cam.covariance)[:3])
    before_m = np.sqrt(np.diag(alone[-1].cameras["cam0"].T_imu_cam.covariance)[:3])
    assert (sigma_m < 1.1 * before_m).all()  # nothing that was known is lost


def test_advice_names_the_camera_whose_axes_it_is_about(runs):
    end = calibrate(runs, lambda name, t_s: t_s < 5.0, targets=ConvergenceTargets(1e-5, 1e-5, 1e-7))[-1]
    assert end.next_motion.axes and end.next_motion.camera in runs
    assert f"of {end.next_motion.camera}: ±" in end.reason


@pytest.mark.parametrize("from_s", [9.0, np.inf])
def test_images_that_show_no_target_are_not_waited_for(runs, from_s):
    """Detectors publish an empty list for each image in which they find no target."""
    end = calibrate(runs, lambda name, t_s: name == "cam0" or t_s > from_s, blank=True)[-1]
    assert list(end.cameras) == (["cam0", "cam1"] if from_s < LENGTH_S else ["cam0"])
    assert largest_z(end, runs) < 4.0


def test_a_camera_that_is_not_connected_is_not_waited_for(runs):
    estimates = calibrate(runs, lambda name, t_s: name == "cam0" and t_s < 16.0, silent=["cam1"])
    assert estimates[-1].status is Status.CONVERGED
    assert list(estimates[-1].cameras) == ["cam0"]
    assert not any("cam1" in e.reason for e in estimates)
    assert largest_z(estimates[-1], runs) < 4.0


@pytest.mark.parametrize("from_s", [0.0, 9.0])
def test_a_camera_that_numbers_the_target_from_the_other_end_is_put_right(runs, from_s):
    """An 8 x 6 checkerboard looks the same after half a turn; cameras may start together or not."""
    last = len(runs["cam0"].points_m) - 1
    options = {"renumber": lambda ids: last - ids, "alike": True}
    end = calibrate(runs, lambda name, t_s: name == "cam0" or t_s >= from_s, **options)[-1]
    assert list(end.cameras) == ["cam0", "cam1"]
    assert largest_z(end, runs) < 4.0


def test_a_late_camera_that_numbers_a_target_differently_does_not_join(runs, first_alone):
    last = len(runs["cam0"].points_m) - 1
    late = {"renumber": lambda ids: last - ids, "so_far": first_alone}
    end = calibrate(runs, lambda name, t_s: name == "cam0" or t_s > 9.0, **late)[-1]
    assert list(end.cameras) == ["cam0"]
    assert "cam0 and cam1 number the points of the target differently" in end.reason
    assert largest_z(end, runs) < 4.0


def test_what_is_kept_for_a_camera_that_saw_the_target_once_is_forgotten(runs):
    """Else images and readings would pile up as long as the daemon runs."""
    late = LateCameras(CalibrationOptions(), None, None)
    f = SimpleNamespace(absent={"cam1"}, unobservable=None, state=SimpleNamespace(t_s=0.9))
    frame = runs["cam0"].frames[0]
    images = {name: PointsFrame(name, 0, frame.ids, frame.uv_px) for name in runs}
    assert late.take(f, 1.0, images["cam1"])
    assert late.oldest_s == 0.9
    for t_s in np.arange(1.05, 12.0, 0.05):
        assert not late.take(f, t_s, images["cam0"])
    assert late.oldest_s == np.inf
