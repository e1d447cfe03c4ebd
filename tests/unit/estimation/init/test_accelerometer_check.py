"""Wrong signs and axes of an accelerometer, and mirrored images, are named; sound data are not."""

from __future__ import annotations

import numpy as np
import pytest
from vical_mocks.rig import reference_rig

from vical_daemon.estimation.init.accelerometer_check import explain_accelerometer


def data(seed: int, seconds: float = 20.0) -> tuple[np.ndarray, ...]:
    """A simulated rig with noise: stamps and forces of the imu, instants and poses of the camera, mounting.

    Its board is printed on the side from which z points away.
    """
    rig = reference_rig(seed=seed)
    rng = np.random.default_rng(seed)
    t_imu_s = np.arange(0.0, seconds, 0.005)
    _, force = rig.imu_reading(t_imu_s)
    force = force + rng.normal(0.0, 0.05, force.shape) + rng.normal(0.0, 0.1, 3)
    t_s = np.arange(0.2, seconds - 0.2, 0.05)
    R, p = rig.camera_pose_target(t_s)
    R_imu_cam = rig.extrinsics_at(0.0)[0]
    return t_imu_s, force, t_s, R, p + rng.normal(0.0, 3e-4, p.shape), R_imu_cam.reshape(3, 3)


@pytest.mark.parametrize("seed", range(5))
def test_sound_data_raise_no_suspicion(seed: int) -> None:
    assert explain_accelerometer(*data(seed)) == ""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        (-np.eye(3), "either the accelerometer reports gravity"),
        (np.eye(3)[[1, 2, 0]], "(z, x, y)"),
        (np.diag([1.0, -1.0, -1.0]), "(x, -y, -z)"),
        (np.diag([-1.0, 1.0, 1.0]), "(-x, y, z)"),
        (np.eye(3)[[1, 0, 2]], "(y, x, z)"),
    ],
)
def test_the_mistake_is_named_with_what_undoes_it(seed: int, mapping: np.ndarray, words: str) -> None:
    t_imu_s, force, *rest = data(seed)
    assert words in explain_accelerometer(t_imu_s, force @ mapping.T, *rest)


@pytest.mark.parametrize("seed", range(3))
def test_mirrored_images_look_like_a_negated_accelerometer_but_for_the_side_of_the_board(seed: int) -> None:
    t_imu_s, force, t_s, R, p, mounting = data(seed)
    reason = explain_accelerometer(t_imu_s, -force, t_s, R, p, mounting, front_is_up=False)
    assert reason.endswith("negate all three of its axes")
    board, image = np.diag([1.0, 1.0, -1.0]), np.diag([-1.0, 1.0, 1.0])
    as_fitted = mounting @ np.diag([1.0, -1.0, -1.0])
    reason = explain_accelerometer(
        t_imu_s, force, t_s, board @ R @ image, p @ board, as_fitted, front_is_up=False
    )
    assert reason.startswith("the images are mirrored")


@pytest.mark.parametrize("count", [0, 1, 5, 30])
def test_too_few_images_say_nothing(count: int) -> None:
    t_imu_s, force, t_s, R, p, mounting = data(1)
    part = slice(0, count)
    assert explain_accelerometer(t_imu_s, -force, t_s[part], R[part], p[part], mounting) == ""


def test_a_rig_at_rest_says_nothing() -> None:
    t_imu_s, force, t_s, R, p, mounting = data(1)
    rng = np.random.default_rng(9)
    still = np.broadcast_to(R[0], R.shape)
    there = p[0] + rng.normal(0.0, 3e-4, p.shape)
    resting = force[0] + rng.normal(0.0, 0.05, force.shape)
    assert explain_accelerometer(t_imu_s, -resting, t_s, still, there, mounting) == ""
