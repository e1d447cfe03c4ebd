"""The score of lever arms and size: against differences of log det S of an ordinary filter, written apart."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.filter.lever_arm_score import MOTION_ERRORS, LeverArmScore

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
