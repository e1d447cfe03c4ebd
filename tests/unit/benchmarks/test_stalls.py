"""What the study of stalls takes for the same calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stall_watcher import Watcher
from benchmarks.stalls import Outcome, change
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import encode_calibration
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status

X = Event(EventKind.OTHER, said="x")


def _estimate(p_m=(0.08, 0.02, -0.03), shift_s=0.01, frames=10, events=()) -> CalibrationEstimate:
    pose = PoseEstimate(list(p_m), [1.0, 0.0, 0.0, 0.0], (np.eye(6) * 1e-8).tolist())
    lens = ([500.0, 500.0, 320.0, 240.0], [1.0] * 4, "radtan", [0.1, 0.0, 0.0, 0.0], [0.01] * 4)
    cameras = {"cam0": CameraEstimate(pose, shift_s, 1e-5, *lens, 0.2)}
    return CalibrationEstimate(
        1,
        Status.CONVERGED,
        "",
        1.0,
        "",
        60.0,
        frames,
        60,
        cameras,
        None,
        [0.0, 0.0, -9.8],
        1.0,
        0.0,
        [*events],
    )


def test_a_change_is_measured_in_joint_sigmas() -> None:
    z, moved_mm = change(_estimate(), _estimate(p_m=(0.0804, 0.02, -0.03)))
    assert z == pytest.approx(0.4e-3 / (1e-4 * np.sqrt(2))) and moved_mm == pytest.approx(0.4)
    z, _ = change(_estimate(), _estimate(shift_s=0.0101))
    assert z == pytest.approx(1e-4 / (1e-5 * np.sqrt(2)))
    assert change(_estimate(), replace(_estimate(), cameras={}))[0] == np.inf


def test_a_repeated_estimate_does_not_count_as_converged_again(tmp_path) -> None:
    watcher = Watcher(tmp_path / "none")
    watcher._on_estimate(Sample("k", encode_calibration(_estimate(frames=10), "cam0"), 0))
    ((back_s, _),) = watcher._estimates
    watcher._on_estimate(Sample("k", encode_calibration(_estimate(frames=10), "cam0"), 1))
    assert watcher.converged_since(back_s) is None
    watcher._on_estimate(Sample("k", encode_calibration(_estimate(frames=11, events=[X]), "cam0"), 2))
    found = watcher.converged_since(back_s)
    assert found is not None and found[1].frames == 11 and watcher.events_since(back_s) == [X]


@pytest.mark.parametrize(
    ("outcome", "good"),
    [
        (Outcome("web", "kill", 1.0, 0.1, 0.5, 0.1, [Event(EventKind.RESUMED, value=1.8)]), True),
        (Outcome("web", "kill", 1.0, 5.1, 0.5, 0.1), False),
        (Outcome("web", "kill", 1.0, None, None, None), False),
        (Outcome("web", "kill", 1.0, 0.1, 4.0, 0.1), False),
        (Outcome("web", "kill", 1.0, 0.1, 0.5, 0.1, [Event(EventKind.BUMPED)]), False),
    ],
)
def test_what_is_as_asked_for(outcome: Outcome, good: bool) -> None:
    assert outcome.good is good
