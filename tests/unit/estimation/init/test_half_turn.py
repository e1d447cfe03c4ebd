"""Checkerboards that look the same upside down: points are numbered as in the images before."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from vical_mocks.points import SimulatedRun, simulate

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.init.numbering import HalfTurns
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.vision.target import AprilGrid, Checkerboard

POINTS = 48  # 8 x 6
OPTIONS = CalibrationOptions(fix=frozenset({"intrinsics"}), target_alike=True)


@cache
def a_run() -> SimulatedRun:
    return simulate(700, 20.0, camera_rate_hz=10.0)


def calibrate(upside_down, seen, options: CalibrationOptions = OPTIONS) -> CalibrationEstimate:
    """Calibrate from the images that are seen, numbered from the other end where they are upside down."""
    run = a_run()
    lens = run.rig.lens
    priors = {"cam0": CameraPrior((640, 480), tuple(lens.intrinsics), lens.model, tuple(lens.distortion))}
    c = Calibrator(options, priors, run.points_m)
    frames = iter([(k, f) for k, f in enumerate(run.frames) if seen(f.t_s)])
    k, frame = next(frames)
    for t, w, f in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True):
        c.add_imu(int(t), w, f)
        while frame is not None and frame.t_cam_ns <= t:
            ids = POINTS - 1 - frame.ids if upside_down(k, frame.t_s) else frame.ids
            order = np.argsort(ids)
            c.add_points(PointsFrame("cam0", frame.t_cam_ns, ids[order], frame.uv_px[order]))
            c.process()
            k, frame = next(frames, (0, None))
    c.finish()
    return c.estimate()


@cache
def undisturbed(gaps: bool) -> CalibrationEstimate:
    return calibrate(lambda *_: False, with_gaps if gaps else always)


def always(_: float) -> bool:
    return True


def with_gaps(t_s: float) -> bool:
    """Nothing for 1.5 s and for 0.6 s."""
    return not (11.0 < t_s < 12.5 or 15.0 < t_s < 15.6)


def test_images_that_flip_at_random() -> None:
    flip = np.random.default_rng(701).random(1000) < 0.3
    flip[0] = False
    assert calibrate(lambda k, _: flip[k], always).cameras == undisturbed(False).cameras


def test_a_detector_that_loses_the_board_and_finds_it_upside_down() -> None:
    found = calibrate(lambda _, t_s: 12.0 < t_s < 15.3, with_gaps)
    assert found.cameras == undisturbed(True).cameras


@pytest.mark.parametrize("turned", [False, True])
def test_images_that_show_other_parts_of_the_board(turned: bool) -> None:
    x, y = np.meshgrid(np.arange(8), np.arange(6))
    target = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1) * 0.05
    uv = target[:, :2] * 1000.0 + [100.0, 80.0] + np.random.default_rng(703).normal(0.0, 0.5, (POINTS, 2))
    left, right = np.flatnonzero(x.ravel() < 4), np.flatnonzero(x.ravel() >= 4)
    turns = HalfTurns(target, alike=True)
    turns.numbered(PointsFrame("cam0", 0, left, uv[left]), 0.0, None, None)
    ids = (POINTS - 1 - right)[::-1] if turned else right
    seen = uv[right][::-1] if turned else uv[right]
    found = turns.numbered(PointsFrame("cam0", 50_000_000, ids, seen + 3.0), 0.05, None, None)
    assert found.ids.tolist() == right.tolist() and np.allclose(found.uv_px, uv[right] + 3.0)


def test_ids_of_other_boards_are_kept() -> None:
    frame = PointsFrame("cam0", 0, np.arange(40), np.random.default_rng(702).uniform(0.0, 400.0, (40, 2)))
    turns = HalfTurns(np.zeros((40, 3)), alike=False)
    assert turns.numbered(frame, 0.0, None, None) is frame
    turned = replace(frame, t_cam_ns=10_000_000, ids=np.arange(40)[::-1])
    assert turns.numbered(turned, 0.01, None, None) is turned


@pytest.mark.parametrize("sigma", [True, False])
def test_a_turned_image_is_numbered_from_the_other_end(sigma: bool) -> None:
    x, y = np.meshgrid(np.arange(8), np.arange(6))
    target = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1) * 0.05
    uv = target[:, :2] * 1000.0 + [100.0, 80.0]
    sigmas = np.linspace(0.1, 0.4, POINTS) if sigma else None
    first = PointsFrame("cam0", 0, np.arange(POINTS), uv, sigmas)
    turns = HalfTurns(target, alike=True)
    assert turns.numbered(first, 0.0, None, None) is first
    ids = np.arange(POINTS)[10:]  # partly hidden
    back = None if sigmas is None else sigmas[::-1][10:]
    second = PointsFrame("cam0", 50_000_000, ids, uv[::-1][10:] + 3.0, back)
    found = turns.numbered(second, 0.05, None, None)
    assert found.ids.tolist() == list(range(POINTS - 10))
    assert np.allclose(found.uv_px, uv[: POINTS - 10] + 3.0)
    assert found.sigma_px is None if sigmas is None else np.allclose(found.sigma_px, sigmas[: POINTS - 10])
    late = replace(second, t_cam_ns=9_000_000_000)
    assert turns.numbered(late, 9.0, None, None) is late  # nothing to go by


def test_which_boards_look_the_same_upside_down() -> None:
    assert Checkerboard(8, 6, 0.05, 0.05).alike_upside_down
    assert not Checkerboard(8, 7, 0.05, 0.05).alike_upside_down
    assert not AprilGrid(6, 6, 0.088, 0.3).alike_upside_down
