"""Without a target, a camera that moves by less than one window shows is noticed, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest
from vical_mocks.rig import Bump, reference_rig
from vical_mocks.tracks import room_landmarks, simulate_tracks

from tests.unit.estimation.smoother.test_changes import followed
from tests.unit.estimation.some_layout import window_layout
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.smoother.changed_blocks import (
    MountingWatch,
    newest_disagree,
    square_of_change,
)

WINDOW_SIGMA_M = 2e-3  # of one window alone
CAMERA = CameraState(
    np.eye(3), np.zeros(3), 0.0, np.array([500.0, 500.0, 320.0, 240.0]), np.zeros(4), "radtan", (640, 480)
)


def estimates(seed, count, move_m=0.0, at=0):
    """Lever arms of a recursive estimator, and its covariances; from window `at` on the camera has moved."""
    rng, layout = np.random.default_rng(seed), window_layout()
    where = layout.camera
    information, vector, out = 0.0, np.zeros(3), []
    for k in range(count):
        measured = WINDOW_SIGMA_M * rng.standard_normal(3) + (move_m if k >= at else 0.0) / np.sqrt(3.0)
        information, vector = information + WINDOW_SIGMA_M**-2, vector + measured * WINDOW_SIGMA_M**-2
        P = 1e-12 * np.eye(layout.size)
        P[where.position, where.position] = np.eye(3) / information
        out.append((replace(CAMERA, p_imu_cam=vector / information), P))
    return out, where


def moved(watch, camera, P, where, models="all"):
    """After a complete window: whether the mounting surely moved."""
    watch.compare(camera, P, 1.0, where, models)
    watch.window_done()
    return watch.surely


def test_the_square_of_an_honest_change_is_chi_square():
    squares = []
    for seed in range(400):
        ((old, before), *_, (new, after)), where = estimates(seed, 4)
        d, at = new.p_imu_cam - old.p_imu_cam, where.position
        square, dof = square_of_change(d, before[at, at], after[at, at])
        assert dof == 3
        squares.append(square)
    assert kstest(squares, "chi2", args=(3,)).pvalue > 0.01


def test_honest_estimates_are_never_surely_moved_and_rarely_doubted():
    surely, doubted = 0, 0
    for seed in range(100):
        watch = MountingWatch()
        shots, where = estimates(seed, 30)
        for camera, P in shots:
            surely += moved(watch, camera, P, where)
            doubted += watch.doubtful
    assert surely == 0
    assert doubted <= 6  # of 3000, five comparisons each at 6e-5: 0.9 are expected


@pytest.mark.parametrize(("move_m", "windows"), [(0.02, 2), (0.01, 4)])  # of 2 mm; larger ones show at once
def test_a_move_is_noticed_after_some_windows(move_m, windows):
    watch, (shots, where) = MountingWatch(), estimates(3, 20, move_m, at=10)
    surely = [moved(watch, camera, P, where) for camera, P in shots]
    assert not any(surely[:10])
    assert any(surely[10 : 10 + windows])


def test_a_move_within_the_stated_sigmas_is_doubted_but_not_certain():
    """Five of 24 stretches of EuRoC: 0.9 to 1.3 sigma where the covariances allow for a sixth of one."""
    layout = window_layout()
    where = layout.camera

    def after(moved_sigmas):
        watch = MountingWatch()
        for k, share in enumerate((1.0, 0.97)):
            P = 1e-12 * np.eye(layout.size)
            P[where.position, where.position] = share * 1e-6 * np.eye(3)
            p = np.array([1e-3 * moved_sigmas * k, 0.0, 0.0])
            moved(watch, replace(CAMERA, p_imu_cam=p), P, where)
        return watch

    assert after(1.3).doubtful and not after(1.3).surely
    assert after(3.0).surely


def test_answers_with_other_models_are_not_compared():
    watch, (shots, where) = MountingWatch(), estimates(3, 12, 0.02, at=11)
    for k, (camera, P) in enumerate(shots):
        assert not moved(watch, camera, P, where, "imu off" if k == 11 else "all")
    assert not watch.doubtful


def test_a_window_that_still_grows_is_held_against_complete_ones_only():
    watch, (shots, where) = MountingWatch(), estimates(3, 12, 0.02, at=11)
    for camera, P in shots[:-1]:
        assert not moved(watch, camera, P, where)
    for _ in range(3):
        watch.compare(*shots[-1], 1.0, where, "all")
        assert watch.doubtful
    watch.compare(*shots[-2], 1.0, where, "all")  # other images turned out to be outliers
    assert watch.doubtful
    watch.window_done()
    assert not watch.doubtful


def test_windows_that_agree_are_rarely_in_doubt_and_a_few_that_all_disagree_a_little_are():
    rng, dof = np.random.default_rng(5), 20
    honest = [[(s, dof) for s in rng.chisquare(dof, 8)] for _ in range(2000)]
    doubted = np.mean([newest_disagree(windows, max(1.0, mean_of(windows))) for windows in honest])
    assert doubted < 0.01  # five sums, each at 3e-3
    windows = [(20.0, dof)] * 7 + [(38.0, dof)] * 2
    assert not any(newest_disagree(windows[:k], 1.0) for k in range(9))  # 38: 9e-3
    assert newest_disagree(windows, 1.0) and not newest_disagree(windows, 1.2)  # windows of this rig disagree
    assert not newest_disagree([(60.0, dof)], 3.0)  # nothing to compare the first one with


def mean_of(windows):
    return sum(square for square, _ in windows) / sum(dof for _, dof in windows)


@pytest.mark.parametrize("seed", [11, 12])
def test_a_camera_that_moves_by_4_mm_is_noticed(seed):
    """It had stayed `converged` beyond 5 sigma for 20 s: each window by itself agreed with what was known."""
    rig = reference_rig(seed, bumps=(Bump(17.0, (0.0, 0.0, 0.0), (0.0025, -0.002, 0.0025)),))
    record = followed(simulate_tracks(seed, 36.0, rig=rig, landmarks_m=room_landmarks(seed, 200)))
    assert sum(e.kind is EventKind.BUMPED for _, e in record.events) == 1
    far = [
        shot.t_s
        for shot in record.snapshots
        if shot.status == "converged"
        and shot.t_s > 17.0
        and np.max(np.abs(shot.error[:7]) / np.sqrt(np.diag(shot.covariance)[:7])) > 5.0
    ]
    assert max(far, default=0.0) < 17.0 + 12.0
