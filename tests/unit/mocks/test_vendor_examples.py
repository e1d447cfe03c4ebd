"""The emulator against what the vendor's stock example programs send, byte for byte.

The sequences are those of the C and C++ examples of the vendor's SDK (github.com/LORD-MicroStrain/mip_sdk,
folder examples: CX5_GX5_CV5_15_25, CV7, 5_series and 7_series stream_imu, ahrs, ar); the bytes are made
here from the protocol. A program is content when each command is acknowledged, in a packet of the command's
set, and the data that it configured arrive after `resume`, without 0x0C,0x11.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from vical_mocks.gx3_device import Gx3Device
from vical_mocks.imu import FloatArray

Packet = tuple[int, list[tuple[int, bytes]]]  # set, [(descriptor, data)]
WRITE, READ, SAVE, LOAD, DEFAULT = (bytes([n]) for n in range(1, 6))


def encode(descriptor_set: int, command: int, data: bytes = b"") -> bytes:
    body = bytes([0x75, 0x65, descriptor_set, len(data) + 2, len(data) + 2, command]) + data
    first = second = 0
    for value in body:
        first = (first + value) & 255
        second = (second + first) & 255
    return body + bytes([first, second])


def packets(said: bytes) -> Iterator[Packet]:
    """What a host reads; every byte must belong to a sound packet."""
    while said:
        size = said[3] + 6
        whole, said = said[:size], said[size:]
        fields, rest = [], whole[4:-2]
        while rest:
            fields.append((rest[1], rest[2 : rest[0]]))
            rest = rest[rest[0] :]
        again = encode(whole[2], 0)[:2] + whole[2:-2]
        first = second = 0
        for value in again:
            first = (first + value) & 255
            second = (second + first) & 255
        assert whole[-2:] == bytes([first, second])
        yield whole[2], fields


class Host:
    """A program in simulated time: a command waits for its acknowledgement, as the SDK does."""

    def __init__(self, device: Gx3Device) -> None:
        self.device = device
        self.now_s = 0.0
        self.data: list[Packet] = []

    def listen(self, seconds: float) -> list[Packet]:
        self.now_s += seconds
        said = b"".join(data for _, data in self.device.advance(self.now_s))
        self.device.wire_is_idle()
        new = list(packets(said))
        self.data += [packet for packet in new if packet[0] >= 0x80]
        return new

    def ask(self, descriptor_set: int, command: int, data: bytes = b"", wait_s: float = 0.02) -> Packet:
        self.device.receive(encode(descriptor_set, command, data), self.now_s)
        for answer in self.listen(wait_s):
            if answer[0] == descriptor_set and answer[1][0][0] == 0xF1 and answer[1][0][1][0] == command:
                return answer
        raise AssertionError(f"no answer to {descriptor_set:02X},{command:02X}")

    def do(self, descriptor_set: int, command: int, data: bytes = b"", wait_s: float = 0.02) -> bytes:
        """As `ask`, acknowledged; returns the data of the reply field, b"" where there is none."""
        _, fields = self.ask(descriptor_set, command, data, wait_s)
        assert fields[0][1][1] == 0, f"{descriptor_set:02X},{command:02X} refused: {fields[0][1][1]}"
        return fields[1][1] if len(fields) > 1 else b""

    def begin(self) -> set[int]:
        """What every example does first; returns the descriptors that the device lists."""
        self.do(0x01, 0x01)
        self.do(0x01, 0x02)
        info = self.do(0x01, 0x03)
        assert len(info) == 82
        self.do(0x0C, 0x30, DEFAULT)
        known = self.do(0x01, 0x04) + self.do(0x01, 0x07)
        self.data.clear()
        return set(struct.unpack(f">{len(known) // 2}H", known))

    def fields(self, data_set: int) -> list[tuple[int, ...]]:
        return [tuple(d for d, _ in fields) for number, fields in self.data if number == data_set]

    def states(self) -> list[int]:
        """Filter states in the order in which they were reported."""
        found = [d[:2] for number, fields in self.data if number == 0x82 for k, d in fields if k == 0x10]
        return [int.from_bytes(state, "big") for state in found]


def rates(base_hz: int, rate_hz: int, *descriptors: int) -> bytes:
    items = b"".join(struct.pack(">BH", d, base_hz // rate_hz) for d in descriptors)
    return bytes([len(descriptors)]) + items


@pytest.mark.parametrize("model", ["gx3", "gx5"])
def test_the_5_series_stream_imu_example_gets_what_it_configured(model):
    host = Host(Gx3Device(protocol="mip", model=model))
    assert {0x8004, 0x8005, 0x8006, 0x0C08} <= host.begin()
    (base_hz,) = struct.unpack(">H", host.do(0x0C, 0x06))
    host.do(0x0C, 0x08, WRITE + rates(base_hz, 1, 0x04, 0x05, 0x06))
    host.listen(3.0)
    assert host.data == []  # idle
    host.do(0x01, 0x06)
    host.listen(5.0)
    assert host.fields(0x80) == [(0x04, 0x05, 0x06)] * 5


def test_the_7_series_stream_imu_example_gets_what_it_configured():
    host = Host(Gx3Device(protocol="mip", model="cv7"))
    assert {0x8004, 0x8005, 0x8006, 0x0C0F} <= host.begin()
    named, base_hz = struct.unpack(">BH", host.do(0x0C, 0x0E, b"\x80"))
    assert named == 0x80
    host.do(0x0C, 0x0F, WRITE + b"\x80" + rates(base_hz, 1, 0x04, 0x05, 0x06))
    host.do(0x01, 0x06)
    host.listen(5.0)
    assert host.fields(0x80) == [(0x04, 0x05, 0x06)] * 5


@pytest.mark.parametrize("model", ["gx5", "cv7"])
def test_the_threading_examples_ping_a_hundred_times_while_data_flow(model):
    host = Host(Gx3Device(protocol="mip", model=model))
    for _ in range(100):
        host.device.receive(encode(0x01, 0x01), host.now_s)
    answers = [packet for packet in host.listen(1.0) if packet[0] == 0x01]
    assert answers == [(0x01, [(0xF1, b"\x01\x00")])] * 100
    assert len(host.fields(0x80)) == pytest.approx(100, abs=2)


def test_the_5_series_ahrs_example_sees_the_filter_initialise_and_run():
    host = Host(Gx3Device(protocol="mip", model="gx5"))
    host.begin()
    assert len(host.do(0x0C, 0x39, struct.pack(">H", 15_000), wait_s=15.5)) == 12  # capture the gyro's bias
    (base_hz,) = struct.unpack(">H", host.do(0x0C, 0x0B))
    host.do(0x0C, 0x0A, WRITE + rates(base_hz, 1, 0x11, 0x10, 0x05))
    host.do(0x0D, 0x11, WRITE + struct.pack(">3f", 0, 0, 0))
    host.do(0x0D, 0x18, WRITE + b"\x01")
    host.do(0x0D, 0x19, WRITE + b"\x01")
    host.do(0x0D, 0x01)
    host.do(0x01, 0x06)
    host.listen(8.0)
    states = host.states()
    assert states[0] == 1  # the example waits for this one, at 1 Hz
    assert states[-1] == 2 and states == sorted(states)
    last = dict([fields for data_set, fields in host.data if data_set == 0x82][-1])
    roll, pitch, yaw, valid = struct.unpack(">3fH", last[0x05])
    assert (abs(roll) < 0.01, abs(pitch) < 0.01, valid) == (True, True, 1)
    assert yaw == pytest.approx(-math.atan2(0.01, 0.2), abs=0.01)  # the field's east part is 0.01 of 0.2 G
    assert len(last[0x11]) == 12


def test_the_older_5_series_example_saves_a_bias_and_switches_the_filter_stream_on():
    host = Host(Gx3Device(protocol="mip", model="gx5"))
    host.begin()
    bias = host.do(0x0C, 0x39, struct.pack(">H", 2000), wait_s=2.5)
    host.do(0x0C, 0x38, SAVE)
    host.do(0x0C, 0x11, WRITE + b"\x03\x01")
    host.do(0x0C, 0x08, WRITE + rates(1000, 100, 0x12, 0x04, 0x05))
    host.do(0x0C, 0x0A, WRITE + rates(500, 100, 0x11, 0x10, 0x05, 0x0E, 0x1C))
    host.do(0x0D, 0x11, WRITE + struct.pack(">3f", 0, 0, 0))
    host.do(0x0D, 0x19, WRITE + b"\x01")
    host.do(0x0D, 0x01)
    host.do(0x01, 0x06)
    host.listen(5.0)
    assert len(host.fields(0x80)) == pytest.approx(500, abs=3)
    assert set(host.fields(0x80)) == {(0x12, 0x04, 0x05)}
    assert len(host.fields(0x82)) == pytest.approx(500, abs=3)
    assert set(host.fields(0x82)) == {(0x11, 0x10, 0x05, 0x0E, 0x1C)}
    assert host.states()[-1] == 2  # running, the example prints
    last = dict([fields for data_set, fields in host.data if data_set == 0x82][-1])
    assert struct.unpack(">3fH", last[0x1C])[:3] == pytest.approx((0, 0, -9.80665), abs=0.05)
    host.do(0x01, 0x7E)
    host.listen(1.0)
    assert host.do(0x0C, 0x38, READ) == bias  # it was saved


def tilted(angle_rad: float, begin_s: float):
    """Level until `begin_s`, then rolled by an angle."""

    def motion(t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        roll = np.where(t_s < begin_s, 0.0, angle_rad)
        force = -9.80665 * np.column_stack([np.zeros_like(roll), np.sin(roll), np.cos(roll)])
        return np.zeros((len(t_s), 3)), force

    return motion


def test_the_7_series_ahrs_example_reaches_ahrs_mode_and_is_told_of_a_tilt():
    host = Host(Gx3Device(tilted(1.0, 10.0), protocol="mip", model="cv7"))
    host.begin()
    host.do(0x0C, 0x0F, WRITE + b"\x80" + rates(1000, 100, 0xD3, 0x04, 0x05, 0x06))
    _, base_hz = struct.unpack(">BH", host.do(0x0C, 0x0E, b"\x82"))
    host.do(0x0C, 0x0F, WRITE + b"\x82" + rates(base_hz, 1, 0xD3, 0x10, 0x05))
    limit = math.radians(45)
    for number in (1, 2):  # outside of +-45 degrees of roll, of pitch
        window = struct.pack(">BB4B2d", number, 2, 0x82, 0x05, number, 1, limit, -limit)
        host.do(0x0C, 0x2E, WRITE + window)
        assert host.do(0x0C, 0x2E, READ + bytes([number])) == window
        host.do(0x0C, 0x2F, WRITE + struct.pack(">BBBBHBB", number, number, 2, 0x82, 0, 1, 0xD0))
        host.do(0x0C, 0x2B, WRITE + bytes([number, 1]))
    host.do(0x0C, 0x31, WRITE + struct.pack(">3f", 0, 0, 0))
    host.do(0x0D, 0x50, WRITE + b"\x00\x05\x01")
    host.do(0x0D, 0x01)
    host.do(0x01, 0x06)
    host.listen(9.0)
    assert host.states()[0] == 1 and set(host.states()) == {1, 2, 3}
    assert (0xD0,) not in host.fields(0x82)
    host.listen(3.0)
    events = [fields for number, fields in host.data if number == 0x82 and fields[0][0] == 0xD0]
    assert events == [[(0xD0, b"\x01")]]  # of the roll, once
    assert host.do(0x0C, 0x2C, b"\x02\x01\x02") == b"\x02\x02\x01\x02\x00"


def test_a_filter_that_may_not_start_by_itself_waits_for_an_attitude():
    host = Host(Gx3Device(protocol="mip", model="gx5"))
    host.begin()
    host.do(0x0C, 0x0A, WRITE + rates(500, 1, 0x10))
    host.do(0x0D, 0x19, WRITE + b"\x00")
    host.do(0x0D, 0x01)
    host.do(0x01, 0x06)
    host.listen(10.0)
    assert set(host.states()) == {1}
    host.do(0x0D, 0x02, struct.pack(">3f", 0, 0, 0))
    host.listen(2.0)
    assert host.states()[-1] == 2


@pytest.mark.parametrize(
    ("model", "descriptor_set", "command", "data", "code"),
    [
        ("gx3", 0x0C, 0x0F, b"\x02\x80", 1),  # a command of the 7-series
        ("gx3", 0x0D, 0x01, b"", 1),  # it has no filter
        ("gx5", 0x0C, 0x35, b"\x02", 1),  # a command of the GX3
        ("gx5", 0x0C, 0x09, b"\x02", 1),  # no receiver
        ("cv7", 0x0C, 0x06, b"", 1),  # a command of the 5-series
        ("cv7", 0x0C, 0x40, b"\x02", 1),  # the 7-series names the port: 0x01,0x09
        ("cv7", 0x0E, 0x01, b"", 1),  # no receiver
        ("gx5", 0x0C, 0x11, b"\x01\x02\x01", 3),  # stream of a receiver
        ("gx5", 0x0C, 0x11, b"\x01\x80\x01", 3),  # as the 7-series names it
        ("cv7", 0x0C, 0x11, b"\x01\x01\x01", 3),  # as the 5-series names it
        ("cv7", 0x0C, 0x11, b"\x01\x00\x01", 3),  # all: not to be written
        ("cv7", 0x0C, 0x0E, b"\x91", 3),
        ("gx5", 0x0C, 0x08, b"\x01\x01\x99\x00\x01", 3),
        ("gx5", 0x0C, 0x08, b"\x01\x02\x04\x00\x01", 3),  # cut off
        ("gx5", 0x0C, 0x30, b"\x01", 3),
        ("gx5", 0x0D, 0x11, b"\x01" + bytes(8), 3),  # two angles of three
        ("gx5", 0x0D, 0x11, b"\x07" + bytes(12), 3),
        ("cv7", 0x0C, 0x2A, b"\x03", 3),
        ("gx3", 0x0C, 0x40, b"\x01\x00\x00\x00\x07", 3),
    ],
)
def test_what_a_device_does_not_know_is_refused_with_its_code(model, descriptor_set, command, data, code):
    host = Host(Gx3Device(protocol="mip", model=model))
    host.do(0x01, 0x02)
    _, fields = host.ask(descriptor_set, command, data)
    assert fields == [(0xF1, bytes([command, code]))]


@pytest.mark.parametrize("model", ["gx3", "gx5", "cv7"])
def test_it_streams_from_power_up_until_idle_and_goes_on_after_resume(model):
    host = Host(Gx3Device(protocol="mip", model=model))
    host.listen(1.0)
    assert len(host.fields(0x80)) == pytest.approx(100, abs=2)
    host.do(0x01, 0x02)
    host.data.clear()
    host.listen(1.0)
    assert host.data == []
    stream = b"\x80" if model == "cv7" else b"\x01"
    host.do(0x0C, 0x11, WRITE + stream + b"\x00")
    assert host.do(0x0C, 0x11, READ + stream) == stream + b"\x00"
    host.do(0x01, 0x06)
    host.listen(1.0)
    assert host.data == []  # switched off, and this is no setting of idle
    host.do(0x0C, 0x11, DEFAULT + b"\x00")
    host.listen(1.0)
    assert len(host.fields(0x80)) > 90


@pytest.mark.parametrize("model", ["gx3", "gx5", "cv7"])
def test_settings_are_in_force_saved_and_factory(model):
    """What is saved comes back with a reset; what is not does not; the factory's come back when asked for."""
    host = Host(Gx3Device(protocol="mip", model=model))
    host.do(0x01, 0x02)
    named = b"\x80" if model == "cv7" else b""
    command = 0x0F if model == "cv7" else 0x08
    factory = host.do(0x0C, command, READ + named)
    host.do(0x0C, command, WRITE + named + rates(1000, 50, 0x05))
    host.do(0x0C, 0x38, WRITE + struct.pack(">3f", 0.01, 0.02, 0.03))
    host.do(0x0C, 0x3A, WRITE + struct.pack(">3f", 1, 2, 3)) if model != "gx3" else None
    host.do(0x0C, 0x30, SAVE)
    host.do(0x0C, command, WRITE + named + rates(1000, 10, 0x04))
    host.do(0x01, 0x7E)
    host.listen(1.0)
    assert set(host.fields(0x80)[-20:]) == {(0x05,)}  # also: it streams again, and is idle no more
    assert host.do(0x0C, 0x38, READ) == struct.pack(">3f", 0.01, 0.02, 0.03)
    if model != "gx3":
        assert host.do(0x0C, 0x3A, READ) == struct.pack(">3f", 1, 2, 3)
    host.do(0x0C, 0x30, DEFAULT)
    assert host.do(0x0C, command, READ + named) == factory
    assert host.do(0x0C, 0x38, READ) == bytes(12)
    host.do(0x0C, 0x30, LOAD)
    assert host.do(0x0C, command, READ + named) == named + rates(1000, 50, 0x05)


def test_factory_settings_bring_the_factory_baud_after_the_answer():
    device = Gx3Device(protocol="mip", model="gx5")
    device.state.eeprom = replace(device.state.eeprom, baud=921_600)
    device.power_up(0.0)
    host = Host(device)
    host.do(0x01, 0x02)
    device.receive(encode(0x0C, 0x30, DEFAULT), host.now_s)
    assert b"".join(data for _, data in device.advance(host.now_s + 0.02))
    assert device.baud == 921_600  # as long as the answer is on the wire
    device.wire_is_idle()
    assert device.baud == 115_200
