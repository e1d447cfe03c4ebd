"""The estimator of `benchmarks speed`: images with and without a board, inertial readings, the start."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from vical_mocks.harness.feed import (
    CalibratorSubject,
    StartErrors,
    camera_prior,
    events_in_order,
    imu_noise,
    points_frame,
)
from vical_mocks.points import SimulatedFrame, SimulatedRun, board_points, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import room_landmarks, simulate_tracks

from vical_daemon.estimation.inertial.imu_intake import ImuIntake
from vical_daemon.estimation.measurements import CalibrationOptions

SEED = 5
STARTED_S = 8.0
"""By then both estimators have started."""
BOARDS = {54: board_points(9, 6, 0.05), 132: board_points(12, 11, 0.035)}
TRACKS = (36, 70, 140)
LANDMARKS_A_TRACK = 3  # about a third of a room is in view at a time
READINGS = 10_000


class Cost(NamedTuple):
    """What one recording took.

    Attributes:
        points: Corners or tracks in an image, on average.
        start_s: All that was done until the start, s.
        images_ms: Each image after it, ms.
    """

    points: float
    start_s: float
    images_ms: list[float]


def run(frames: int) -> None:
    """Print the tables; at least six seconds follow the start, a whole window without a target."""
    duration_s = STARTED_S + max(frames / 20.0, 6.0)
    print(
        "\n| estimator | points an image | start s | an image, median ms | mean ms |\n|---|---|---|---|---|"
    )
    for name, cost in _costs(duration_s):
        each = cost.images_ms
        median = "-" if "target-free" in name else f"{np.median(each):.2f}"  # most images only wait there
        spent = f"{cost.start_s:.2f} | {median} | {np.mean(each):.2f}"
        print(f"| {name} | {cost.points:.0f} | {spent} |", flush=True)
    print(f"\nIntake of an inertial reading: {_reading_us():.0f} us.")


def _costs(duration_s: float) -> Iterable[tuple[str, Cost]]:
    for corners, points_m in BOARDS.items():
        board = simulate(SEED, duration_s, points_m=points_m, timeshift_cam_imu_s=-0.035)
        for lens in ("free", "known"):
            yield (
                f"board of {corners} corners, lens {lens}",
                _followed(board, points_m, known=lens == "known"),
            )
    for tracks in TRACKS:
        room = simulate_tracks(
            SEED,
            duration_s,
            rig=reference_rig(SEED, timeshift_cam_imu_s=0.01),
            landmarks_m=room_landmarks(SEED, LANDMARKS_A_TRACK * tracks),
            max_features=tracks,
        )
        yield f"target-free, {tracks} tracks", _followed(room, None, known=False)


def _followed(run: SimulatedRun, points_m: np.ndarray | None, *, known: bool) -> Cost:
    """Follow a recording; without a target most images cost little, and one in some thirty costs most."""
    options = CalibrationOptions(
        target_free=points_m is None,
        fix=frozenset({"intrinsics"}) if known else frozenset(),
        imu_noise=imu_noise(run),
    )
    prior = camera_prior(run, SEED, StartErrors(), exact_lens=known)
    subject = CalibratorSubject(options, prior, points_m)
    clock_s = _clock_s()
    start_s, images_ms = 0.0, []
    for t_s, event in events_in_order(run):
        if not isinstance(event, SimulatedFrame):
            subject.add_imu(int(run.t_imu_ns[event]), run.gyro_rps[event], run.specific_force_mps2[event])
            continue
        begin = time.process_time()
        subject.add_points(points_frame(event))
        spent_s = time.process_time() - begin - clock_s
        if t_s < STARTED_S:
            start_s += spent_s
        else:
            images_ms.append(1e3 * spent_s)
    return Cost(float(np.mean([len(f.ids) for f in run.frames])), start_s, images_ms)


def _clock_s() -> float:
    """What it takes to ask for the CPU time, s: up to 0.1 ms."""
    times = [time.process_time() for _ in range(200)]
    return (times[-1] - times[0]) / (len(times) - 1)


def _reading_us() -> float:
    """CPU time that one reading takes, us."""
    rng = np.random.default_rng(SEED)
    six = rng.normal([0.0, 0.0, 0.0, 0.0, 0.0, 9.8], [0.3, 0.3, 0.3, 1.0, 1.0, 1.0], (READINGS, 6)).tolist()
    intake = ImuIntake()
    begin = time.process_time()
    for i, row in enumerate(six):
        intake.take(1_000_000 * i, row[:3], row[3:])
    return 1e6 * (time.process_time() - begin) / READINGS
