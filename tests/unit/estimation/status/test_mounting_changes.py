"""After `bumped` it is reported what has changed, or that nothing has: then the target was moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import SimulatedRun, board_points, simulate
from vical_mocks.rig import Bump, reference_rig
from vical_mocks.rotations import exp_so3

from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.measurements import CalibrationOptions

AT_S = 10.0
MOVE_M, TURN_RAD = (0.008, -0.006, 0.0), (0.0, 0.025, -0.025)


def camera_knocked() -> SimulatedRun:
    return simulate(31, 25.0, rig=reference_rig(31, bumps=(Bump(AT_S, TURN_RAD, MOVE_M),)))


def board_knocked() -> SimulatedRun:
    rig, board = reference_rig(31), board_points()
    before, after = (
        simulate(31, 25.0, rig=rig, points_m=points)
        for points in (board, board @ exp_so3(TURN_RAD).T + MOVE_M)
    )
    frames = [f for f in before.frames if f.t_s < AT_S] + [f for f in after.frames if f.t_s >= AT_S]
    return replace(before, frames=frames)


def announced(run: SimulatedRun) -> dict[EventKind, Event]:
    prior = camera_prior(run, 31, StartErrors(), exact_lens=True)
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=imu_noise(run))
    record = feed(run, CalibratorSubject(options, prior, run.points_m))
    assert record.snapshots[-1].status == "converged"
    return {event.kind: event for _, event in record.events}


def test_what_a_knock_has_changed() -> None:
    found = announced(camera_knocked())
    assert EventKind.BUMPED in found and EventKind.NOT_BUMPED not in found
    for kind, true in ((EventKind.CAMERA_MOVED, MOVE_M), (EventKind.CAMERA_TURNED, TURN_RAD)):
        event, size = found[kind], float(np.linalg.norm(true))
        assert event.cause is Cause.BUMPED and event.camera == "cam0"
        assert event.value == pytest.approx(size, abs=4.0 * event.sigma) and event.sigma < 0.2 * size


def test_a_target_that_was_moved() -> None:
    found = announced(board_knocked())
    event = found[EventKind.NOT_BUMPED]
    assert EventKind.BUMPED in found and event.camera == "cam0" and 2e-3 <= event.value < 5e-3
    assert not {EventKind.CAMERA_MOVED, EventKind.CAMERA_TURNED, EventKind.TIMESHIFT_CHANGED} & set(found)
