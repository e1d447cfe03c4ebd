"""Any MicroStrain sensor that VICAL_IMU names (a port): samples, stamps, exclusive use, a stop at the end.

Without hardware: `python -m vical_mocks.gx3_emulator` prints a port to name; or in a guest whose kernel
has cdc_acm or ftdi_sio, before an emulated device.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from vical_drivers.errors import DeviceBusyError
from vical_drivers.microstrain.device import MicrostrainImu, open_imu
from vical_drivers.microstrain.port import SerialPort, latency_timer_ms, link_of, wait_for_silence
from vical_drivers.samples import ImuSample

pytestmark = pytest.mark.hardware


@pytest.fixture(scope="module")
def port() -> str:
    name = os.environ.get("VICAL_IMU", "")
    if not name:
        pytest.skip("VICAL_IMU names no serial port with an IMU behind it")
    return name


def stream(imu: MicrostrainImu, seconds: float) -> list[ImuSample]:
    samples, end_s = [], time.monotonic() + seconds
    while time.monotonic() < end_s:
        samples += imu.read(0.2)
    return samples


def test_who_it_is_and_that_stamps_are_even(port: str) -> None:
    with open_imu(port, rate_hz=100.0) as imu:
        assert imu.info.serial_number and imu.info.firmware and imu.info.model
        samples = stream(imu, 6.0)
        stats = imu.stats()
    assert len(samples) > 400 and stats.lost == 0 and stats.checksum_errors == 0
    t_ns = np.array([s.t_host_ns for s in samples], dtype=float)
    assert (np.diff(t_ns) > 0).all()
    numbers = np.cumsum([1 + s.lost_before for s in samples])
    residual_ns = t_ns - np.polyval(np.polyfit(numbers, t_ns, 1), numbers)
    assert residual_ns.std() < 1e6
    force = np.linalg.norm([s.specific_force_mps2 for s in samples], axis=1)
    assert 5.0 < np.median(force) < 15.0


def test_nobody_else_gets_in_and_the_stream_ends_with_us(port: str) -> None:
    with open_imu(port, rate_hz=100.0) as imu:
        stream(imu, 1.5)
        with pytest.raises(DeviceBusyError):
            SerialPort(port)
    after = SerialPort(port)
    try:
        assert wait_for_silence(after, 0.3, 1.0)
    finally:
        after.close()


def test_an_ftdi_chip_is_told_to_hurry(port: str) -> None:
    if link_of(port) != "ftdi":
        pytest.skip(f"{port} is no FTDI port")
    opened = SerialPort(port)
    try:
        assert latency_timer_ms(port) == 1
    finally:
        opened.close()


def test_opening_again_and_again_leaves_nothing(port: str) -> None:
    def cycle() -> int:
        with open_imu(port, rate_hz=100.0, warm_up_s=0.1) as imu:
            stream(imu, 0.3)
        return len(list(Path("/proc/self/fd").iterdir()))

    first = cycle()
    assert all(cycle() <= first for _ in range(10))
