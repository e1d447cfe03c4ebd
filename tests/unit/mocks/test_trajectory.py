"""The truth has to be true: derivatives by finite differences, rotations against scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.curves import Pause
from vical_mocks.rig import NOMINAL_P_IMU_CAM, NOMINAL_R_IMU_CAM, reference_rig
from vical_mocks.rotations import exp_so3, log_so3, quaternion_wxyz
from vical_mocks.trajectory import (
    Trajectory,
    constant_rate,
    fronto_parallel,
    hand_motion,
    one_axis,
    pure_translation,
    still,
)

EXTRINSICS = (NOMINAL_R_IMU_CAM, NOMINAL_P_IMU_CAM)
MOTIONS = {
    "hand": lambda: hand_motion(1, T_imu_cam=EXTRINSICS),
    "spline": lambda: hand_motion(2, T_imu_cam=EXTRINSICS, style="spline"),
    "paused": lambda: hand_motion(3, T_imu_cam=EXTRINSICS).with_pauses([Pause(4, 6), Pause(9, 9.5)]),
    "still": lambda: still(T_imu_cam=EXTRINSICS),
    "translation": lambda: pure_translation(1, T_imu_cam=EXTRINSICS),
    "one axis": lambda: one_axis(1, [0, 1, 0], T_imu_cam=EXTRINSICS),
    "constant rate": lambda: constant_rate(T_imu_cam=EXTRINSICS),
    "fronto-parallel": lambda: fronto_parallel(1, T_imu_cam=EXTRINSICS),
}


def central(function, t_s, step_s):
    return (function(t_s + step_s) - function(t_s - step_s)) / (2 * step_s)


@pytest.mark.parametrize("name", MOTIONS)
def test_derivatives_are_exact(name):
    motion: Trajectory = MOTIONS[name]()
    t_s, step_s = np.linspace(0.013, 12.0, 97), 1e-5
    np.testing.assert_allclose(motion.v_world_imu(t_s), central(motion.p_world_imu, t_s, step_s), atol=1e-7)
    np.testing.assert_allclose(motion.a_world_imu(t_s), central(motion.v_world_imu, t_s, step_s), atol=2e-4)
    before, after = motion.R_world_imu(t_s - step_s), motion.R_world_imu(t_s + step_s)
    turned = Rotation.from_matrix(np.swapaxes(before, -1, -2) @ after).as_rotvec() / (2 * step_s)
    np.testing.assert_allclose(motion.omega_imu_rps(t_s), turned, atol=1e-6)
    np.testing.assert_allclose(
        motion.alpha_imu_rps2(t_s), central(motion.omega_imu_rps, t_s, step_s), atol=3e-4
    )


def test_exp_and_log_agree_with_scipy_from_tiny_to_half_turns():
    rng = np.random.default_rng(0)
    axes = rng.standard_normal((200, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    angle = np.concatenate([np.logspace(-9, 0, 100), np.linspace(1, np.pi - 1e-6, 100)])
    theta = axes * angle[:, None]
    R = Rotation.from_rotvec(theta).as_matrix()
    np.testing.assert_allclose(exp_so3(theta), R, atol=1e-14)
    np.testing.assert_allclose(log_so3(R), theta, atol=1e-9)
    q_xyzw = Rotation.from_matrix(R).as_quat(canonical=True)
    np.testing.assert_allclose(quaternion_wxyz(R), q_xyzw[:, [3, 0, 1, 2]], atol=1e-12)


def test_mean_rate_is_what_was_asked_for():
    assert hand_motion(5, 20.0).mean_rate_dps() == pytest.approx(20.0, rel=0.02)
    assert hand_motion(5, 100.0, style="spline").mean_rate_dps() == pytest.approx(100.0, rel=0.05)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("style", ["sinusoids", "spline"])
def test_hand_motion_keeps_the_board_in_view(side, style):
    rig = reference_rig(1, trajectory=hand_motion(1, T_imu_cam=EXTRINSICS, side=side, style=style))
    x, y = np.meshgrid([0.0, 0.35], [0.0, 0.25])
    corners = np.stack([x.ravel(), y.ravel(), np.zeros(4)], axis=-1)
    _, visible = rig.lens.project(rig.points_in_camera(np.arange(0, 60, 0.05), corners))
    assert visible.all(axis=1).mean() > 0.8


def test_degenerate_motions_are_what_they_are_called():
    t_s = np.linspace(0, 10, 50)
    assert np.allclose(still().v_world_imu(t_s), 0)
    translation = pure_translation(1)
    assert np.allclose(translation.omega_imu_rps(t_s), 0)
    assert np.linalg.norm(translation.v_world_imu(t_s), axis=-1).max() > 0.1
    rate = one_axis(1, [0, 1, 0]).omega_imu_rps(t_s)
    assert np.allclose(rate[:, [0, 2]], 0) and np.abs(rate[:, 1]).max() > 0.1
    assert np.allclose(np.diff(constant_rate(30.0).omega_imu_rps(t_s), axis=0), 0, atol=1e-12)
    optical = fronto_parallel(1).R_world_imu(t_s)[:, :, 2]
    assert np.allclose(optical, [0, 0, 1])


def test_pauses_stand_still_and_then_go_on():
    moving, paused = hand_motion(1), hand_motion(1).with_pauses([Pause(5.0, 8.0)], ramp_s=0.5)
    rest = np.linspace(5.0, 8.0, 20)
    assert np.allclose(paused.v_world_imu(rest), 0, atol=1e-12)
    # Two half ramps and the rest itself are lost: the clock is late by 3 s + 0.5 s.
    np.testing.assert_allclose(paused.p_world_imu(20.0), moving.p_world_imu(16.5), atol=1e-12)
