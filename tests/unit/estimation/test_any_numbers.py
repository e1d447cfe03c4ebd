"""Whatever numbers come, an estimator answers with a verdict and never raises; nor does numpy warn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from vical_mocks.points import SimulatedRun, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import room_landmarks, simulate_tracks

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.plausible import MOST_MPS2, MOST_PX, MOST_RPS
from vical_daemon.estimation.result import Status
from vical_daemon.estimation.target_free import TargetFreeCalibrator

NUMBERS = np.array(
    [0, -0.0, 1e-300, 1, -1, 60, -300, 490, 1e3, -1e9, 1e30, 1e300, -1e300, np.nan, np.inf, -np.inf]
)
S = 10**9
AWAY = (0, 1, -1, 10**7, -(10**8), S, -S, 100 * S, -3600 * S)
ANYWHERE = (0, -S, 2**31 * S - 1, 2**62)


def prior(run: SimulatedRun) -> dict[str, CameraPrior]:
    lens = run.rig.lens
    return {"cam0": CameraPrior(lens.resolution, tuple(lens.intrinsics), lens.model, tuple(lens.distortion))}


def stream(run: SimulatedRun) -> list[tuple[int, int, Any]]:
    items: list[tuple[int, int, Any]] = [
        (int(t), 0, (w, f))
        for t, w, f in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True)
    ]
    items += [(f.t_cam_ns, 1, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px)) for f in run.frames]
    return sorted(items, key=lambda item: item[:2])


def disturb(c: Any, rng: np.random.Generator, now_ns: int, most: int) -> None:
    """Hand one message of nonsense to an estimator: impossible values, or possible ones that are not true."""
    stamp = int(rng.choice(ANYWHERE)) if rng.random() < 0.3 else now_ns + int(rng.choice(AWAY))
    n = int(rng.integers(0, 40))
    sigma = rng.choice(NUMBERS, n) if rng.random() < 0.5 else None
    way = rng.integers(0, 5)
    if way == 0:
        c.add_imu(stamp, rng.choice(NUMBERS, 3), rng.choice(NUMBERS, 3))
    elif way == 1:
        c.add_imu(stamp, rng.uniform(-MOST_RPS, MOST_RPS, 3), rng.uniform(-MOST_MPS2, MOST_MPS2, 3))
    elif way == 2:
        ids = rng.integers(-2, most + 9, n)
        c.add_points(PointsFrame("cam0", stamp, ids, rng.choice(NUMBERS, (n, 2)), sigma))
    elif way == 3:
        ids, uv = rng.permutation(most)[:n], rng.uniform(-20, 700, (n, 2))
        c.add_points(PointsFrame("cam0", stamp, ids, uv[: len(ids)]))
    else:
        c.stamps_known_to(float(rng.choice(NUMBERS)))
    c.process()


def calibrate(c: Any, items: list[tuple[int, int, Any]], seed: int, share: float, most: int) -> Any:
    """Feed a recording, and nonsense before some of its items."""
    rng = np.random.default_rng(seed)
    for k, (stamp, kind, content) in enumerate(items):
        if rng.random() < share:
            disturb(c, rng, stamp, most)
        if kind:
            c.add_points(content)
            c.process()
        else:
            c.add_imu(stamp, *content)
        if k % 50 == 0:
            c.estimate()
    c.finish()
    return c.estimate()


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return simulate(5, 12.0, timeshift_cam_imu_s=-0.035, camera_rate_hz=10.0)


@pytest.mark.parametrize(("seed", "share"), [(0, 0.3), (1, 0.05), (2, 0.01)])
def test_with_a_target(run: SimulatedRun, seed: int, share: float) -> None:
    options = CalibrationOptions(fix=frozenset({"intrinsics"}))
    calibrator = Calibrator(options, prior(run), run.points_m)
    assert isinstance(calibrate(calibrator, stream(run), seed, share, 48).status, Status)


@pytest.mark.parametrize(("seed", "share"), [(3, 0.1), (4, 0.01)])
def test_without_a_target(seed: int, share: float) -> None:
    rig = reference_rig(3, timeshift_cam_imu_s=0.01)
    run = simulate_tracks(3, 6.0, rig=rig, landmarks_m=room_landmarks(3, 120), camera_rate_hz=10.0)
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), target_free=True)
    calibrator = TargetFreeCalibrator(options, prior(run))
    assert isinstance(calibrate(calibrator, stream(run), seed, share, 200).status, Status)


def test_impossible_readings_change_nothing(run: SimulatedRun) -> None:
    """One well-formed reading of 1e300 rad/s once raised LinAlgError out of the start."""
    values = [1e300, -1e300, 1e30, 1e5, np.nan, np.inf]
    answers = []
    for disturbed in (False, True):
        c = Calibrator(CalibrationOptions(fix=frozenset({"intrinsics"})), prior(run), run.points_m)
        for k, (stamp, kind, content) in enumerate(stream(run)[:500]):
            if disturbed and k % 50 == 25:
                value = values[k // 50 % len(values)]
                c.add_imu(stamp + 1, (value, 0.0, 0.0), (0.0, 0.0, 9.8))
                c.add_imu(stamp + 1, (0.0, 0.0, 0.0), (0.0, value, 9.8))
                c.add_points(PointsFrame("cam0", stamp + 1, np.arange(3), np.full((3, 2), value)))
                c.stamps_known_to(value)
            if kind:
                c.add_points(content)
                c.process()
            else:
                c.add_imu(stamp, *content)
        answers.append(c.estimate().cameras["cam0"])
    assert c.left_out["imu_refused"] == 20
    assert answers[1] == answers[0]


def test_one_impossible_point_leaves_the_others_of_its_image(run: SimulatedRun) -> None:
    frame = run.frames[5]
    ids, uv = np.append(frame.ids, [frame.ids[0], 10**9]), np.vstack([frame.uv_px, [[9e9, 0], [1, 1]]])
    sigma = np.full(len(ids), 0.5)
    sigma[0] = 1e-300
    c = Calibrator(CalibrationOptions(), prior(run), run.points_m)
    c.add_imu(int(run.t_imu_ns[0]), (0.0, 0.0, 0.1), (0.0, 0.0, 9.8))
    c.add_points(PointsFrame("cam0", frame.t_cam_ns, ids, uv, sigma))
    ((_, kept),) = c._pending.take_all()
    assert kept.ids.tolist() == frame.ids.tolist()[1:]
    assert MOST_PX < 9e9
