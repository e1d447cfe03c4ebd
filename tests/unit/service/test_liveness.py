"""The watchdog is fed only while every role speaks and none says that it is stuck."""

from __future__ import annotations

import pytest

from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import DiagnosticStatus, Level, encode_diagnostics
from vical_daemon.service.liveness import START_S, Liveness


def _status(role: str, level: Level = Level.OK, message: str = "") -> Sample:
    statuses = [DiagnosticStatus(level, f"{role}/x", message), DiagnosticStatus(Level.OK, "clock")]
    return Sample(f"vical/rig0/status/{role}", encode_diagnostics(1, role, statuses), 0)


@pytest.fixture
def liveness() -> Liveness:
    liveness = Liveness(["imu", "camera"], begin_s=0.0)
    liveness.take(_status("imu"), 10.0)
    return liveness


def test_ready_when_every_role_has_spoken(liveness: Liveness) -> None:
    assert not liveness.ready()
    liveness.take(_status("camera"), 10.5)
    assert liveness.ready() and liveness.problem(11.0) == ""


def test_silence_of_one_role_is_a_problem(liveness: Liveness) -> None:
    liveness.take(_status("camera"), 16.0)
    assert liveness.problem(16.0) == "imu has been silent for 6 s"


def test_a_stuck_thread_is_a_problem_a_lost_device_is_not(liveness: Liveness) -> None:
    liveness.take(_status("camera", Level.ERROR, "unplugged"), 10.0)
    assert liveness.problem(10.0) == ""
    liveness.take(_status("camera", Level.STALE, "its thread is stuck"), 11.0)
    assert "stuck" in liveness.problem(11.0)


def test_others_and_junk_are_ignored(liveness: Liveness) -> None:
    liveness.take(_status("record"), 10.0)
    liveness.take(Sample("vical/rig0/status/camera", b"junk", 0), 10.0)
    assert not liveness.ready()


def test_the_worst_comes_first_in_the_summary(liveness: Liveness) -> None:
    liveness.take(_status("camera", Level.ERROR, "unplugged"), 10.0)
    assert liveness.summary() == "camera/x: unplugged; imu/x"


def test_a_role_that_loads_its_libraries_is_alive_for_a_while(liveness: Liveness) -> None:
    liveness.take(_status("imu"), START_S - 1.0)
    assert liveness.problem(START_S - 1.0) == ""
    assert liveness.summary() == "starting: camera; imu/x"
    liveness.take(_status("imu"), START_S + 1.0)
    assert liveness.problem(START_S + 1.0) == f"camera has not started within {START_S:.0f} s"
