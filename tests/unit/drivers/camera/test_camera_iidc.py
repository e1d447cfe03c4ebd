"""FireWire: the arithmetic, and the grabber over the real libdc1394 on a preloaded fake bus."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from vical_drivers import errors
from vical_drivers.camera import iidc_abi
from vical_drivers.camera.cycle_clock import WRAP_NS, CycleClock, cycle_time_ns, image_cycle_time_ns
from vical_drivers.camera.embedded import parse_embedded
from vical_drivers.camera.firewire import IOC_GET_CYCLE_TIMER2, BusClock
from vical_mocks import firewire_rig

HERE = Path(__file__).parent


def register_of(cycle_ns: float) -> int:
    wrapped = int(cycle_ns) % WRAP_NS
    seconds, rest = divmod(wrapped, 1_000_000_000)
    return seconds << 25 | rest // 125_000 << 12 | rest % 125_000 * 3072 // 125_000


@pytest.mark.parametrize("ns", [0, 1, 124_999, 125_000, 999_999_999, 1_000_000_000, WRAP_NS - 1])
def test_cycle_time_of_every_field(ns: int) -> None:
    assert 0 <= ns - cycle_time_ns(register_of(ns)) <= 41


def test_image_stamp_ignores_the_counter_in_its_low_bits() -> None:
    for counter in range(16):
        assert image_cycle_time_ns(register_of(5_000_000_000) & ~0xF | counter) == pytest.approx(
            5_000_000_000, abs=700
        )


def test_cycle_clock_maps_through_skew_noise_and_wrap() -> None:
    rng = np.random.default_rng(7)
    clock, ppm, start = CycleClock(), 80.0, 100 * 10**9  # wraps after 28 s
    worst = 0.0
    for k in range(1800):  # 60 s at 30 Hz
        t_ns = 3_000_000_000_000 + k * 33_333_333
        bus_ns = start + (t_ns - 3_000_000_000_000) * (1 + ppm * 1e-6)
        clock.add(register_of(bus_ns), t_ns + round(rng.normal(0, 300)))
        image_ns = t_ns - 20_000_000
        image_bus = start + (image_ns - 3_000_000_000_000) * (1 + ppm * 1e-6)
        mapped = clock.to_host_ns(image_cycle_time_ns(register_of(image_bus)))
        if k > 60:
            worst = max(worst, abs(mapped - image_ns))
    assert worst < 1_500
    assert clock.skew_ppm == pytest.approx(ppm, abs=0.1)
    assert clock.restarts == 0


def test_cycle_clock_restarts_after_a_jump() -> None:
    clock = CycleClock()
    for k in range(100):
        jump = 7_000_000_000 if k >= 50 else 0
        clock.add(register_of(k * 33_000_000 + jump), k * 33_000_000)
    assert clock.restarts == 1
    assert clock.to_host_ns(99 * 33_000_000 + 7_000_000_000) == pytest.approx(99 * 33_000_000, abs=100)
    with pytest.raises(ValueError, match="no cycle timer"):
        CycleClock().to_host_ns(0)


def test_embedded_quadlets_follow_the_enable_bits() -> None:
    head = bytes.fromhex("0a000010 82000320 00001234") + bytes(52)
    info = parse_embedded(head, 0x80000045)
    assert (info.cycle_time, info.shutter, info.frame_counter) == (0x0A000010, 0x320, 0x1234)
    every = b"".join(k.to_bytes(4, "big") for k in range(10))
    info = parse_embedded(every, 0x800003FF)
    assert (info.cycle_time, info.shutter, info.frame_counter) == (0, 2, 6)
    assert parse_embedded(b"", 0x80000045).cycle_time is None
    assert parse_embedded(head, 0).cycle_time is None


def test_structures_have_the_sizes_of_the_library() -> None:
    assert IOC_GET_CYCLE_TIMER2 == 0xC0182314
    for name, (ours, theirs) in iidc_abi.LAYOUT.items():
        assert ours == theirs, name


def test_a_missing_library_names_its_package(monkeypatch) -> None:
    monkeypatch.setattr(iidc_abi, "SONAMES", ("libdc1394-not-here.so.0",))
    monkeypatch.setattr(iidc_abi, "_library", None)
    with pytest.raises(errors.MissingLibraryError, match="apt install libdc1394-25"):
        iidc_abi.load()


def test_a_second_process_is_kept_off_the_camera(tmp_path: Path) -> None:
    node = tmp_path / "fw1"
    node.touch()
    first = BusClock(str(node))
    with pytest.raises(errors.DeviceBusyError, match="another process streams"):
        BusClock(str(node))
    first.close()
    first.close()
    BusClock(str(node)).close()


@pytest.mark.system
@pytest.mark.timeout(400)
def test_the_grabber_over_the_real_libdc1394(tmp_path: Path) -> None:
    """Runs `iidc_under_shim.py`, and the contract of frame sources, in a process on the fake bus.

    The bus runs in real time, and a machine under full load may starve it: what failed is run once more,
    alone, and has to pass then.
    """
    missing = firewire_rig.missing_tools()
    if missing:
        pytest.skip(missing)
    environment = firewire_rig.build(HERE / "fake_firewire.c", tmp_path)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:randomly",
        "-o",
        f"cache_dir={tmp_path / 'cache'}",
    ]
    files = [str(HERE / "iidc_under_shim.py"), f"{HERE / 'test_frame_source_contract.py'}::TestFrameSource"]
    output = ""
    for extra in ([], ["--last-failed"]):
        done = subprocess.run(
            [*command, *extra, *files, "-k", "iidc"],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=180,
            check=False,
        )
        output += done.stdout
        if done.returncode == 0:
            return
    pytest.fail(output)
