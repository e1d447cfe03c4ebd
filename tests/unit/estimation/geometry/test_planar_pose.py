"""planar_pose.py: both solutions against truth and OpenCV, its covariance against scatter."""

import cv2
import numpy as np
import pytest

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.planar_pose import planar_poses

SIGMA = 0.3 / 460


def planar_pose(points_m, xy, sigma=None):
    """Of one view."""
    return planar_poses([points_m], [xy], sigma)[0]


def _board(columns=12, rows=12, size=0.03):
    x, y = np.meshgrid(np.arange(columns) * size, np.arange(rows) * size)
    return np.column_stack((x.ravel(), y.ravel(), np.zeros(columns * rows)))


def _image(board, R, p):
    q = board @ R.T + p
    return q[:, :2] / q[:, 2:]


def _random_pose(rng, tilt=0.9):
    v = rng.uniform(-1, 1, 3) * np.array([tilt, tilt, 3.0])
    return so3.exp(v), np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(0.6, 1.5)])


def test_exact_points_give_the_exact_pose():
    rng = np.random.default_rng(1)
    board = _board()
    for _ in range(50):
        R, p = _random_pose(rng)
        best = planar_pose(board, _image(board, R, p)).candidates[0]
        assert np.linalg.norm(so3.log(R.T @ best.R_cam_target)) < 1e-8
        assert np.linalg.norm(best.p_cam_target - p) < 1e-9
        assert best.rms < 1e-9


def test_errors_agree_with_the_covariance_that_is_claimed():
    rng = np.random.default_rng(2)
    board = _board(8, 6, 0.05)
    nees = []
    for _ in range(300):
        R, p = _random_pose(rng)
        result = planar_pose(board, _image(board, R, p) + rng.normal(0, SIGMA, (48, 2)), SIGMA)
        if result.ambiguous:
            continue
        best = result.candidates[0]
        error = np.concatenate((p - best.p_cam_target, so3.log(best.R_cam_target.T @ R)))
        nees.append(error @ np.linalg.solve(best.covariance, error))
    assert len(nees) > 270
    assert np.mean(nees) == pytest.approx(6.0, abs=4 * np.sqrt(12 / len(nees)))


def test_the_refined_poses_are_the_minima_that_opencv_finds():
    rng = np.random.default_rng(3)
    board = _board(7, 5, 0.04)
    for _ in range(30):
        R, p = _random_pose(rng)
        xy = _image(board, R, p) + rng.normal(0, SIGMA, (35, 2))
        best = planar_pose(board, xy).candidates[0]
        _, r, t = cv2.solvePnP(board, xy, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
        r, t = cv2.solvePnPRefineLM(board, xy, np.eye(3), np.zeros(4), r, t)
        theirs = np.sqrt(np.mean((_image(board, so3.exp(r[:, 0]), t[:, 0]) - xy) ** 2))
        assert best.rms <= theirs * (1 + 1e-6)


def test_a_small_distant_board_is_called_ambiguous_and_both_poses_are_given():
    rng = np.random.default_rng(4)
    board = _board(6, 4, 0.01)
    hits = 0
    for _ in range(40):
        R = so3.exp(np.array([0.35, 0.1, 0.2]))
        p = np.array([0.0, 0.0, 1.5])
        result = planar_pose(board, _image(board, R, p) + rng.normal(0, SIGMA, (24, 2)))
        assert result.ambiguous and len(result.candidates) == 2
        near = min(np.linalg.norm(so3.log(R.T @ c.R_cam_target)) for c in result.candidates)
        hits += near < 0.2
    assert hits >= 38


def test_a_large_close_board_is_not():
    rng = np.random.default_rng(5)
    board = _board(8, 6, 0.05)
    R, p = so3.exp(np.array([0.5, -0.3, 0.2])), np.array([-0.1, -0.1, 0.6])
    assert not planar_pose(board, _image(board, R, p) + rng.normal(0, SIGMA, (48, 2))).ambiguous


def test_a_frontal_board_at_the_centre_needs_no_luck():
    board = _board(8, 6, 0.05) - np.array([0.175, 0.125, 0.0])
    result = planar_pose(board, _image(board, np.eye(3), np.array([0.0, 0.0, 0.7])))
    assert np.linalg.norm(so3.log(result.candidates[0].R_cam_target)) < 1e-4
    np.testing.assert_allclose(result.candidates[0].p_cam_target, [0, 0, 0.7], atol=1e-7)


def test_too_few_points_a_line_and_points_at_one_place_have_no_pose():
    board = _board(8, 6, 0.05)
    xy = _image(board, np.eye(3), np.array([0.0, 0.0, 0.7]))
    assert planar_pose(board[:3], xy[:3]).candidates == ()
    assert planar_pose(board[:8], xy[:8]).candidates == ()
    assert planar_pose(board, np.zeros_like(xy)).candidates == ()
    xy[5:] = np.nan
    assert planar_pose(board, xy).candidates == ()


def test_four_corners_suffice():
    board = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.15, 0], [0, 0.15, 0.0]])
    R, p = so3.exp(np.array([0.5, -0.4, 0.3])), np.array([0.05, 0.02, 0.5])
    result = planar_pose(board, _image(board, R, p), sigma=1e-4)
    assert np.linalg.norm(so3.log(R.T @ result.candidates[0].R_cam_target)) < 1e-6


def test_views_of_a_batch_are_what_each_is_alone():
    rng = np.random.default_rng(9)
    board = _board()
    points, views = [], []
    for k in range(150):
        chosen = np.sort(rng.choice(len(board), rng.integers(4, 60), replace=False))
        R, p = _random_pose(rng)
        points.append(board[chosen])
        views.append(_image(board[chosen], R, p) + rng.normal(0, SIGMA, (len(chosen), 2)))
        if k % 7 == 0:
            views[-1][:3] = np.nan  # with four points, too few are left
        if k % 11 == 0:
            views[-1][:] = 0.1
    assert planar_poses([], []) == []
    for together, xy, seen in zip(planar_poses(points, views), points, views, strict=True):
        alone = planar_pose(xy, seen)
        assert together.ambiguous == alone.ambiguous
        for one, other in zip(together.candidates, alone.candidates, strict=True):
            np.testing.assert_allclose(one.R_cam_target, other.R_cam_target, atol=1e-6)
            np.testing.assert_allclose(one.p_cam_target, other.p_cam_target, atol=1e-6)
