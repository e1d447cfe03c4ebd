"""The measurement model against a loop written from the text of its equation, and its time derivative."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.filter.linearise import view
from vical_daemon.estimation.inertial.imu_model import Motion
from vical_daemon.estimation.model.rates import Rates
from vical_daemon.estimation.model.retract import CameraPoints

K = np.array([450.0, 455.0, 320.0, 240.0])
D = np.array([-0.2, 0.05, 1e-3, -5e-4])
X = np.random.default_rng(0).uniform(-0.2, 0.2, (12, 3)) * [1, 1, 0]
R_IMU_CAM = Rotation.from_euler("xyz", [88, 3, -91], degrees=True).as_matrix()
P_IMU_CAM = np.array([0.05, -0.02, 0.01])
RATES = Rates(np.array([0.4, -0.9, 0.6]), np.array([0.5, 1.0, -0.8]))


def motion():
    look = Rotation.from_euler("x", 180, degrees=True).as_matrix()  # the board's z points at the camera
    R_world_cam = look @ Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    R = R_world_cam @ R_IMU_CAM.T
    p = np.array([0.05, -0.03, 0.7]) - R @ P_IMU_CAM
    return Motion(R[None], p[None], np.array([[0.2, -0.3, 0.1]]))


def camera(shift=0.0, readout=0.0):
    return CameraPoints(
        R_IMU_CAM[None], P_IMU_CAM[None], np.array([shift]), K[None], D[None], np.array([readout])
    )


def by_hand(delay):
    """One point at a time, scipy's rotations, OpenCV's lens."""
    m = motion()
    R = m.R[0] @ Rotation.from_rotvec(RATES.omega * delay).as_matrix()
    p = m.p[0] + m.v[0] * delay + 0.5 * RATES.accel * delay**2
    out = []
    for x in X:
        x_cam = R_IMU_CAM.T @ (R.T @ (x - p) - P_IMU_CAM)
        uv, _ = cv2.projectPoints(
            x_cam[None], np.zeros(3), np.zeros(3), np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]]), D
        )
        out.append(uv.ravel())
    return np.array(out)


@pytest.mark.parametrize(("shift", "ahead"), [(0.0, 0.0), (0.012, -0.003), (-0.05, 0.05)])
def test_view_is_the_equation_point_by_point(shift, ahead):
    uv = view(X, motion(), camera(shift), RATES, ahead, "radtan")
    np.testing.assert_allclose(uv[0], by_hand(shift + ahead), atol=1e-8)


def test_a_later_image_sees_what_the_moved_rig_sees():
    """The sign of the time shift: t_imu = t_cam + shift, so a larger shift is a later pose."""
    h = 1e-5
    slope = (
        view(X, motion(), camera(h), RATES, 0.0, "radtan")
        - view(X, motion(), camera(-h), RATES, 0.0, "radtan")
    ) / (2 * h)
    moved = (by_hand(h) - by_hand(-h)) / (2 * h)
    np.testing.assert_allclose(slope[0], moved, rtol=1e-5, atol=1e-3)
    assert np.abs(moved).max() > 50.0


def test_rolling_shutter_is_a_global_one_at_each_rows_own_time():
    readout = 0.03
    rows = np.linspace(-0.5, 0.5, len(X))
    uv = view(X, motion(), camera(readout=readout), RATES, 0.0, "radtan", rows)[0]
    expected = np.array([by_hand(readout * r)[k] for k, r in enumerate(rows)])
    still = by_hand(0.0)
    np.testing.assert_allclose(uv, expected, atol=0.01)
    assert np.abs(expected - still).max() > 3.0


def test_rows_of_a_slow_readout_follow_a_shaken_camera():
    """Against a motion that is integrated in small steps."""
    m, readout, steps = motion(), 0.05, 2000
    omega, alpha, jerk = (
        np.array([2.0, -1.5, 1.0]),
        np.array([20.0, 30.0, -25.0]),
        np.array([-300.0, 200.0, 400.0]),
    )
    accel, change = np.array([8.0, -5.0, 6.0]), np.array([90.0, 120.0, -80.0])
    jolt = m.R[0].T @ change - np.cross(omega, m.R[0].T @ accel)
    rates, rows = Rates(omega, accel, alpha, jerk, jolt), np.linspace(-0.5, 0.5, len(X))
    seen = view(X, m, camera(readout=readout), rates, 0.0, "radtan", rows)[0]
    second = view(X, m, camera(readout=readout), Rates(omega, accel, alpha), 0.0, "radtan", rows)[0]
    off = []
    for k, row in enumerate(rows):
        late = readout * row
        R, middles = Rotation.from_matrix(m.R[0]), (np.arange(steps) + 0.5) * late / steps
        for t in middles:
            R = R * Rotation.from_rotvec((omega + alpha * t + 0.5 * jerk * t * t) * late / steps)
        p = m.p[0] + m.v[0] * late + 0.5 * accel * late**2 + change * late**3 / 6.0
        there = Motion(R.as_matrix()[None], p[None], m.v)
        true = view(X[k : k + 1], there, camera(), rates, 0.0, "radtan")[0, 0]
        off.append([np.abs(seen[k] - true).max(), np.abs(second[k] - true).max()])
    third, to_second = np.max(off, axis=0)
    assert third < 0.06 and to_second > 0.4


def test_batch_equals_loop():
    m = motion()
    two = Motion(np.repeat(m.R, 2, 0), m.p + np.array([[0, 0, 0], [0.01, 0.02, 0.03]]), np.repeat(m.v, 2, 0))
    both = view(X, two, camera(), RATES, 0.004, "radtan")
    for k in range(2):
        one = view(
            X, Motion(two.R[k : k + 1], two.p[k : k + 1], two.v[k : k + 1]), camera(), RATES, 0.004, "radtan"
        )
        np.testing.assert_allclose(both[k], one[0], atol=1e-9)
