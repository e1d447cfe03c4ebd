"""Feeding: order as in life, snapshots at whole seconds, errors with the signs they are documented with."""

import numpy as np
import pytest
from vical_mocks.points import simulate
from vical_mocks.rig import Bump, reference_rig
from vical_mocks.rotations import exp_so3, quaternion_wxyz

from benchmarks import __main__ as command
from benchmarks.changes import AT_S, bump, judge
from benchmarks.feed import (
    Record,
    Snapshot,
    StartErrors,
    camera_prior,
    error_against_truth,
    events_in_order,
    feed,
    matrix_of_quaternion,
)
from vical_daemon.estimation.events import Event, EventKind


class Listener:
    def __init__(self):
        self.heard = []

    def add_imu(self, t_ns, gyro, force):
        self.heard.append(("imu", t_ns))

    def add_points(self, frame):
        self.heard.append(("points", frame.t_cam_ns))

    def finish(self):
        self.heard.append(("end", 0))

    def look(self, run, t_s, record):
        return Snapshot(t_s, "running", np.zeros(15), np.eye(15))


def test_events_come_in_the_order_of_true_time_whatever_the_shift():
    run = simulate(1, 3.0, timeshift_cam_imu_s=0.2)
    times = [t for t, _ in events_in_order(run)]
    assert np.all(np.diff(times) >= 0)
    listener = Listener()
    record = feed(run, listener)
    assert [s.t_s for s in record.snapshots[:3]] == [1.0, 2.0, 3.0]
    assert record.frames == len(run.frames)
    assert listener.heard[-1][0] == "end"
    first_imu_after = next(i for i, (kind, _) in enumerate(listener.heard) if kind == "points")
    assert first_imu_after >= 20  # the first image is taken 0.2 s into the imu's recording


def test_errors_are_estimate_minus_truth():
    run = simulate(1, 1.0, timeshift_cam_imu_s=0.02)
    rig, lens = run.rig, run.rig.lens
    R = rig.R_imu_cam @ exp_so3([0.0, 0.01, 0.0])
    error = error_against_truth(
        run,
        0.5,
        rig.p_imu_cam + np.array([1e-3, 0, 0]),
        R,
        0.021,
        np.array(lens.intrinsics) + 2,
        lens.distortion,
    )
    expected = np.zeros(15)
    expected[[0, 4, 6]] = 1e-3, 0.01, 1e-3
    expected[7:11] = 2.0
    np.testing.assert_allclose(error, expected, atol=1e-12)
    np.testing.assert_allclose(matrix_of_quaternion(quaternion_wxyz(R)), R, atol=1e-12)


def test_start_errors_have_the_size_that_was_asked_for():
    run = simulate(1, 0.5)
    prior = camera_prior(run, 3, StartErrors(extrinsics=(0.3, 0.2), timeshift_s=0.05), exact_lens=True)
    R, p = prior.T_imu_cam
    assert np.arccos((np.trace(run.rig.R_imu_cam.T @ R) - 1) / 2) == pytest.approx(0.3)
    assert np.linalg.norm(p - run.rig.p_imu_cam) == pytest.approx(0.2)
    assert abs(prior.timeshift_cam_imu_s - run.rig.timeshift_cam_imu_s) == pytest.approx(0.05)
    assert prior.intrinsics == run.rig.lens.intrinsics
    nothing = camera_prior(run, 3, StartErrors(), exact_lens=False)
    assert nothing.T_imu_cam is None and nothing.timeshift_cam_imu_s is None


def record_with(announced_s, errors):
    record = Record()
    for t_s, e in errors.items():
        error = np.zeros(15)
        error[0] = e
        record.snapshots.append(Snapshot(t_s, "converged", error, np.eye(15)))
    if announced_s is not None:
        record.events.append((announced_s, Event(EventKind.BUMPED)))
    return record


def test_a_step_is_judged_by_announcement_return_and_lies():
    found = judge(record_with(61.5, {59.0: 0.1, 60.5: 9.0, 61.0: 9.0, 65.0: 4.0, 70.0: 1.0, 80.0: 1.0}))
    assert (found["announced_s"], found["back_s"], found["early"]) == (1.5, 5.5, 0)
    assert found["sigmas_at_10_s"] == 1.0
    assert found["lies_s"] == []  # before it was announced nobody could know
    silent = judge(record_with(None, {59.0: 0.1, 61.0: 9.0, 64.0: 9.0, 71.0: 9.0}))
    assert silent["announced_s"] is None
    assert silent["lies_s"] == [64.0, 71.0]


def test_bumps_have_the_size_of_their_name():
    (step,) = bump((2.0, 10.0, 5.0), 1)
    assert isinstance(step, Bump) and step.at_s == AT_S
    assert np.linalg.norm(step.rotation_rad) == pytest.approx(np.deg2rad(2))
    assert np.linalg.norm(step.translation_m) == pytest.approx(0.01)
    assert abs(step.timeshift_s) == pytest.approx(5e-3)
    assert bump((0.0, 0.0, 0.0), 1) == ()
    rig = reference_rig(1, bumps=(step,))
    assert rig.timeshift_at(AT_S + 1) - rig.timeshift_at(AT_S - 1) == pytest.approx(step.timeshift_s)


def test_the_command_refuses_unknown_studies(capsys):
    assert command.main(["nonsense"]) == 2
    assert "there are:" in capsys.readouterr().err
    assert command.main([]) == 0
    listed = capsys.readouterr().out
    assert "montecarlo" in listed and "Cramer-Rao" in listed
