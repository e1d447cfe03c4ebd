"""The score of lever arms and size: against differences of log det S of an ordinary filter, written apart."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.filter.lever_arm_score import MOTION_ERRORS, LeverArmScore, information
from vical_daemon.estimation.model.retract import difference
from vical_daemon.estimation.model.state import CameraState, State, make_layout

STEPS = 6


def cross_matrix(v):
    return np.cross(v, np.eye(3)).T


def journey(seed):
    """Slopes, noise and what images say, two cameras in turn."""
    rng = np.random.default_rng(seed)
    for k in range(STEPS):
        slopes = np.eye(9, MOTION_ERRORS) + 0.1 * rng.standard_normal((9, MOTION_ERRORS))
        root = 1e-3 * rng.standard_normal((9, 9))
        ways = 300.0 * rng.standard_normal((8, 6))
        to_cam = Rotation.random(random_state=seed + k).as_matrix()
        yield slopes, root @ root.T, 1e-8 * np.arange(1.0, 7.0), ways, to_cam, k % 2


def by_motion(to_cam, arm_m):
    """Turn and move of a camera, in its frame, by attitude (local) and position; the world is the imu's."""
    out = np.zeros((6, MOTION_ERRORS))
    out[:3, :3], out[3:, :3], out[3:, 3:6] = to_cam, -to_cam @ cross_matrix(arm_m), to_cam
    return out


def log_det_s(seed, arms, size=1.0):
    """Of all innovations of whitened pixels, by the textbook's filter; a pixel is a move over the size."""
    P, total = 1e-4 * np.eye(MOTION_ERRORS), 0.0
    for slopes, Q, walk, ways, to_cam, at in journey(seed):
        F, added = np.eye(MOTION_ERRORS), np.zeros((MOTION_ERRORS, MOTION_ERRORS))
        F[:9], added[:9, :9], added[9:, 9:] = slopes, Q, np.diag(walk)
        P = F @ P @ F.T + added
        H = ways @ np.diag([1.0] * 3 + [1.0 / size] * 3) @ by_motion(to_cam, arms[at])
        S = H @ P @ H.T + np.eye(len(H))
        P = P - P @ H.T @ np.linalg.solve(S, H @ P)
        total += np.linalg.slogdet(S)[1]
    return total


@pytest.mark.parametrize("seed", range(3))
def test_score_is_half_the_derivative_of_log_det(seed):
    arms = np.array([[0.1, -0.05, 0.02], [-0.2, 0.0, 0.07]])
    followed, score = LeverArmScore.of(1e-4 * np.eye(MOTION_ERRORS), 2), np.zeros(7)
    for slopes, Q, walk, ways, to_cam, at in journey(seed):
        followed.predict(slopes, Q, walk)
        score += followed.update(ways.T @ ways, by_motion(to_cam, arms[at]), to_cam, at)
    step = 1e-4
    slope = (log_det_s(seed, arms, 1.0 + step) - log_det_s(seed, arms, 1.0 - step)) / (2.0 * step)
    assert score[6] == pytest.approx(0.5 * slope, rel=0.01)
    for i in range(6):
        moved = step * np.eye(6)[i].reshape(2, 3)
        slope = (log_det_s(seed, arms + moved) - log_det_s(seed, arms - moved)) / (2.0 * step)
        assert score[i] == pytest.approx(0.5 * slope, abs=0.02 * np.abs(score[:6]).max())


def scaled(factor):
    """A rig, with all lengths and forces times a factor."""
    rng = np.random.default_rng(5)
    cameras = {
        name: CameraState(
            np.eye(3), factor * rng.normal(size=3), 0.0, 500.0 * np.ones(4), np.zeros(4), "radtan", (640, 480)
        )
        for name in ("cam0", "cam1")
    }
    p, v, gravity = factor * rng.normal(size=(3, 3))
    matrix = factor * (np.eye(3) + np.tril(0.1 * rng.normal(size=(3, 3))))
    biases = rng.normal(size=(2, 3))
    return State(
        0.0, np.eye(3), p, v, *biases, gravity, cameras, np.eye(3), matrix, target_scale=1.1 * factor
    )


def test_no_image_shows_a_factor_common_to_target_rig_gravity_and_accelerometer():
    estimate = frozenset({"imu_intrinsics", "target_scale"})
    layout = make_layout({"cam0": "radtan", "cam1": "radtan"}, fix=frozenset(), estimate=estimate)
    step = 1e-4
    grown = difference(scaled(1.0 + step), scaled(1.0), layout) / step
    score = np.array([1.9, -0.3, 0.2, 2.1, 0.1, -0.4, -0.8])
    out = information(score, scaled(1.0), layout)
    assert np.abs(out * grown).max() > 0.1
    assert out @ grown == pytest.approx(0.0, abs=1e-9)
