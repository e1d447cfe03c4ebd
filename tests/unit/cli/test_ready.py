"""Ready is reported before a role loads its libraries, and the watchdog is fed meanwhile."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.zenoh_bus import BusError
from vical_daemon.cli import bus_access, process_sets, run
from vical_daemon.config.model import Config


def _listen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> socket.socket:
    systemd = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    systemd.bind(str(tmp_path / "notify"))
    systemd.settimeout(10.0)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    return systemd


def _receive(systemd: socket.socket, wanted: str) -> list[str]:
    said: list[str] = []
    while not any(wanted in text for text in said):
        said.append(systemd.recv(4096).decode())
    return said


def test_ready_does_not_wait_for_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded, stop = threading.Event(), threading.Event()

    def slow_import(_name: str) -> SimpleNamespace:
        assert loaded.wait(30.0)
        return SimpleNamespace(run=lambda _config, _bus, stop: stop.wait())

    monkeypatch.setattr(process_sets, "import_module", slow_import)
    monkeypatch.setattr(bus_access, "open_for_roles", lambda *_: LocalBus())
    with _listen(tmp_path, monkeypatch) as systemd:
        process = threading.Thread(target=run._run_roles, args=(Config(rig="r"), ["estimate"], stop))
        process.start()
        said = _receive(systemd, "WATCHDOG=1")
        loaded.set()
        stop.set()
        process.join(10.0)
    assert said[0] == "READY=1\nSTATUS=starting: estimate"


def test_ready_does_not_wait_for_the_bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_bus(**_: object) -> None:
        raise BusError("no bus at all")

    monkeypatch.setenv("VICAL_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setattr(bus_access, "open_bus", no_bus)
    stop = threading.Event()
    with _listen(tmp_path, monkeypatch) as systemd:
        process = threading.Thread(target=run._run_roles, args=(Config(rig="r"), ["record"], stop))
        process.start()
        said = _receive(systemd, "WATCHDOG=1")
        stop.set()
        process.join(10.0)
    assert said[0] == "READY=1\nSTATUS=waiting for the bus"


def test_what_is_loaded_before_ready_is_light() -> None:
    code = (
        "import sys, vical_daemon.cli.run, vical_daemon.cli.bus_access, vical_daemon.cli.process_sets\n"
        "print(*({name.split('.')[0] for name in sys.modules} & {'scipy', 'cv2', 'foxglove', 'aiohttp'}))"
    )
    out = subprocess.run([sys.executable, "-c", code], env=os.environ, capture_output=True, check=True)
    assert out.stdout.split() == []
