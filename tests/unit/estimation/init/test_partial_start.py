"""Motion that shows only part of the calibration: that part is right, the rest named, nothing converges."""

from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks import trajectory
from vical_mocks.curves import Pause, Paused, Sinusoids
from vical_mocks.points import simulate
from vical_mocks.rig import NOMINAL_P_IMU_CAM, NOMINAL_R_IMU_CAM, reference_rig

from tests.unit.estimation.test_calibrator import calibrate, errors
from vical_daemon.estimation.init.linear_start import still_axes
from vical_daemon.estimation.result import Status

MOUNT = (NOMINAL_R_IMU_CAM, NOMINAL_P_IMU_CAM)


def run_of(motion, seed=4, seconds=20.0, rate_hz=10.0):
    rig = reference_rig(seed, timeshift_cam_imu_s=0.03, trajectory=motion)
    return simulate(seed, seconds, rig=rig, camera_rate_hz=rate_hz)


MOTIONS = {
    "pure translation": (trajectory.pure_translation(4, T_imu_cam=MOUNT), np.eye(3)),
    "about the optical axis": (trajectory.one_axis(4, [0, 0, 1], T_imu_cam=MOUNT), np.eye(3)[2:]),
    "nodding": (trajectory.one_axis(4, [1, 0, 0], T_imu_cam=MOUNT), np.eye(3)[:1]),
}


@cache
def followed(name):
    """A recording, its estimate, the statuses on the way, and the filter after ten seconds."""
    run = run_of(MOTIONS[name][0])
    statuses, after_10_s = [], []

    def each(c):
        statuses.append(c.estimate().status)
        if len(statuses) == 50:
            after_10_s.append(deepcopy(c.filter))

    return run, calibrate(run, each=each).estimate(), statuses, after_10_s[0]


@pytest.mark.parametrize("name", MOTIONS)
def test_what_the_motion_shows_is_right_and_what_it_does_not_is_named(name):
    run, estimate, statuses, _ = followed(name)
    hidden_cam = MOTIONS[name][1]
    assert Status.CONVERGED not in statuses
    assert estimate.status == Status.DEGENERATE
    x, sigma = errors(estimate, run)
    assert np.abs(x / sigma)[3:].max() < 4.0
    assert sigma[3:6].max() < np.deg2rad(0.1)
    assert sigma[6] < 2e-4
    camera = estimate.cameras["cam0"]
    R = Rotation.from_quat(np.roll(camera.T_imu_cam.q_wxyz, -1)).as_matrix()
    position = R.T @ np.array(camera.T_imu_cam.covariance)[:3, :3] @ R
    spread = np.einsum("ki,ij,kj->k", hidden_cam, position, hidden_cam)
    assert np.sqrt(spread).min() > 0.25
    shown = np.eye(3) - hidden_cam.T @ hidden_cam  # along these axes the lever arm is known, and right
    known = shown @ position @ shown
    if len(hidden_cam) < 3:
        assert np.sqrt(np.trace(known)) < 0.02
        assert np.linalg.norm(shown @ R.T @ x[:3]) < 4.0 * np.sqrt(np.trace(known))
    assert len(camera.unobservable) == len(hidden_cam)
    assert all("lever arm" in name for name in camera.unobservable)


def test_a_partial_start_gives_way_to_a_full_one_as_soon_as_the_rig_turns():
    hand = trajectory.hand_motion(5, T_imu_cam=MOUNT)
    late = trajectory.Trajectory(
        Paused(hand.rotation, [Pause(0.5, 11.0)]),
        hand.position,
        hand.R_world_base0,
        (hand.R_base_imu, hand.p_base_imu),
    )
    run = run_of(late, seconds=26.0, rate_hz=20.0)
    partial = []

    def each(c):
        c.estimate()  # as a daemon does: the status at the end is that of a calibration that is followed
        partial.append(c.filter is not None and c.filter.unobservable is not None)

    c = calibrate(run, each=each)
    assert any(partial)
    estimate = c.estimate()
    assert estimate.status == Status.CONVERGED
    assert c.filter.unobservable is None
    x, sigma = errors(estimate, run)
    assert np.abs(x / sigma).max() < 4.0
    assert sigma[:3].max() < 2e-3


def test_turning_at_one_rate_shows_where_the_axis_lies_in_the_imu_and_nothing_else():
    run = run_of(trajectory.constant_rate(T_imu_cam=MOUNT))
    statuses = []
    estimate = calibrate(run, each=lambda c: statuses.append(c.estimate().status)).estimate()
    assert Status.CONVERGED not in statuses
    assert estimate.status == Status.DEGENERATE
    camera = estimate.cameras["cam0"]
    named = " ".join(camera.unobservable)
    assert "rotation about the optical axis" in named
    assert "time shift" in named
    assert named.count("lever arm") == 3
    axis = Rotation.from_quat(np.roll(camera.T_imu_cam.q_wxyz, -1)).as_matrix()[:, 2]
    off = np.arccos(min(axis @ run.rig.R_imu_cam[:, 2], 1.0))
    _, sigma = errors(estimate, run)
    assert off < 4.0 * np.hypot(sigma[3], sigma[4])
    assert sigma[3:5].max() < np.deg2rad(0.15)
    assert sigma[:3].min() > 0.25
    assert sigma[5] > 1.0
    assert sigma[6] > 0.25


class Faded:
    """A curve that is nothing at first and all of itself a second later."""

    def __init__(self, curve, start_s):
        self.curve, self.start_s = curve, start_s

    def evaluate(self, t_s):
        t = np.asarray(t_s, dtype=np.float64)[..., None]
        x = np.clip(t - self.start_s, 0.0, 1.0)
        w, dw, ddw = x**3 * (10 - 15 * x + 6 * x**2), 30 * (x - x**2) ** 2, 60 * x * (1 - x) * (1 - 2 * x)
        v, dv, ddv = self.curve.evaluate(t_s)
        return w * v, dw * v + w * dv, ddw * v + 2 * dw * dv + w * ddv


class Sum:
    def __init__(self, *curves):
        self.curves = curves

    def evaluate(self, t_s):
        return tuple(sum(parts) for parts in zip(*(c.evaluate(t_s) for c in self.curves), strict=True))


def test_a_rig_that_has_turned_at_one_rate_is_known_as_soon_as_it_turns_otherwise():
    hand = trajectory.hand_motion(5, T_imu_cam=MOUNT)
    steady = Sinusoids(np.array([0.0, 0.0, -3.0]), slope=np.deg2rad([0.0, 0.0, 25.0]))
    motion = trajectory.Trajectory(
        Sum(Paused(steady, [Pause(13.5, 99.0)]), Faded(hand.rotation, 13.0)),
        Paused(hand.position, [Pause(-1.0, 13.5)]),
        hand.R_world_base0,
        (hand.R_base_imu, hand.p_base_imu),
    )
    run = run_of(motion, seconds=30.0)
    partial, statuses = [], []

    def look(c):
        partial.append(c.filter is not None and c.filter.unobservable is not None)
        statuses.append(c.estimate().status)

    c = calibrate(run, each=look)
    assert any(partial)
    estimate = c.estimate()
    assert estimate.status == Status.CONVERGED
    assert statuses.index(Status.CONVERGED) > max(k for k, p in enumerate(partial) if p)
    x, sigma = errors(estimate, run)
    assert np.abs(x / sigma).max() < 4.0
    assert sigma[:3].max() < 3e-3


@pytest.mark.parametrize(("turn_rad", "ends"), [(0.03, False), (0.2, True)])
def test_an_axis_that_begins_to_turn_ends_a_filter_that_holds_it(turn_rad, ends):
    f = deepcopy(followed("pure translation")[-1])
    assert len(f.unobservable.axes) == 3
    still, ended = f.state.R_world_imu, []
    for share in np.linspace(0.0, 1.0, 20):  # of a second
        f.state.R_world_imu = Rotation.from_rotvec([0.0, 0.0, share * turn_rad]).as_matrix() @ still
        f.state.t_s += 0.05
        ended.append(f.unobservable.turned(f))
    assert any(ended) == ends


def test_a_rig_that_turns_after_a_long_translation_starts_at_once_and_rightly():
    """Errors of attitudes over 10 s of translation used to be taken for a lever arm of half a metre."""
    seed = 8
    hand = trajectory.hand_motion(seed, T_imu_cam=MOUNT)
    turns = Paused(hand.rotation, [Pause(0.5, 14.0)])
    base = hand.R_base_imu, hand.p_base_imu
    motion = trajectory.Trajectory(turns, hand.position, hand.R_world_base0, base)
    run = run_of(motion, seed, seconds=18.0, rate_hz=20.0)
    events, full_s, worst = [], [], 0.0

    def look(c):
        nonlocal worst
        estimate = c.estimate()
        events.extend(estimate.events)
        if c.filter is not None and c.filter.unobservable is None:
            full_s.append(1e-9 * (estimate.t_ns - int(run.t_imu_ns[0])))
            x, sigma = errors(estimate, run)
            worst = max(worst, float(np.abs(x / sigma).max()))

    calibrate(run, each=look)
    assert not events
    assert full_s[0] < 16.0
    assert worst < 5.0


def test_still_axes_are_those_that_keep_their_direction():
    swing = Rotation.from_rotvec(np.outer(0.3 * np.sin(np.linspace(0, 20, 400)), [0.0, 0.6, 0.8]))
    axes = still_axes((Rotation.from_euler("xyz", [0.4, -1.0, 2.0]) * swing).as_matrix().mean(axis=0))
    assert axes.shape == (1, 3)
    assert abs(axes[0] @ [0.0, 0.6, 0.8]) == pytest.approx(1.0, abs=1e-3)
