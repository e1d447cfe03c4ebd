"""A second, poorer GX3, written from the manual alone: it dribbles bytes, masks flags, knows few commands."""

from __future__ import annotations

import os
import select
import struct
import threading
import time
import tty

import numpy as np
import pytest
from vical_drivers.microstrain.device import open_imu

pytestmark = pytest.mark.system


class PoorGx3:
    """Answers E9, EA 0..2, DB, C4, FA; ignores everything else, also D9; no baud, slow replies."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.name = os.ttyname(self.slave)
        self.settings = [10, 3, 15, 17, 10, 10]
        self.streaming = False
        self.done = False
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def stop(self) -> None:
        self.done = True
        self.thread.join()
        os.close(self.master)
        os.close(self.slave)

    def say(self, body: bytes) -> None:
        frame = body + struct.pack(">H", sum(body) & 0xFFFF)
        for at in range(0, len(frame), 7):
            os.write(self.master, frame[at : at + 7])

    def run(self) -> None:
        heard, start_s, sent = b"", time.monotonic(), 0
        while not self.done:
            if select.select([self.master], [], [], 0.001)[0]:
                heard += os.read(self.master, 100)
            heard = self.obey(heard)
            due = int((time.monotonic() - start_s) * 1000 / self.settings[0])
            if self.streaming and due > sent:
                ticks = int(due * self.settings[0] * 62.5)
                self.say(struct.pack(">B6fI", 0xC2, 0.1, 0.2, -0.97, 0.01, 0.02, 0.03, ticks % 2**32))
            sent = due

    def obey(self, heard: bytes) -> bytes:
        while heard:
            size = {0xE9: 1, 0xEA: 2, 0xDB: 20, 0xC4: 4, 0xFA: 3}.get(heard[0], 0)
            if not size:
                heard = heard[1:]
                continue
            if len(heard) < size:
                break
            command, heard = heard[:size], heard[size:]
            self.execute(command)
        return heard

    def execute(self, command: bytes) -> None:
        time.sleep(0.02)
        if command[0] == 0xFA:
            self.streaming = False
        elif command[0] == 0xE9:
            self.say(b"\xe9\x00\x00\x04\x67")
        elif command[0] == 0xEA and command[1] < 3:
            self.say(command + b"%16s" % [b"6223-4220", b"6223-00042", b"3DM-GX3-25"][command[1]])
        elif command[0] == 0xDB:
            if command[3]:
                self.settings = list(struct.unpack(">HHBBHH", command[4:14]))
                self.settings[1] &= 0x0C03
            self.say(b"\xdb" + struct.pack(">HHBBHH6x", *self.settings))
        elif command[0] == 0xC4:
            self.say(b"\xc4" + command[3:4] + b"\x00\x00\x00\x00")
            self.streaming = bool(command[3])


@pytest.fixture
def poor():
    device = PoorGx3()
    yield device
    device.stop()


@pytest.mark.parametrize("rate_hz", [100.0, 500.0])
def test_the_driver_gets_along_with_it(poor, rate_hz):
    poor.streaming = True
    with open_imu(poor.name, rate_hz=rate_hz, warm_up_s=0.1) as imu:
        assert imu.info.serial_number == "6223-00042"
        assert imu.info.firmware == "1.1.27"
        samples, end_s = [], time.monotonic() + 6.0
        while len(samples) < 50 and time.monotonic() < end_s:
            samples += imu.read(0.2)
        assert len(samples) >= 50
        assert imu.stats().checksum_errors == 0
    assert samples[0].gyro_rps == pytest.approx((0.01, 0.02, 0.03))
    assert (np.diff([s.t_host_ns for s in samples]) > 0).all()
    assert not poor.streaming
