"""FireWire: the arithmetic, and the grabber over the real libdc1394 on a preloaded fake bus."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from vical_drivers import errors
from vical_drivers.camera.iidc import abi as iidc_abi
from vical_drivers.camera.iidc import firewire
from vical_drivers.camera.iidc.completeness import Completeness, check_completeness
from vical_drivers.camera.iidc.cycle_clock import WRAP_NS, CycleClock, cycle_time_ns, image_cycle_time_ns
from vical_drivers.camera.iidc.embedded import parse_embedded
from vical_drivers.camera.iidc.firewire import IOC_GET_CYCLE_TIMER2, BusClock
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


CAMERA, ADAPTER = 0x00B09D0100A1B2C3, 0x0012345678ABCDEF


def closed_bus(tmp_path: Path, monkeypatch, units: dict[str, tuple[int, str]]) -> tuple[Path, Path]:
    """Nodes that nobody may open, and what sysfs shows everybody of them."""
    dev, sysfs = tmp_path / "dev", tmp_path / "sys"
    dev.mkdir()
    for name, (guid, text) in units.items():
        (dev / name).touch()
        facts = sysfs / "bus/firewire/devices" / name
        facts.mkdir(parents=True)
        (facts / "guid").write_text(f"{guid:#018x}\n")
        if text:
            (facts / "units").write_text(text + "\n")

    def refuse(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(firewire.os, "open", refuse)
    return dev, sysfs


@pytest.mark.parametrize("units", ["", "0x00609e:0x010483"], ids=["no units", "a disk"])
def test_a_closed_node_that_is_no_camera_is_no_matter_of_permission(tmp_path, monkeypatch, units) -> None:
    dev, sysfs = closed_bus(tmp_path, monkeypatch, {"fw0": (ADAPTER, units)})
    assert firewire.find_node(None, dev, sysfs) is None
    assert firewire.find_node(CAMERA, dev, sysfs) is None


def test_a_closed_camera_is_named_and_nothing_else(tmp_path, monkeypatch) -> None:
    there = {"fw0": (ADAPTER, ""), "fw1": (CAMERA, "0x00a02d:0x000102")}
    dev, sysfs = closed_bus(tmp_path, monkeypatch, there)
    for asked in (CAMERA, None):
        with pytest.raises(errors.DevicePermissionError, match="group 'video'") as raised:
            firewire.find_node(asked, dev, sysfs)
        assert "fw1" in str(raised.value) and "fw0" not in str(raised.value)
    (sysfs / "bus/firewire/devices/fw1/guid").unlink()  # no sysfs: it may be the camera
    with pytest.raises(errors.DevicePermissionError):
        firewire.find_node(CAMERA, dev, sysfs)


@pytest.mark.system
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
    files = [
        str(HERE / "iidc_under_shim.py"),
        f"{HERE.parent / 'test_frame_source_contract.py'}::TestFrameSource",
    ]
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


PACKET, PACKETS, RATE_HZ = 640, 120, 30.0
ITEMS = 0x80000045
COUNTER = 4


def header_of(counter: int, t_ns: int) -> bytes:
    quadlets = (register_of(t_ns) & ~0xF | counter & 0xF, 0x82000320, counter)
    return b"".join(word.to_bytes(4, "big") for word in quadlets)


def image_of(counter: int, level: int = 0) -> bytearray:
    image = bytearray([level]) * (PACKET * PACKETS)
    image[:12] = header_of(counter, 10**9 + counter * 33_333_333)
    return image


def verdict_on(image: bytearray, age_ns: int, items: int = ITEMS) -> Completeness:
    data = np.frombuffer(bytes(image), dtype=np.uint8)
    return check_completeness(data, PACKET, parse_embedded(bytes(image[:64]), items), items, age_ns, RATE_HZ)


@pytest.mark.parametrize("lost", [1, 2, 50, 119])
def test_the_header_of_the_next_image_tells_a_lost_packet(lost: int) -> None:
    shifted = image_of(COUNTER)[: -lost * PACKET] + image_of(COUNTER + 1)[: lost * PACKET]
    assert verdict_on(shifted, age_ns=34_000_000) is Completeness.SHIFTED
    assert verdict_on(shifted, age_ns=16_000_000) is Completeness.SHIFTED
    # without the counter only the time is left
    assert verdict_on(shifted, age_ns=34_000_000, items=0x80000001) is Completeness.UNDECIDED


def test_an_image_that_was_complete_in_time_is_whole() -> None:
    assert verdict_on(image_of(COUNTER), age_ns=30_000_000) is Completeness.COMPLETE
    assert verdict_on(image_of(COUNTER), age_ns=33_000_000) is Completeness.UNDECIDED
    assert (
        verdict_on(image_of(COUNTER), age_ns=-5_000_000) is Completeness.UNDECIDED
    )  # the wall clock was set
    data = np.zeros(100, dtype=np.uint8)
    assert (
        check_completeness(data, 0, parse_embedded(b"", 0), 0, 1_000, 0.0) is Completeness.UNDECIDED
    )  # rate unknown


def test_pixels_that_read_like_the_next_counter_are_no_header() -> None:
    dark = image_of(COUNTER)
    for packet in range(1, PACKETS):  # a counter of 5 is three black pixels and one nearly black
        dark[packet * PACKET + 8 : packet * PACKET + 12] = (COUNTER + 1).to_bytes(4, "big")
    assert verdict_on(dark, age_ns=16_000_000) is Completeness.COMPLETE
    off_the_boundary = image_of(COUNTER)
    off_the_boundary[7 * PACKET + 3 : 7 * PACKET + 15] = header_of(COUNTER + 1, 2 * 10**9)
    assert verdict_on(off_the_boundary, age_ns=16_000_000) is Completeness.COMPLETE
