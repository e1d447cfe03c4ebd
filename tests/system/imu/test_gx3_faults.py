"""The driver when things go wrong on a pseudo terminal: damage, unplugging, silence, restarts, SIGTERM."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from vical_drivers.errors import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceReplacedError,
    DriverError,
)
from vical_drivers.microstrain import device
from vical_drivers.microstrain.device import open_imu
from vical_drivers.microstrain.probe import PROBE_BAUDS
from vical_mocks.faults import ByteFaults
from vical_mocks.gx3_state import Settings

pytestmark = pytest.mark.system
FAST = {"warm_up_s": 0.1}


def collect(imu, count, limit_s=8.0):
    samples, end_s = [], time.monotonic() + limit_s
    while len(samples) < count and time.monotonic() < end_s:
        samples += imu.read(0.2)
    assert len(samples) >= count, imu.stats()
    return samples


@pytest.mark.parametrize("protocol", ["single-byte", "mip"])
def test_damage_costs_samples_but_nothing_else(emulate, protocol):
    emulator = emulate(protocol=protocol)
    with open_imu(emulator.port_name, protocol=protocol, rate_hz=500.0, **FAST) as imu:
        emulator.damage(ByteFaults(lose=5e-4, flip=5e-4, double=5e-4, insert=5e-4, seed=3))
        samples = collect(imu, 500)
        stats = imu.stats()
        emulator.damage(None)
    assert stats.checksum_errors > 2
    assert stats.resync_bytes > 50
    assert 2 < stats.lost < 100
    forces = np.array([s.specific_force_mps2 for s in samples])
    np.testing.assert_allclose(forces, np.tile([0.0, 0.0, -9.80665], (len(forces), 1)), atol=1e-6)


def test_unplug_and_replug_many_times(emulate):
    emulator = emulate()
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    with open_imu(emulator.port_name, rate_hz=500.0, warm_up_s=0.02) as imu:
        collect(imu, 5)
        for _ in range(3):
            emulator.unplug()
            with pytest.raises(DeviceLostError):
                collect(imu, 10_000)
            emulator.plug()
            collect(imu, 5)
        assert imu.stats().reconnects == 3
    end = time.monotonic() + 10.0  # the emulator's thread opens a folder of /proc now and then
    while len(os.listdir("/proc/self/fd")) > before and time.monotonic() < end:  # noqa: PTH208
        time.sleep(0.01)
    assert len(os.listdir("/proc/self/fd")) <= before  # noqa: PTH208


@pytest.mark.parametrize("protocol", ["single-byte", "mip"])
@pytest.mark.parametrize("outage", ["unplugged", "without power"])
def test_after_an_outage_it_is_soon_back(emulate, protocol, outage):
    # measured: 1.2 to 2.5 s, of which the clock mapping warms up for 1 s
    emulator = emulate(protocol=protocol, link="uart")
    with open_imu(emulator.port_name, rate_hz=100.0, silence_s=0.5) as imu:
        collect(imu, 5)
        leave, come_back = (
            (emulator.unplug, emulator.plug)
            if outage == "unplugged"
            else (emulator.power_off, emulator.power_on)
        )
        leave()
        until_s = time.monotonic() + 4.5  # of them 0.5 s until silence counts as a loss
        cpu_s = time.process_time()
        while time.monotonic() < until_s:
            with contextlib.suppress(DriverError):
                imu.read(0.2)
        # 0.07 s; without power it had been up to 2.5 s, as the emulator never slept
        assert time.process_time() - cpu_s < 0.6
        come_back()
        back_s = time.monotonic()
        while not imu.read(0.2):
            assert time.monotonic() - back_s < 8.0
        assert imu.stats().reconnects == 1


def test_attempts_to_come_back_follow_each_other_closely_and_look_everywhere(emulate, monkeypatch):
    emulator = emulate()
    with open_imu(emulator.port_name, rate_hz=100.0, **FAST, silence_s=0.3) as imu:
        collect(imu, 5)
        emulator.power_off()
        with pytest.raises(DriverError, match="silent"):
            collect(imu, 10_000)
        tried, pauses = [], []

        def connect(path, protocol, link, bauds, patient):
            assert not patient
            tried.append((protocol, tuple(bauds)))
            raise DeviceNotFoundError(path)

        def sleep(pause_s):
            pauses.append(pause_s)
            imu._next_attempt_ns = 0

        monkeypatch.setattr(device, "connect", connect)
        monkeypatch.setattr(device.time, "sleep", sleep)
        for _ in range(16):
            imu.read(10.0)
        of_a_silent_port = tried[:]
        emulator.unplug()
        imu.read(10.0)  # from now on the port is not there
        tried.clear()
        for _ in range(4):
            imu.read(10.0)
        monkeypatch.undo()
    assert tried == [("single-byte", (115_200,))] * 4  # so that it is asked so when it is there again
    tried = of_a_silent_port
    assert tried[::2] == [("single-byte", (115_200,))] * 8  # as it was
    assert {bauds for _, bauds in tried[1::2]} == {(baud,) for baud in PROBE_BAUDS}
    assert {protocol for protocol, _ in tried[1::2]} == {"auto"}
    assert max(pauses) <= 0.25


def test_another_device_on_the_port_does_not_continue_the_old_one(emulate):
    emulator = emulate(serial_number="6223-00001")
    with open_imu(emulator.port_name, rate_hz=500.0, **FAST) as imu:
        collect(imu, 5)
        emulator.unplug()
        with pytest.raises(DeviceLostError):
            collect(imu, 10_000)
        emulator.device.state.identity.serial_number = "6223-00002"
        emulator.plug()
        with pytest.raises(DeviceReplacedError, match="6223-00002, not 3DM-GX3-25 serial 6223-00001"):
            collect(imu, 10_000)
        assert imu.info.serial_number == "6223-00001"
        with pytest.raises(DeviceLostError, match="closed"):
            imu.read(0.0)
        with open_imu(emulator.port_name, rate_hz=500.0, **FAST) as other:  # the port is free
            assert other.info.serial_number == "6223-00002"
            collect(other, 5)


def test_a_silent_device_is_noticed(emulate):
    emulator = emulate()
    with open_imu(emulator.port_name, **FAST, silence_s=0.3) as imu:
        collect(imu, 10)
        emulator.device.face.power_up()
        start_s = time.monotonic()
        with pytest.raises(DriverError, match="silent"):
            collect(imu, 10_000)
        assert time.monotonic() - start_s < 2.0
        collect(imu, 5)  # and it comes back by itself


def test_a_host_that_was_away_does_not_call_the_device_silent(emulate):
    emulator = emulate()
    with open_imu(emulator.port_name, **FAST, silence_s=0.3) as imu:
        collect(imu, 10)
        with (
            emulator.paused()
        ):  # host and device stand still together, as when a virtual machine is not scheduled
            imu.read(0.0)
            time.sleep(0.5)
            imu.read(0.0)
        collect(imu, 60)
        assert imu.stats().reconnects == 0


def test_a_restarted_device_clock_is_noticed(emulate):
    emulator = emulate()
    with open_imu(emulator.port_name, rate_hz=200.0, **FAST) as imu:
        collect(imu, 50)
        emulator.device.state.ticks_offset += 3_000_000_000
        samples = collect(imu, 50)
        assert imu.stats().extra["clock_restarts"] == 1
    assert (np.diff([s.t_host_ns for s in samples]) > 0).all()


@pytest.mark.parametrize(
    "options",
    [{"protocol": "mip"}, {"eeprom": Settings(power_up_mode=2, preset_command=0xC2)}],
    ids=["mip", "single-byte"],
)
def test_a_device_that_was_reset_gets_its_settings_again(emulate, options):
    """Its filter was that of the EEPROM from then on: stamps 5 ms off, and half of the samples "lost"."""
    emulator = emulate(link="uart", **options)
    with open_imu(emulator.port_name, rate_hz=200.0, filter_width=5, **FAST) as imu:
        collect(imu, 20)
        emulator.power_off()
        emulator.power_on()
        assert emulator.device.state.settings.taps == 15
        collect(imu, 200)
        assert emulator.device.state.settings.taps == imu.applied.filter_width == 5
        stats = imu.stats()
        assert (stats.reconnects, stats.extra["clock_restarts"]) == (1, 1.0)
        assert stats.rate_hz == pytest.approx(200.0, rel=0.01)


def test_a_port_without_a_device_and_a_port_in_use(emulate):
    emulator = emulate()
    with open_imu(emulator.port_name, **FAST), pytest.raises(DeviceBusyError):
        open_imu(emulator.port_name)
    emulator.device.face.receive = lambda data: None
    with pytest.raises(DeviceNotFoundError, match="no MicroStrain sensor that speaks mip answers"):
        open_imu(emulator.port_name, protocol="mip")


VICAL = (sys.executable, "-c", "import sys; from vical_daemon.cli import main; sys.exit(main())")


def test_sigterm_stops_the_stream(emulate):
    emulator = emulate()
    command = [*VICAL, "imu", "stream", emulator.port_name, "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            first = json.loads(process.stdout.readline())
            process.send_signal(signal.SIGTERM)
            rest = process.stdout.read().splitlines()
            assert process.wait(60) == 0
        finally:
            process.kill()
    assert set(first) >= {"t_host_ns", "device_ticks", "gyro_rps", "accel_mps2"}
    assert json.loads(rest[-1])["summary"]["lost"] == 0
    assert not emulator.device.face.streaming
