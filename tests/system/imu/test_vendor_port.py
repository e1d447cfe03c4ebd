"""The emulator's terminal used as the vendor's programs use a serial port: locked, flushed, polled, left.

Their SDK opens it with O_RDWR | O_NOCTTY | O_SYNC, locks it with TIOCEXCL, makes it raw without touching
VMIN, flushes it, then polls and reads. Their MSCL does not flush.
"""

from __future__ import annotations

import fcntl
import os
import select
import struct
import termios
import time

import pytest
from vical_mocks.gx3_emulator import Gx3Emulator

pytestmark = pytest.mark.system
_TIOCGEXCL = 0x80045440  # asm-generic/ioctls.h
PING, PING_ACK = "756501020201E0C6", "7565010404F10100D56A"
IDLE, RESUME = "756501020202E1C7", "756501020206E5CB"
DEFAULTS = "75650C030330052147"  # all settings as from the factory
FORMAT_100_HZ = "75650C0D0D08010304000A05000A0E000A4195"  # accelerometer, gyro, ticks


def open_as_the_sdk(name: str, *, flush: bool = True) -> int:
    port = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_SYNC)
    fcntl.ioctl(port, termios.TIOCEXCL)
    settings = termios.tcgetattr(port)
    settings[0] &= ~(termios.INLCR | termios.IGNCR | termios.ICRNL | termios.IGNBRK | termios.IXON)
    settings[1] &= ~termios.OPOST
    settings[2] |= termios.CLOCAL | termios.CREAD | termios.CS8
    settings[3] &= ~(termios.ICANON | termios.ECHO | termios.ISIG | termios.IEXTEN)
    settings[4] = settings[5] = termios.B115200
    termios.tcsetattr(port, termios.TCSANOW, settings)
    if flush:
        termios.tcflush(port, termios.TCIOFLUSH)
    return port


def read(port: int, until: bytes, limit_s: float = 30.0) -> bytes:
    """Poll and read, 10 ms at a time, until some bytes have come."""
    said, deadline = b"", time.monotonic() + limit_s
    poll = select.poll()
    poll.register(port, select.POLLIN)
    while until not in said and time.monotonic() < deadline:
        for _, events in poll.poll(10):
            assert not events & (select.POLLHUP | select.POLLERR | select.POLLNVAL)
            said += os.read(port, 512)
    return said


def send(port: int, text: str) -> bytes:
    command = bytes.fromhex(text)
    assert os.write(port, command) == len(command)
    acknowledged = bytes([0x04, 0xF1, command[5], 0])
    said = read(port, acknowledged)
    assert acknowledged in said
    return said


def is_locked(emulator: Gx3Emulator) -> bool:
    answer = fcntl.ioctl(emulator._slave, _TIOCGEXCL, bytes(4))
    return bool(struct.unpack("i", answer)[0])


@pytest.mark.parametrize("link", ["usb", "uart"])
def test_one_program_after_the_other_finds_the_port_as_a_device_leaves_it(link):
    with Gx3Emulator(protocol="mip", link=link) as emulator:
        for _ in range(2):
            port = open_as_the_sdk(emulator.port_name)
            assert bytes.fromhex(PING_ACK) in send(port, PING)
            send(port, IDLE)
            send(port, DEFAULTS)
            send(port, FORMAT_100_HZ)
            send(port, RESUME)
            assert read(port, b"\x75\x65\x80\x22\x0e\x04")  # 34 bytes of fields, the accelerometer first
            os.close(port)  # as the examples end: while it streams
            deadline = time.monotonic() + 30.0
            while is_locked(emulator) and time.monotonic() < deadline:
                time.sleep(0.01)
            assert not is_locked(emulator)  # an ordinary user would find the port busy


def test_what_was_streamed_while_nobody_listened_is_gone():
    with Gx3Emulator(protocol="mip", link="direct") as emulator:
        begin_s = time.monotonic()
        while emulator.device.face.streaming and len(emulator.device.sent) < 100:
            assert time.monotonic() - begin_s < 60.0
            time.sleep(0.05)
        port = open_as_the_sdk(emulator.port_name, flush=False)
        unread = struct.unpack("i", fcntl.ioctl(port, termios.FIONREAD, bytes(4)))[0]
        assert unread < 34 * 50  # of a hundred packets and more; some come while this is looked at
        assert read(port, b"\x75\x65\x80")[:3] == b"\x75\x65\x80"  # and none is torn
        os.close(port)


def test_a_port_that_another_program_still_has_open_goes_on():
    with Gx3Emulator(protocol="mip", link="direct") as emulator:
        first = open_as_the_sdk(emulator.port_name)
        fcntl.ioctl(first, termios.TIOCNXCL)
        second = os.open(emulator.port_name, os.O_RDWR | os.O_NOCTTY)
        os.close(second)
        time.sleep(0.3)
        termios.tcflush(first, termios.TCIFLUSH)
        assert b"\x75\x65\x80" in read(first, b"\x75\x65\x80")
        os.close(first)
