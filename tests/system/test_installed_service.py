"""Installed and removed on a booted systemd: what it runs with, with which settings, and what is left."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from vical_mocks.harness.machine import Machine, MachineError

from vical_daemon.cli.process_sets import PROCESSES

pytestmark = pytest.mark.system
REPOSITORY = Path(__file__).resolve().parents[2]
PROGRAM = "/opt/my robot 100%n/vical"
STUB = f"""#!{sys.executable}
import os, signal, socket, sys
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
    systemd.sendto(b"READY=1\\nSTATUS=" + " ".join(sys.argv).encode(), os.environ["NOTIFY_SOCKET"])
signal.pause()
"""
SETTINGS = {  # systemctl's own names, where `systemd --test` says nothing or something else
    "acquire": {"WatchdogUSec": "15s", "TimeoutStopUSec": "30s", "MemoryMax": str(512 << 20)},
    "record": {"WatchdogUSec": "15s", "TimeoutStopUSec": "15s", "MemoryMax": str(1 << 30)},
    "calibrate": {"WatchdogUSec": "2min", "TimeoutStopUSec": "45s", "MemoryMax": str(2 << 30)},
    "web": {"WatchdogUSec": "15s", "TimeoutStopUSec": "15s", "MemoryMax": str(512 << 20)},
}


@pytest.fixture(scope="module")
def machine() -> Iterator[Machine]:
    try:
        machine = Machine()
    except MachineError as error:
        pytest.skip(str(error))
    with machine:
        program = machine.root / PROGRAM[1:]
        program.parent.mkdir(parents=True)
        program.write_text(STUB)
        program.chmod(0o755)
        (machine.root / "root").chmod(0o711)  # where this Python may live
        machine.boot()
        yield machine


def _vical(machine: Machine, *words: str) -> str:
    places = ":".join(str(REPOSITORY / name) for name in ("", "drivers", "mocks"))
    return machine.run("env", f"PYTHONPATH={places}", sys.executable, "-m", "vical_daemon", *words)


def test_installed_started_and_removed(machine: Machine) -> None:
    before = set(machine.run("find", "/etc", "/dev").splitlines())
    _vical(machine, "install-service", "--program", PROGRAM, "--now")
    machine.run("systemctl", "start", "vical-web")
    _wait_until_active(machine)
    for name in PROCESSES:
        unit = f"vical-{name}"
        assert machine.show(unit, "StatusText") == [f"{PROGRAM} run {name} -c /etc/vical/vical.yaml"]
        assert dict(zip(SETTINGS[name], machine.show(unit, *SETTINGS[name]), strict=True)) == SETTINGS[name]
    machine.run("mkdir", "/dev/vical")  # as udev does it, which does not run in a container
    machine.run("ln", "-s", "../ttyACM0", "/dev/vical/imu-6223.00001")
    _vical(machine, "install-service", "--remove")
    left = {line for line in machine.run("find", "/etc", "/dev").splitlines() if "vical" in line} - before
    assert left == {"/etc/vical", "/etc/vical/vical.yaml"}
    assert machine.run("systemctl", "list-units", "--no-legend", "--all", "vical*").split() == []


def _wait_until_active(machine: Machine) -> None:
    end_s = time.monotonic() + 30.0
    units = [f"vical-{name}" for name in PROCESSES]
    while any(machine.show(unit, "ActiveState") != ["active"] for unit in units):
        assert time.monotonic() < end_s, machine.run("journalctl", "--no-pager", "-n", "40")
        time.sleep(0.2)
