"""The processes of `vical run`: started again one by one; the first start alone decides about all."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from vical_daemon.cli import run
from vical_daemon.cli.children import Children
from vical_daemon.cli.errors import CliError
from vical_daemon.config.model import BusConfig, Config

LIVES = "exec sleep 60"
FAILS = "exit 2"
SETTLED_S = 1.0  # a shell ends sooner, however busy the computer is


class Started:
    """Children whose program may be changed, and how often each was started."""

    def __init__(self) -> None:
        self.programs = {"acquire": LIVES, "record": LIVES}
        self.starts: list[str] = []
        self.children = Children(self.command, settled_s=SETTLED_S, again_s=0.3)

    def command(self, name: str) -> list[str]:
        self.starts.append(name)
        return ["sh", "-c", self.programs[name]]

    def tend_until(self, done: Callable[[], bool]) -> None:
        end_s = time.monotonic() + 30.0
        while not done():
            assert time.monotonic() < end_s
            self.children.tend(threading.Event())
            time.sleep(0.02)


@pytest.fixture
def started() -> Iterator[Started]:
    one = Started()
    yield one
    hurry = threading.Event()
    hurry.set()
    one.children.stop(hurry)


def test_what_fails_at_once_ends_all() -> None:
    children = Children(lambda _: ["sh", "-c", FAILS], settled_s=30.0)
    children.start("record")

    def tend() -> None:
        while True:
            children.tend(threading.Event())

    with pytest.raises(CliError, match="process record ended with code 2; see its messages above"):
        tend()


def test_what_fails_when_started_again_is_tried_later(
    started: Started, caplog: pytest.LogCaptureFixture
) -> None:
    """As when the config was edited, and is wrong, while the service runs."""
    caplog.set_level(logging.WARNING)
    first = started.children.start("record")
    acquire = started.children.start("acquire")
    time.sleep(1.2 * SETTLED_S)
    started.programs["record"] = FAILS
    os.kill(first, signal.SIGKILL)
    started.tend_until(lambda: started.starts.count("record") >= 3)
    assert "process record was killed by SIGKILL: starting it again" in caplog.text
    assert (
        "process record ended with code 2 soon after its start: it is tried again every 0.3 s" in caplog.text
    )
    os.kill(acquire, 0)  # lives
    started.programs["record"] = LIVES
    count = started.starts.count("record")
    started.tend_until(lambda: started.starts.count("record") > count)
    assert started.starts.count("acquire") == 1


def test_a_second_run_starts_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Children, "start", lambda *_: pytest.fail("a process was started"))
    config = Config(bus=BusConfig(socket=str(tmp_path / "zenoh.sock")))
    arguments = Namespace(verbose=False, quiet=False, config=str(tmp_path / "vical.yaml"))
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(config.bus.socket)
        other.listen()
        with pytest.raises(CliError, match="vical is already running"):
            run._run_children(arguments, config, ["acquire", "record"])


def test_an_edited_config_is_named_when_a_process_starts_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "vical.yaml"
    file.write_text("rig: a\n")
    commands: list[list[str]] = []

    def start(children: Children, name: str) -> int:
        commands.append(list(children._command(name)))
        file.write_text("rig: b\n")
        return 1

    monkeypatch.setattr(Children, "start", start)
    monkeypatch.setattr(Children, "tend", lambda *_: (_ for _ in ()).throw(CliError("enough")))
    config = Config(bus=BusConfig(socket=str(tmp_path / "zenoh.sock")))
    arguments = Namespace(verbose=False, quiet=False, config=str(file))
    with pytest.raises(CliError, match="enough"):
        run._run_children(arguments, config, ["acquire", "record"])
    assert len(commands) == 2
    assert "vical.yaml was edited: process record starts with the new settings" in caplog.text
    assert "process acquire starts with" not in caplog.text
