"""Without a target, after a change of the rig: what changed is found and announced, and the rest is kept."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.rig import Bump, reference_rig
from vical_mocks.tracks import room_landmarks, simulate_tracks

from benchmarks import gaps
from tests.unit.estimation.some_layout import window_layout
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.estimation.smoother.changed_blocks import changed_blocks, clock, mounting

DISTURBANCES = {
    EventKind.IMU_GAP,
    EventKind.IMAGE_GAP,
    EventKind.TIMESHIFT_STEPPED,
    EventKind.STAMPS_STEPPED,
    EventKind.IMU_CLOCK_SET_BACK,
    EventKind.STAMP_JITTER,
}
BUMPS = {EventKind.BUMPED, EventKind.STARTED_OVER, EventKind.CAMERA_MOVED, EventKind.CAMERA_TURNED}


def recorded(case, seed):
    return gaps.recorded(case, seed, lens_known=False, target_free=True)


def kinds_after(record, t_s=gaps.AT_S):
    return [e.kind for t, e in record.events if t >= t_s]


@pytest.fixture(scope="module")
def undisturbed():
    return recorded(gaps.UNDISTURBED, 1)


@pytest.mark.parametrize("case", [c for c in gaps.CASES if "clock" in c])
def test_a_clock_that_is_set_moves_the_time_shift_alone(case, undisturbed):
    record = recorded(case, 1)
    kinds = kinds_after(record)
    assert sum(kind in DISTURBANCES for kind in kinds) == 1, kinds
    assert not BUMPS & set(kinds)
    judged = gaps.judged(record, case)
    assert judged["was_converged"]
    assert judged["lies"] == []
    assert record.snapshots[-1].status == "converged"
    apart_m = record.snapshots[-1].error[:3] - undisturbed.snapshots[-1].error[:3]
    assert np.linalg.norm(apart_m) < 3e-4


def test_a_bump_in_a_gap_is_announced_and_the_time_shift_is_kept():
    case = "bump in a gap of 5 s"
    record = recorded(case, 1)
    judged = gaps.judged(record, case)
    assert judged["bumped_s"] < 3.0
    assert judged["lies"] == []
    assert EventKind.TIMESHIFT_CHANGED not in kinds_after(record)
    moved = next(e.value for _, e in record.events if e.kind is EventKind.CAMERA_MOVED)
    turned = next(e.value for _, e in record.events if e.kind is EventKind.CAMERA_TURNED)
    assert moved == pytest.approx(0.01, abs=3e-3)
    assert turned == pytest.approx(np.deg2rad(2.0), abs=np.deg2rad(0.2))
    shifts = [np.sqrt(s.covariance[6, 6]) for s in record.snapshots if s.t_s > gaps.AT_S - 1.0]
    assert max(shifts) < 2.0 * shifts[0]


def followed(run):
    prior = camera_prior(run, 3, StartErrors(), exact_lens=True)
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), target_free=True, imu_noise=imu_noise(run))
    return feed(run, CalibratorSubject(options, prior, None), 0.25)


def test_a_bump_while_all_is_seen_is_announced_soon():
    rig = reference_rig(
        3, timeshift_cam_imu_s=0.01, bumps=(Bump(14.3, (0.0, 0.03, 0.01), (0.0, 0.004, 0.0)),)
    )
    record = followed(simulate_tracks(3, 26.0, rig=rig, landmarks_m=room_landmarks(3, 200)))
    announced = [t for t, e in record.events if e.kind is EventKind.BUMPED]
    assert len(announced) == 1
    assert 14.3 < announced[0] < 20.0
    for shot in record.snapshots:
        if shot.status == "converged" and not 14.3 < shot.t_s < 17.3:
            assert np.max(np.abs(shot.error[:7]) / np.sqrt(np.diag(shot.covariance)[:7])) < 5.0, shot.t_s
    assert record.snapshots[-1].status == "converged"


def test_a_bump_too_small_for_two_seconds_is_found_all_the_same():
    rig = reference_rig(
        5, timeshift_cam_imu_s=0.01, bumps=(Bump(14.0, (0.004, 0.0, 0.0), (0.0, 0.005, 0.0)),)
    )
    record = followed(simulate_tracks(5, 28.0, rig=rig, landmarks_m=room_landmarks(5, 200)))
    announced = [t for t, e in record.events if e.kind is EventKind.BUMPED]
    assert len(announced) == 1
    for shot in record.snapshots:
        if shot.status == "converged" and not 14.0 <= shot.t_s < 17.0:
            assert np.max(np.abs(shot.error[:7]) / np.sqrt(np.diag(shot.covariance)[:7])) < 5.0, shot.t_s
    assert record.snapshots[-1].status == "converged"


@pytest.mark.parametrize("seed", [3, 4])
def test_biases_that_step_are_no_bump(seed):
    """No window fitted for 15 s; then `bumped` was announced, and all was estimated again."""
    rng = np.random.default_rng([seed, 5])
    rig = reference_rig(seed)
    rig = replace(rig, gyro_bias=rig.gyro_bias.with_step(14.0, np.deg2rad(0.4) * rng.standard_normal(3)))
    rig = replace(rig, accel_bias=rig.accel_bias.with_step(14.0, 0.05 * rng.standard_normal(3)))
    run = simulate_tracks(seed, 24.0, rig=rig, landmarks_m=room_landmarks(seed, 200))
    record = followed(run)
    kinds = kinds_after(record, 0.0)
    assert kinds.count(EventKind.BIASES_STEPPED) == 1 and not BUMPS & set(kinds)
    last = record.snapshots[-1]
    assert last.status == "converged"
    assert (np.abs(last.error[:7]) < 4.0 * np.sqrt(np.diag(last.covariance)[:7])).all()


def test_a_crowd_that_walks_past_is_no_bump():
    run = simulate_tracks(
        4, 24.0, rig=reference_rig(4, timeshift_cam_imu_s=0.01), landmarks_m=room_landmarks(4, 200)
    )
    rng = np.random.default_rng(4)
    way = rng.normal(0.0, 60.0, (1000, 2))  # px/s
    frames = []
    for f in run.frames:
        walks = (f.ids % 10 < 3) & (f.t_s > 14.0) & (f.t_s < 18.0)
        shift = np.where(walks[:, None], (f.t_s - 14.0) * way[f.ids % 1000], 0.0)
        frames.append(replace(f, uv_px=f.uv_px + shift))
    record = followed(replace(run, frames=frames))
    assert not (BUMPS | {EventKind.TIMESHIFT_STEPPED}) & set(kinds_after(record, 0.0))
    assert record.snapshots[-1].status == "converged"


# ---------------------------------------------------------------------- arithmetic
LAYOUT = window_layout(estimate=())
MOUNTING, CLOCK = mounting(LAYOUT), clock(LAYOUT)
BOTH = MOUNTING + CLOCK


def spd(rng, n):
    A = rng.standard_normal((n, n + 3))
    return A @ A.T


def answers(rng, moved, layout=LAYOUT):
    """A prior over x (as `moved`) and the rest r, a true rig, and what a window says that knows r before."""
    n, k = layout.size - layout.dynamic, len(moved)
    known = spd(rng, n)
    true = np.linalg.cholesky(known) @ rng.standard_normal(n)
    true[:k] += moved
    H = rng.standard_normal((40, n))
    y = H @ true + rng.standard_normal(40)
    information = H.T @ H
    information[k:, k:] += np.linalg.inv(known[k:, k:])
    P = np.linalg.inv(information)
    found = np.concatenate([np.zeros(layout.dynamic), P @ H.T @ y])
    covariance, prior = np.eye(layout.size), np.eye(layout.size)
    covariance[layout.dynamic :, layout.dynamic :], prior[layout.dynamic :, layout.dynamic :] = P, known
    return found, covariance, prior


def excess(square, dof):
    return square / chi2.isf(1e-5, dof)


@pytest.mark.parametrize(
    ("moved", "said"),
    [
        (np.zeros(7), ()),
        (100.0 * np.eye(7)[6], CLOCK),
        (100.0 * np.eye(7)[1], MOUNTING),
        (100.0 * np.eye(7)[4], MOUNTING),
        (np.full(7, 100.0), BOTH),
    ],
)
def test_the_block_that_changed_is_named(moved, said):
    for seed in range(20):
        found, covariance, prior = answers(np.random.default_rng(seed), moved)
        assert changed_blocks(found, covariance, prior, LAYOUT, excess) == said


def test_what_has_not_changed_gives_a_chi_square_variable():
    squares = []

    def listen(square, dof):
        assert dof == 7
        squares.append(square)
        return 0.0

    for seed in range(400):
        changed_blocks(*answers(np.random.default_rng(seed), np.zeros(7)), LAYOUT, listen)
    assert np.mean(squares) == pytest.approx(7.0, abs=5.0 * np.sqrt(14.0 / 400.0))


def test_what_is_held_fixed_never_changed():
    layout = window_layout(fix=("extrinsics",), estimate=())
    found, covariance, prior = answers(np.random.default_rng(3), np.array([100.0]), layout)
    assert changed_blocks(found, covariance, prior, layout, excess) == clock(layout)
