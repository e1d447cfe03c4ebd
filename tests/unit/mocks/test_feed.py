"""Feeding: order as in life, snapshots at whole seconds, errors with the signs they are documented with."""

import numpy as np
import pytest
from vical_mocks.harness.feed import (
    Snapshot,
    StartErrors,
    camera_prior,
    error_against_truth,
    events_in_order,
    feed,
    matrix_of_quaternion,
)
from vical_mocks.points import simulate
from vical_mocks.rotations import exp_so3, quaternion_wxyz


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
