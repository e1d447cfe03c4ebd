"""Driver against the emulated device over a real pseudo terminal: protocols, rates, bauds, stamps."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from vical_drivers.microstrain.device import open_imu
from vical_drivers.samples import ImuSource
from vical_mocks.faults import ByteFaults
from vical_mocks.gx3_state import Settings

from vical_daemon.cli import main

pytestmark = pytest.mark.system
FAST = {"warm_up_s": 0.1}


def collect(imu, count, limit_s=8.0):
    samples, end_s = [], time.monotonic() + limit_s
    while len(samples) < count and time.monotonic() < end_s:
        samples += imu.read(0.2)
    assert len(samples) >= count, imu.stats()
    return samples


@pytest.mark.parametrize(
    ("device", "wanted"),
    [
        ({}, {"rate_hz": 100.0}),
        ({"link": "uart"}, {"rate_hz": 1000.0, "link": "uart"}),
        ({"protocol": "mip"}, {"rate_hz": 200.0}),
        ({"protocol": "mip", "model": "gx5"}, {"rate_hz": 100.0}),
        ({"protocol": "mip", "model": "cv7", "link": "uart"}, {"rate_hz": 500.0, "link": "uart"}),
    ],
)
def test_every_protocol_streams_and_stops(emulate, device, wanted):
    emulator = emulate(clock_skew_ppm=40.0, **device)
    with open_imu(emulator.port_name, **wanted, **FAST) as imu:
        assert isinstance(imu, ImuSource)
        assert imu.info.serial_number == "6223-12345"
        assert imu.applied.rate_hz == wanted["rate_hz"]
        samples = collect(imu, 40)
    stamps = np.array([s.t_host_ns for s in samples])
    assert (np.diff(stamps) > 0).all()
    assert samples[-1].specific_force_mps2 == pytest.approx((0.0, 0.0, -9.80665))
    assert imu.stats().lost == 0
    assert not emulator.device.face.streaming
    assert emulator.device.state.eeprom_writes == 0
    assert emulator.device.baud == 115_200
    imu.close()


def test_stamps_lie_a_filter_delay_before_the_timer(emulate):
    def motion(t_s):
        gyro = np.zeros((len(t_s), 3))
        gyro[:, 2] = np.sin(2 * np.pi * 1.5 * t_s)
        return gyro, np.tile([0.0, 0.0, -9.8], (len(t_s), 1))

    emulator = emulate(motion=motion, link="direct", clock_skew_ppm=-60.0)
    with open_imu(emulator.port_name, rate_hz=200.0) as imu:
        samples = collect(imu, 300)[50:]
    t_s = np.array([s.t_host_ns for s in samples]) * 1e-9
    measured = np.array([s.gyro_rps[2] for s in samples])
    slope = 2 * np.pi * 1.5 * np.cos(2 * np.pi * 1.5 * t_s)
    late_s = np.sum((np.sin(2 * np.pi * 1.5 * t_s) - measured) * slope) / np.sum(slope**2)
    assert abs(late_s) < 1e-3  # scheduling of a loaded machine; without the filter delay it would be 8 ms


def test_a_device_left_at_another_baud_and_streaming_is_found(emulate):
    baud = 460_800
    eeprom = Settings(baud=baud, power_up_mode=2, preset_command=0xCB)
    emulator = emulate(link="uart", eeprom=replace(eeprom), faults=ByteFaults(at_start=200))
    with open_imu(emulator.port_name, link="uart", **FAST) as imu:
        collect(imu, 30)
    assert emulator.device.baud == baud


def test_the_commands_of_the_device_by_hand(emulate, capsys):
    def vical(*words):
        assert main(list(words)) == 0
        return [json.loads(line) for line in capsys.readouterr().out.splitlines()]

    old, new = emulate(), emulate(protocol="mip")
    (info,) = vical("imu", "info", old.port_name, "--json")
    assert info["firmware"] == "1.1.30"
    assert info["settings"]["filter_width"] == 15
    (record,) = vical("imu", "poll", old.port_name, "0xCC", "--json")
    assert record["accel_mps2"][2] == pytest.approx(-9.80665)
    assert len(record["matrix"]) == 9
    (record,) = vical("imu", "poll", new.port_name, "0x04", "--json")
    assert record["accel_mps2"][2] == pytest.approx(-9.80665)
    (test,) = vical("imu", "selftest", new.port_name, "--json")
    assert test["passed"]
    (bias,) = vical("imu", "capture-gyro-bias", old.port_name, "--seconds", "1", "--json")
    assert bias["gyro_bias_rps"] == pytest.approx([0.0, 0.0, 0.0])
    assert old.device.state.eeprom_writes == new.device.state.eeprom_writes == 0
