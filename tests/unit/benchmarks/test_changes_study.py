"""Changes of the rig in a study: what is judged, their size, and the command that runs studies."""

import numpy as np
import pytest
from vical_mocks.harness.feed import Record, Snapshot
from vical_mocks.rig import Bump, reference_rig

from benchmarks import __main__ as command
from benchmarks.changes import AT_S, bump, judge
from vical_daemon.estimation.events import Event, EventKind


def record_with(announced_s, errors):
    record = Record()
    for t_s, e in errors.items():
        error = np.zeros(15)
        error[0] = e
        record.snapshots.append(Snapshot(t_s, "converged", error, np.eye(15)))
    if announced_s is not None:
        record.events.append((announced_s, Event(EventKind.BUMPED)))
    return record


def test_a_step_is_judged_by_announcement_return_and_lies():
    found = judge(record_with(61.5, {59.0: 0.1, 60.5: 9.0, 61.0: 9.0, 65.0: 4.0, 70.0: 1.0, 80.0: 1.0}))
    assert (found["announced_s"], found["back_s"], found["early"]) == (1.5, 5.5, 0)
    assert found["sigmas_at_10_s"] == 1.0
    assert found["lies_s"] == []  # before it was announced nobody could know
    silent = judge(record_with(None, {59.0: 0.1, 61.0: 9.0, 64.0: 9.0, 71.0: 9.0}))
    assert silent["announced_s"] is None
    assert silent["lies_s"] == [64.0, 71.0]


def test_bumps_have_the_size_of_their_name():
    (step,) = bump((2.0, 10.0, 5.0), 1)
    assert isinstance(step, Bump) and step.at_s == AT_S
    assert np.linalg.norm(step.rotation_rad) == pytest.approx(np.deg2rad(2))
    assert np.linalg.norm(step.translation_m) == pytest.approx(0.01)
    assert abs(step.timeshift_s) == pytest.approx(5e-3)
    assert bump((0.0, 0.0, 0.0), 1) == ()
    rig = reference_rig(1, bumps=(step,))
    assert rig.timeshift_at(AT_S + 1) - rig.timeshift_at(AT_S - 1) == pytest.approx(step.timeshift_s)


def test_the_command_refuses_unknown_studies(capsys):
    assert command.main(["nonsense"]) == 2
    assert "there are:" in capsys.readouterr().err
    assert command.main([]) == 0
    listed = capsys.readouterr().out
    assert "montecarlo" in listed and "Cramer-Rao" in listed
