"""Ports without hardware: messages for people, arrival dating, what a pseudo terminal can show."""

from __future__ import annotations

import errno
import os
import termios
import tty

import pytest
from vical_drivers.errors import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    DevicePermissionError,
    DriverError,
)
from vical_drivers.microstrain import port as port_module
from vical_drivers.microstrain.port import (
    ArrivalLog,
    SerialPort,
    latency_timer_ms,
    link_of,
    wait_for_silence,
)


@pytest.fixture
def terminal():
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for descriptor in (master, slave):
        try:
            os.close(descriptor)
        except OSError:
            pass


def test_reads_what_was_written_and_times_out_empty(terminal):
    master, name = terminal
    port = SerialPort(name)
    os.write(master, b"abc")
    data, t_ns = port.read(1.0)
    assert data == b"abc"
    assert t_ns > 0
    assert port.read(0.01)[0] == b""
    port.write(b"hello")
    assert os.read(master, 10) == b"hello"
    port.close()
    port.close()


def test_a_second_opener_is_told_who_to_ask(terminal):
    _, name = terminal
    port = SerialPort(name)
    with pytest.raises(DeviceBusyError, match="another process has it open"):
        SerialPort(name)
    port.close()
    SerialPort(name).close()


def test_unplugging_is_a_lost_device(terminal):
    master, name = terminal
    port = SerialPort(name)
    os.close(master)
    with pytest.raises(DeviceLostError, match="the port is gone"):
        port.read(0.5)
    port.close()


def test_what_is_no_port_is_said_in_one_line(tmp_path):
    with pytest.raises(DeviceNotFoundError, match="no such port"):
        SerialPort(str(tmp_path / "ttyNone"))
    plain = tmp_path / "file"
    plain.write_text("x")
    with pytest.raises(DeviceNotFoundError, match="no serial port"):
        SerialPort(str(plain))


def test_permission_denied_names_the_group(monkeypatch, tmp_path):
    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(port_module.serial, "Serial", refuse)
    with pytest.raises(DevicePermissionError, match=r"permission denied; (it belongs to group|only root)"):
        SerialPort(str(tmp_path))


def test_too_many_open_files_is_no_fault_of_the_port(monkeypatch, tmp_path):
    """It was 'this is no serial port'."""

    def refuse(*args, **kwargs):
        raise OSError(errno.EMFILE, "could not open port")

    monkeypatch.setattr(port_module.serial, "Serial", refuse)
    with pytest.raises(DriverError, match=r"Too many open files; see `ulimit -n`"):
        SerialPort(str(tmp_path))


@pytest.mark.parametrize("link", ["auto", "ftdi"])
def test_a_real_port_is_held_and_left_for_good(terminal, monkeypatch, link):
    """Nobody else gets in; close waits for nothing. A terminal's flag would stay, its program reads on."""
    asked = []

    def ioctl(_fd, request, *_):
        asked.append(request)
        return bytes(4)

    monkeypatch.setattr(port_module.fcntl, "ioctl", ioctl)
    port = SerialPort(terminal[1], link=link)
    monkeypatch.setattr(port._serial, "reset_output_buffer", lambda: asked.append("flush"))
    port.close()
    of_interest = [r for r in asked if r in (termios.TIOCEXCL, termios.TIOCNXCL, "flush")]
    assert of_interest == ([] if link == "auto" else [termios.TIOCEXCL, "flush", termios.TIOCNXCL])


def test_a_slow_latency_timer_is_found_and_said(tmp_path, terminal, monkeypatch, caplog):
    (tmp_path / "ttyUSB0").mkdir()
    (tmp_path / "ttyUSB0" / "latency_timer").write_text("16\n")
    assert latency_timer_ms("/dev/ttyUSB0", str(tmp_path)) == 16
    assert latency_timer_ms("/dev/ttyACM0", str(tmp_path)) is None
    monkeypatch.setattr(port_module, "latency_timer_ms", lambda _name: 16)
    SerialPort(terminal[1]).close()
    assert "latency_timer=16ms" in caplog.text and "udev rule" in caplog.text


def test_links_are_told_by_name():
    assert link_of("/dev/ttyACM7") == "usb"
    assert link_of("/dev/ttyUSB7") == "uart"
    assert link_of("/dev/pts/7") == "unknown"


def test_wire_time_only_where_there_is_a_wire(terminal):
    _, name = terminal
    for link, expected_ns in (("usb", 0.0), ("auto", 0.0), ("uart", 1e10 / 115_200)):
        port = SerialPort(name, link=link)
        assert port.wire_byte_ns == pytest.approx(expected_ns)
        port.close()


def test_records_are_dated_by_their_last_byte():
    log = ArrivalLog()
    log.add(40, 1_000)
    log.add(22, 9_000)
    assert log.arrival_ns(31, 10.0) == 1_000 - 9 * 10
    assert log.arrival_ns(62, 10.0) == 9_000


def test_waiting_for_silence_gives_up(terminal):
    _master, name = terminal
    port = SerialPort(name)
    assert wait_for_silence(port, 0.02, 0.2)

    class Chatter:
        name = "x"

        def read(self, timeout_s):
            return b"x", 0

    assert not wait_for_silence(Chatter(), 0.01, 0.05)
    port.close()
