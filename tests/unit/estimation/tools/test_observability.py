"""Known results of observability along motions (Gramian); guidance."""

from types import SimpleNamespace

import numpy as np
import pytest

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import project
from vical_daemon.estimation.guidance import Block, Lack, Verb
from vical_daemon.estimation.measurements import ConvergenceTargets
from vical_daemon.estimation.status.excitation import (
    WIDE,
    RunningMotion,
    excitation_advice,
    weak_directions,
)
from vical_daemon.estimation.tools.observability import (
    Motion,
    Setup,
    _frame_jacobian,
    block_layout,
    gramian,
    pose_sensitivities,
)
from vical_daemon.estimation.wording import (
    axis_name,
    direction_line,
    direction_name,
    direction_sigma,
    guidance_text,
)

G = np.array([0.0, 6.0, 7.7])
R_IMU_CAM = so3.exp(np.array([0.3, -1.2, 0.5]))
P_IMU_CAM = np.array([0.08, 0.02, -0.03])


def _motion(kind, seconds=12.0, dt=0.005):
    """Motion before a board at the origin, 0.8 m away, integrated finely enough to be exact for the test."""
    t = np.arange(0, seconds, dt)
    swing = np.stack([0.3 * np.sin(2.1 * t), 0.25 * np.sin(2.7 * t + 1), 0.4 * np.sin(1.6 * t + 2)], axis=1)
    if kind == "one_axis":
        swing *= np.array([0.0, 0.0, 1.0])
    elif kind == "translation":
        swing *= 0.0
    elif kind == "constant":
        swing = np.outer(0.7 * t, [0.0, 0.0, 1.0])
    R_base = np.eye(3)  # of the camera in the world; the board lies at z = 0.8
    R_world_cam = R_base @ so3.exp(swing)
    moving = 0.0 if kind == "constant" else 0.08
    sway = np.stack([np.sin(1.9 * t), np.sin(2.3 * t + 1), np.sin(1.3 * t + 2)], axis=1) * moving
    R = R_world_cam @ R_IMU_CAM.T
    p = np.array([0.0, 0.0, -0.8]) + sway - (R @ P_IMU_CAM)
    v = np.gradient(p, dt, axis=0, edge_order=2)
    a = np.gradient(v, dt, axis=0, edge_order=2)
    turn = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / dt
    w = np.vstack((turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]))
    f = np.einsum("kji,kj->ki", R, a - G)
    return Motion(t, R, p, v, w, f)


def _setup(**changes):
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 5), np.linspace(-0.15, 0.15, 4))
    board = np.column_stack((x.ravel(), y.ravel(), np.zeros(20)))
    lens = np.array([450.0, 450.0, 319.5, 239.5])
    return Setup(R_IMU_CAM, P_IMU_CAM, lens, np.array([-0.2, 0.05, 0, 0]), board, **changes)


FRAMES = np.arange(10, 2390, 20)


def test_sensitivities_agree_with_integrating_a_disturbed_imu():
    motion = _motion("general", 1.5)
    layout = {n: slice(3 * i, 3 * i + 3) for i, n in enumerate(
        ("attitude", "position", "velocity", "gyro_bias", "accel_bias", "gravity"))}  # fmt: skip
    theta, velocity, position = pose_sensitivities(motion, layout, 18)
    dt = motion.t_s[1] - motion.t_s[0]
    h = 1e-5
    # all 36 disturbed imus at once: +h and -h in every unknown
    x = np.concatenate((h * np.eye(18), -h * np.eye(18)))
    R = so3.exp(x[:, :3]) @ motion.R_world_imu[0]
    v, p = motion.v_world_imu[0] + x[:, 6:9], motion.p_world_imu[0] + x[:, 3:6]
    g = G + x[:, 15:18]
    for k in range(len(motion.t_s) - 1):
        w = 0.5 * (motion.rate_rps[k] + motion.rate_rps[k + 1]) - x[:, 9:12]
        later = R @ so3.exp(dt * w)
        a0 = np.einsum("cij,cj->ci", R, motion.specific_force_mps2[k] - x[:, 12:15]) + g
        a1 = np.einsum("cij,cj->ci", later, motion.specific_force_mps2[k + 1] - x[:, 12:15]) + g
        p = p + dt * v + dt * dt * (a0 / 3 + a1 / 6)
        v = v + 0.5 * dt * (a0 + a1)
        R = later
    numeric = so3.log(R[:18] @ np.swapaxes(R[18:], 1, 2)) / (2 * h)
    np.testing.assert_allclose(theta[-1], numeric.T, atol=1e-4)
    np.testing.assert_allclose(velocity[-1], (v[:18] - v[18:]).T / (2 * h), rtol=2e-3, atol=1e-2)
    np.testing.assert_allclose(position[-1], (p[:18] - p[18:]).T / (2 * h), rtol=2e-3, atol=1e-2)


def test_general_motion_determines_everything_and_bounds_are_sensible():
    result = gramian(_motion("general"), _setup(), FRAMES)
    assert result.rank == result.unknowns == 25
    assert np.all(result.sigma[result.blocks["lever_arm"]] < 2e-3)
    assert result.sigma[result.blocks["timeshift"]][0] < 2e-4


def lost_in_block(result, block):
    """Basis of what is lost within one block, shape (k, size): the shadow of the lost directions on it."""
    shadow = np.stack([d.vector[result.blocks[block]] for d in result.lost])
    _, s, Vt = np.linalg.svd(shadow, full_matrices=False)
    return Vt[s > 1e-3]


def test_one_axis_names_the_axis_along_a_motion_too():
    result = gramian(_motion("one_axis"), _setup(), FRAMES)
    assert result.rank < result.unknowns
    axis = lost_in_block(result, "lever_arm")[0]
    assert abs(axis @ R_IMU_CAM[:, 2]) > 0.99  # the optical axis, in the imu frame
    assert np.all(np.isfinite(result.sigma[result.blocks["rotation"]]))
    assert np.isfinite(result.sigma[result.blocks["timeshift"]][0])
    assert "lever_arm" in [name for name, _ in result.lost[0].parts] or len(result.lost) > 1


def test_translation_and_constant_rate_along_a_motion():
    translation = gramian(_motion("translation"), _setup(), FRAMES)
    assert len(lost_in_block(translation, "lever_arm")) == 3
    assert np.isfinite(translation.sigma[translation.blocks["timeshift"]][0])
    constant = gramian(_motion("constant", 8.0), _setup(), FRAMES[:70])
    assert not constant.sigma[constant.blocks["timeshift"]][0] < 5e-3


def test_optional_blocks_are_judged_too():
    every = frozenset({"intrinsics", "imu_matrix", "target_scale", "readout"})
    result = gramian(_motion("general"), _setup(estimate=every), FRAMES)
    assert result.unknowns == 50
    seen = tuple(np.arange(20) for _ in range(50))
    free = gramian(_motion("general", 6.0), _setup(seen=seen), FRAMES[:50])
    # board-free: position, attitude and the size of gravity are no unknowns, all others are determined
    assert free.rank == free.unknowns == 25 - 7
    assert np.isfinite(free.sigma[free.blocks["rotation"]]).all()


def _covariance(arm=(1e-3,) * 3, rotation=(1e-3,) * 3, shift=1e-4):
    arm_cov = R_IMU_CAM @ np.diag(np.square(arm)) @ R_IMU_CAM.T
    C = np.zeros((7, 7))
    C[:3, :3], C[3:6, 3:6], C[6, 6] = arm_cov, np.diag(np.square(rotation)), shift**2
    return C


def _weak(covariance, scatter, change_rps2=None, limits=WIDE):
    """`weak_directions` of a motion of which scatter and change of the rates are given."""
    motion = SimpleNamespace(scatter=lambda _: scatter, rate_change_rps2=change_rps2)
    return weak_directions(covariance[:6, :6], R_IMU_CAM, np.sqrt(covariance[6, 6]), motion, limits)


def _scatter(*rates_cam):
    return sum(np.outer(R_IMU_CAM @ np.array(w), R_IMU_CAM @ np.array(w)) for w in rates_cam)


def test_guidance_names_the_optical_axis_and_another_rotation():
    found = _weak(_covariance(arm=(1e-3, 1e-3, 0.5)), _scatter((0, 0, 0.7)))
    assert direction_line(found[0]) == (
        "lever arm along the optical axis: "
        "so far it turned about the optical axis only; rotate about another axis"
    )
    assert len(found) == 1


def test_guidance_says_nothing_when_all_is_known():
    assert _weak(_covariance(), _scatter((0.5, 0, 0), (0, 0.5, 0))) == []


def test_guidance_for_standing_still_slow_and_steady_motion():
    still = _weak(_covariance((1, 1, 1), (1, 1, 1), 1.0), 1e-6 * np.eye(3))
    assert len(still) == 7 and all(m.guidance.lack is Lack.STILL for m in still)
    slow = _weak(_covariance(arm=(0.01, 1e-3, 1e-3)), 0.005 * np.eye(3))
    assert slow[0].guidance.verb is Verb.TURN_FASTER and axis_name(slow[0].axis_cam) == "the image's x axis"
    steady = _weak(_covariance(shift=0.01), _scatter((0, 0.7, 0)), 0.01)
    assert steady[0].guidance.verb is Verb.TURN_TO_AND_FRO and steady[0].block is Block.TIMESHIFT
    tilted = _weak(
        _covariance(rotation=(1e-3, 0.2, 1e-3)),
        _scatter((0, 0.7, 0)),
        limits=ConvergenceTargets(rotation_rad=0.01),
    )
    assert "image's y axis" in direction_line(tilted[0])


def test_axes_in_words():
    assert axis_name(np.array([0, 0, -2.0])) == "the optical axis"
    assert "between" in axis_name(np.array([1.0, 1.0, 0.0]))
    assert "oblique" in axis_name(np.array([1.0, 1.0, 1.0]))


def _turned(rates, dt=0.01):
    motion = RunningMotion(memory_s=5.0)
    for k, rate in enumerate(rates):
        motion.add(k * dt, rate)
    return motion


def test_running_motion_forgets_and_is_not_fooled_by_noise_or_bias():
    rng, bias = np.random.default_rng(0), np.array([0.02, -0.03, 0.01])
    steady = np.tile([0.0, 0.0, 0.7], (1500, 1)) + rng.normal(0, 5.2e-3, (1500, 3)) + bias
    motion = _turned(steady)
    np.testing.assert_allclose(motion.scatter(bias), np.diag([0, 0, 0.49]), atol=2e-3)
    assert motion.rate_change_rps2 < 0.05
    t = np.arange(0, 30, 0.01)
    swinging = np.outer(np.sin(3 * t), [0.6, 0.0, 0.0])
    later = _turned(np.vstack((steady, swinging)))
    np.testing.assert_allclose(later.scatter(), np.diag([0.18, 0, 0]), atol=0.02)
    assert later.rate_change_rps2 == pytest.approx(0.6 * 3 / np.sqrt(2), rel=0.1)
    assert RunningMotion().rate_change_rps2 is None


def test_guidance_of_a_running_calibration_is_worst_first_and_speaks_of_the_motion_so_far():
    t = np.arange(0, 20, 0.01)
    about_optical = _turned(np.outer(0.7 * np.sin(2 * t), R_IMU_CAM[:, 2]))
    covariance = _covariance(arm=(1e-3, 1e-3, 0.05), rotation=(0.02, 1e-3, 1e-3))[:6, :6]
    found = weak_directions(covariance, R_IMU_CAM, 1e-4, about_optical, WIDE)
    assert [direction_name(g) for g in found] == [
        "lever arm along the optical axis",
        "rotation about the image's x axis",
    ]
    assert found[0].excess == pytest.approx(10.0) and direction_sigma(found[0]).endswith("±50.0 mm")
    assert (
        guidance_text(found[0].guidance)
        == "so far it turned about the optical axis only; rotate about another axis"
    )
    still = weak_directions(covariance, R_IMU_CAM, 1e-2, _turned(np.zeros((300, 3))), WIDE)
    assert direction_name(still[0]) == "time shift" and "turn the rig" in guidance_text(still[0].guidance)
    assert weak_directions(_covariance()[:6, :6], R_IMU_CAM, 1e-4, about_optical, WIDE) == []


def test_a_rich_motion_is_told_which_turns_show_the_missing_direction():
    t = np.arange(0, 20, 0.01)
    rich = _turned(np.stack([np.sin(2 * t), np.cos(3 * t), np.sin(1.5 * t)], axis=1))
    (arm,) = weak_directions(_covariance(arm=(1e-3, 1e-3, 0.2))[:6, :6], R_IMU_CAM, 1e-4, rich, WIDE)
    assert direction_name(arm) == "lever arm along the optical axis"
    assert arm.excess == pytest.approx(40.0) and "200.0 mm" in direction_sigma(arm)
    assert arm.guidance.axes == ("x", "y")
    assert (
        guidance_text(arm.guidance)
        == "rotate about the image's x axis (nod) and about the image's y axis (shake)"
    )
    (turn,) = weak_directions(_covariance(rotation=(1e-3, 1e-3, 0.1))[:6, :6], R_IMU_CAM, 1e-4, rich, WIDE)
    assert direction_name(turn) == "rotation about the optical axis" and "z" not in turn.guidance.axes
    late = weak_directions(_covariance(arm=(1e-3, 1e-3, 0.01))[:6, :6], R_IMU_CAM, 0.05, rich, WIDE)
    assert [direction_name(g) for g in late] == ["time shift", "lever arm along the optical axis"]
    assert "back and forth" in guidance_text(late[0].guidance)


@pytest.mark.parametrize(
    ("rate", "said"),
    [
        (lambda t: np.array([0.01, 0.0, 0.0]), "hardly turns"),
        (lambda t: np.array([np.sin(2 * t), 0.0, 0.0]), "about the image's x axis only"),
        (lambda t: np.array([0.5 * np.cos(0.25 * t), 0.5 * np.sin(0.25 * t), 0.2]), "hardly changes"),
        (lambda t: np.array([np.sin(2 * t), np.cos(3 * t), np.sin(1.5 * t)]), ""),
    ],
)
def test_a_poor_motion_is_told_as_a_whole(rate, said):
    motion = RunningMotion()
    for k in range(1500):
        motion.add(0.01 * k, rate(0.01 * k))
    words = guidance_text(excitation_advice(motion, np.eye(3)))
    assert said in words
    unnamed = guidance_text(
        excitation_advice(motion, None)
    )  # before the mounting is known no axis of the image can be named
    assert bool(unnamed) == bool(words)
    assert "image" not in unnamed
    assert bool(words) == bool(said)


def full_information(motion, setup, frames):
    """Of the unknowns and then of the places of all points; the derivatives by these from differences."""
    layout, n, h = block_layout(setup), len(setup.landmarks_m), 1e-6
    p = max(columns.stop for columns in layout.values())
    theta, _, position = pose_sensitivities(motion, layout, p)
    information = np.zeros((p + 3 * n, p + 3 * n))

    def pixels(points, k):
        in_imu = (points - motion.p_world_imu[k]) @ motion.R_world_imu[k]
        in_cam = (in_imu - setup.p_imu_cam) @ setup.R_imu_cam
        return project(in_cam, setup.intrinsics, setup.distortion, setup.model)

    for k in frames:
        ids, J = _frame_jacobian(motion, setup, layout, k, theta[k], position[k])
        by_place = np.zeros((len(ids), 2, n, 3))
        for axis, step in enumerate(h * np.eye(3)):
            points = setup.landmarks_m[ids]
            slope = (pixels(points + step, k) - pixels(points - step, k)) / (2.0 * h)
            by_place[np.arange(len(ids)), :, ids, axis] = slope
        whole = np.concatenate([J, by_place.reshape(len(J), 3 * n)], axis=1)
        information += whole.T @ whole
    return information / setup.corner_sigma_px**2, layout


def test_points_of_unknown_place_are_eliminated_as_in_the_full_information():
    motion, frames = _motion("general", 4.0), FRAMES[:30]
    A, blocks = full_information(motion, _setup(), frames)
    points = len(_setup().landmarks_m)
    seen = tuple(np.arange(points) for _ in frames)
    found = gramian(motion, _setup(seen=seen), frames)
    chosen = [name for name in found.blocks if name != "gravity"]
    columns = np.concatenate([np.r_[blocks[name]] for name in chosen])
    gravity = np.r_[blocks["gravity"]][:2]
    order = np.concatenate([np.r_[found.blocks[name]] for name in chosen] + [np.r_[found.blocks["gravity"]]])
    marks = np.arange(len(A) - 3 * points, len(A))
    at = np.concatenate([columns, gravity])
    seen_often = np.diag(A)[marks] > 0.0
    marks = marks[seen_often]
    H = (
        A[np.ix_(at, at)]
        - A[np.ix_(at, marks)]
        @ np.linalg.lstsq(A[np.ix_(marks, marks)], A[np.ix_(marks, at)], rcond=1e-13)[0]
    )
    got = found.information[np.ix_(order, order)]
    scale = np.sqrt(np.diag(H))
    assert found.rank == found.unknowns == 18
    assert np.abs((got - H) / np.outer(scale, scale)).max() < 1e-6
