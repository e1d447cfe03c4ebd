"""`vical devices`: all ports at once, within one time limit, and each only once."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import tty

import pytest
from vical_drivers.errors import DeviceNotFoundError
from vical_drivers.microstrain import probe
from vical_drivers.microstrain.port import SerialPort
from vical_mocks.gx3_emulator import Gx3Emulator

from vical_daemon.cli import devices, main


@pytest.fixture(autouse=True)
def no_ports_of_this_machine(monkeypatch):
    monkeypatch.setattr(devices, "serial_ports", list)
    monkeypatch.setattr(devices, "list_cameras", lambda: ([], ""))


@pytest.fixture
def silent_port():
    """A pseudo terminal with nobody behind it."""
    with contextlib.ExitStack() as stack:

        def make() -> str:
            master, slave = os.openpty()
            stack.callback(os.close, master)
            stack.callback(os.close, slave)
            tty.setraw(slave)
            return os.ttyname(slave)

        yield make


def listed(capsys, *ports: str) -> list[dict]:
    words = [word for port in ports for word in ("--port", port)]
    assert main(["devices", "--json", *words]) == 0
    return json.loads(capsys.readouterr().out)["imus"]


@pytest.mark.system
def test_each_port_is_told_for_what_it_is(capsys, silent_port):
    with (
        Gx3Emulator(serial_number="A") as one,
        Gx3Emulator(serial_number="B", protocol="mip") as two,
        Gx3Emulator(serial_number="C") as busy,
    ):
        held = SerialPort(busy.port_name)
        silent = [silent_port() for _ in range(3)]
        names = [silent[0], one.port_name, silent[1], busy.port_name, two.port_name, silent[2]]
        found = listed(capsys, *names, "/dev/nowhere")
        held.close()
    assert [port["port"] for port in found] == [*names, "/dev/nowhere"]  # in the order asked for
    assert [port.get("serial_number") for port in found] == [None, "A", None, None, "B", None, None]
    assert [port["found"] for port in found] == [False, True, False, False, True, False, False]
    problems = [port.get("problem", "") for port in found]
    assert "another process has it open" in problems[3]
    assert "no such port" in problems[6]
    assert all("no MicroStrain sensor answers" in problems[k] for k in (0, 2, 5))


@pytest.mark.system
def test_a_port_with_two_names_is_asked_once(capsys, tmp_path):
    with Gx3Emulator(serial_number="A") as emulator:
        alias = tmp_path / "imu"
        alias.symlink_to(emulator.port_name)
        (found,) = listed(capsys, str(alias), emulator.port_name, str(alias))
    assert found["port"] == str(alias) and found["serial_number"] == "A"


def test_all_ports_are_asked_at_the_same_time(capsys, monkeypatch):
    together = threading.Barrier(5)

    def connect(path, **_):
        together.wait(60)  # none gets on before all are here
        raise DeviceNotFoundError(f"{path}: nobody")

    monkeypatch.setattr(probe, "connect", connect)
    found = listed(capsys, *(f"/dev/nowhere{k}" for k in range(5)))
    assert [port["problem"] for port in found] == [f"/dev/nowhere{k}: nobody" for k in range(5)]


def test_a_port_that_hangs_does_not_hold_the_others_up(capsys, monkeypatch):
    hang = threading.Event()

    def connect(path, **_):
        if path.endswith("1"):
            hang.wait(60)
        if path.endswith("2"):
            raise ZeroDivisionError("what a library raises")
        raise DeviceNotFoundError(f"{path}: nobody")

    monkeypatch.setattr(probe, "connect", connect)
    monkeypatch.setattr(devices, "LIMIT_S", 0.5)
    problems = [port["problem"] for port in listed(capsys, "/dev/x0", "/dev/x1", "/dev/x2")]
    hang.set()
    assert problems[0] == "/dev/x0: nobody"
    assert "/dev/x1: not done within 0.5 s" in problems[1]
    assert "ZeroDivisionError" in problems[2]
