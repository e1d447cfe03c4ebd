"""A role that fails: a wrong input is one line, only a bug leaves a traceback in the log."""

from __future__ import annotations

import logging
import time
from types import SimpleNamespace

import pytest

from vical_daemon.bus.interface import LocalBus
from vical_daemon.cli import process_sets
from vical_daemon.config.model import Config
from vical_daemon.vision.target import TargetError


@pytest.mark.parametrize(("error", "traced"), [(TargetError("t.yaml: no such file"), 0), (KeyError("x"), 1)])
def test_only_a_bug_is_traced(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, error: Exception, traced: int
) -> None:
    def run(*_arguments: object) -> None:
        raise error

    monkeypatch.setattr(process_sets, "import_module", lambda _name: SimpleNamespace(run=run))
    threads = process_sets.RoleThreads(Config(rig="r"), LocalBus())
    with caplog.at_level(logging.ERROR):
        threads.start("estimate")
        assert threads.failed.wait(5.0) and threads.stop_all()
    assert len([record for record in caplog.records if record.exc_info]) == traced
    with pytest.raises(type(error)):
        threads.raise_failure()


def test_modules_of_roles_are_loaded_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """`vical run detect estimate record` ended in a deadlock of two imports, now and then."""
    loading, together = [], []

    def load(name: str) -> SimpleNamespace:
        loading.append(name)
        time.sleep(0.05)
        together.append(len(loading))
        loading.remove(name)
        return SimpleNamespace(run=lambda *_arguments: None)

    monkeypatch.setattr(process_sets, "import_module", load)
    threads = process_sets.RoleThreads(Config(rig="r"), LocalBus())
    for role in ("record", "detect", "estimate"):
        threads.start(role)
    assert threads.stop_all()
    assert together == [1, 1, 1]
