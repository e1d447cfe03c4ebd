"""The FireWire grabber over the real libdc1394 and the preloaded fake bus; run by test_iidc.py."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vical_drivers import errors
from vical_drivers.camera import check_camera, list_cameras, open_camera
from vical_mocks.firewire_rig import ENVIRONMENT, GUID, FireWireRig

OpenIidc = Callable[..., Any]
VGA = {"width": 640, "height": 480, "rate_hz": 60.0, "exposure_s": 0.005}


@pytest.fixture
def rig() -> Iterator[FireWireRig]:
    bus = FireWireRig(os.environ[ENVIRONMENT])
    bus.shared.ppm = 37.0
    yield bus
    if bus.shared.no_embedding:
        bus.shared.no_embedding = 0
        power_cycle(bus)
    for name in ("unplugged", "lose_frames", "lose_packets", "no_embedding", "no_bandwidth", "stopped"):
        setattr(bus.shared, name, 0)


@pytest.fixture
def open_iidc(rig: FireWireRig) -> Iterator[OpenIidc]:
    opened = []

    def open_it(**settings: Any) -> Any:
        source = open_camera("iidc:", **{**VGA, **settings})
        opened.append(source)
        return source

    yield open_it
    for source in opened:
        source.close()
    assert rig.shared.opens == rig.shared.closes


def power_cycle(bus: FireWireRig) -> None:
    bus.shared.unplugged = 1
    time.sleep(0.1)
    bus.shared.unplugged = 0


def counter_of(image: np.ndarray) -> int:
    """The frame counter that the camera embedded."""
    return int.from_bytes(image.reshape(-1)[8:12].tobytes(), "big")


def stamp_errors_us(source: Any, rig: FireWireRig, frames: int) -> np.ndarray:
    got = [source.read(1.0) for _ in range(frames)]
    truth = rig.exposures()
    return np.array([(f.t_exposure_mid_ns - truth[counter_of(f.image)].t_mid_ns) * 1e-3 for f in got])


def test_listing_and_info(open_iidc: OpenIidc) -> None:
    (found,) = list_cameras(schemes=("iidc",))
    assert found.details["uri"] == f"iidc:{GUID:016x}"
    assert (found.model, found.path) == ("Point Grey Research Flea fake", "/dev/fw1")
    info = open_iidc().info
    assert info.serial_number == f"{GUID:016x}"
    assert info.details["embedded_stamp"] == "yes"
    assert (info.details["size"], info.details["rate_hz"]) == ("640x480", "60")


def test_embedded_stamps_are_within_50_us_of_the_truth(open_iidc: OpenIidc, rig: FireWireRig) -> None:
    source = open_iidc()
    errors_us = stamp_errors_us(source, rig, 60)
    # a pair read while this process was interrupted shows in the tail, on a loaded machine
    assert np.percentile(np.abs(errors_us), 95) < 50.0
    stats = source.stats()
    assert stats.clock_skew_ppm == pytest.approx(37.0, abs=15.0)
    assert stats.rate_hz == pytest.approx(60.0, rel=1e-3)


def test_the_wrap_of_the_bus_clock_passes_unseen(open_iidc: OpenIidc, rig: FireWireRig) -> None:
    source = open_iidc()
    source.read(1.0)
    cycle_time, _ = source._bus.read()
    source.close()
    rig.shared.cycle_offset_ns += round((127.7 - (cycle_time >> 25)) * 1e9)  # a third of a second to go
    source = open_iidc()
    errors_us = stamp_errors_us(source, rig, 60)
    assert source._bus.read()[0] >> 25 < 100  # it has wrapped
    assert np.abs(errors_us).max() < 200.0
    assert source.stats().extra["bus_clock_restarts"] == 0.0


def test_a_bus_reset_restarts_the_fit_and_stamps_stay_true(open_iidc: OpenIidc, rig: FireWireRig) -> None:
    source = open_iidc()
    stamp_errors_us(source, rig, 10)
    rig.shared.bus_resets += 1
    while source.stats().extra["bus_clock_restarts"] == 0.0:
        frame = source.read(1.0)
        # what was exposed before and is read after it cannot be dated by the new bus clock
        assert abs(frame.t_arrival_ns - frame.t_exposure_mid_ns) < 2e9
    for _ in range(20):  # whatever the ring still held
        source.read(1.0)
    errors_us = stamp_errors_us(source, rig, 20)
    assert np.percentile(np.abs(errors_us), 90) < 50.0
    assert source.stats().extra["bus_clock_restarts"] == 1.0
    assert source.set_exposure(0.004) == pytest.approx(0.004)  # requests get through the new generation


def test_the_image_says_when_a_new_shutter_is_in_force(open_iidc: OpenIidc, rig: FireWireRig) -> None:
    source = open_iidc()
    source.read(1.0)
    source.set_exposure(0.009)
    frames = [source.read(1.0) for _ in range(20)]
    truth = rig.exposures()
    # the register is read once the image shows the change: one frame of both may be met in between
    same = [f.exposure_ns == truth[counter_of(f.image)].exposure_ns for f in frames]
    assert sum(same) >= 19 and frames[-1].exposure_ns == 9_000_000


def test_without_embedding_the_first_packet_dates_the_frame(open_iidc: OpenIidc, rig: FireWireRig) -> None:
    rig.shared.no_embedding = 1
    open_iidc().close()
    power_cycle(rig)  # the register is gone when it comes back
    source = open_iidc()
    frames = [source.read(1.0) for _ in range(30)]
    assert {f.stamp_rule for f in frames} == {"first-packet-exposure/2"}
    middles = np.array([e.t_mid_ns for e in rig.exposures().values()])
    late = np.array(
        [f.t_exposure_mid_ns - middles[np.abs(middles - f.t_exposure_mid_ns).argmin()] for f in frames]
    )
    # the fake camera's latency of 1 ms, in steps of the bus cycle
    assert np.median(late) * 1e-6 == pytest.approx(1.0, abs=0.13)
    rig.shared.lose_frames = 3
    # found by the gap in the stamps; a loaded machine may lose more
    assert sum(source.read(1.0).dropped_before for _ in range(6)) >= 3


def test_an_automatic_exposure_is_called_that(open_iidc: OpenIidc, rig: FireWireRig) -> None:
    """As `vical init` opens a camera: it then writes an exposure into the config, which ends the guessing."""
    asked_nothing: dict[str, Any] = {"exposure_s": None}
    with open_iidc(**asked_nothing) as source:  # the image says which shutter it had
        assert float(source.info.details["exposure_s"]) > 0.0
    rig.shared.no_embedding = 1
    power_cycle(rig)
    with open_iidc(**asked_nothing) as source:
        assert source.info.details["exposure_s"] == "automatic"
        assert source.read(1.0).stamp_rule == "raw-first-packet"
    with open_iidc() as source:
        assert source.info.details["exposure_s"] == "0.005"
        assert source.read(1.0).stamp_rule == "first-packet-exposure/2"


def test_losses_are_found_by_the_embedded_counter(open_iidc: OpenIidc, rig: FireWireRig) -> None:
    source = open_iidc(buffers=6)
    frames = [source.read(1.0)]
    rig.shared.lose_frames = 4
    assert lost_in(source, frames, 8) >= 4
    time.sleep(0.4)  # the ring of 6 overruns
    assert lost_in(source, frames, 12) > 10
    counters = [counter_of(f.image) for f in frames]
    assert source.stats().lost == counters[-1] - counters[0] - (len(frames) - 1)


def is_whole(image: np.ndarray) -> bool:
    """Whether every row shows what the camera drew there (the first one begins with embedded data)."""
    rows = (int(image[0, -1]) + np.arange(image.shape[0])) & 0x7F
    return bool((image[1:] == rows[1:, None]).all())


@pytest.mark.parametrize("embedding", [True, False])
@pytest.mark.parametrize(
    ("packets", "at"),
    [(1, 0), (1, 1), (1, 60), (1, 119), (5, 40), (4, 118), (120, 0), (130, 3)],
    ids=lambda value: str(value),
)
def test_a_frame_with_lost_packets_is_never_delivered(
    open_iidc: OpenIidc, rig: FireWireRig, embedding: bool, packets: int, at: int
) -> None:
    if not embedding:
        rig.shared.no_embedding = 1
        open_iidc().close()
        power_cycle(rig)
    source = open_iidc()  # 120 packets a frame
    frames = [source.read(1.0) for _ in range(3)]
    never_begins = at == 0  # then no buffer holds a part of it
    for _ in range(20):  # more than two where this process is held up and the ring is full meanwhile
        rig.shared.lose_at, rig.shared.lose_packets = at, packets
        while rig.shared.lose_packets:
            frames.append(source.read(1.0))
        frames += [source.read(1.0) for _ in range(5)]
        stats = source.stats()
        known, doubtful = (stats.extra.get(f"{kind}_images", 0) for kind in ("shifted", "doubtful"))
        header_inside = embedding and at + packets <= 120  # the next image's
        if (stats.lost if never_begins else known if header_inside else known + doubtful) >= 2:
            break
    else:
        pytest.fail(f"losses are not found: {stats}")
    assert all(is_whole(f.image) for f in frames)
    assert stats.samples == len(frames)
    assert known + doubtful == stats.checksum_errors


def lost_in(source: Any, frames: list[Any], count: int) -> int:
    new = [source.read(1.0) for _ in range(count)]
    frames += new
    return sum(f.dropped_before for f in new)


def test_format7_region_in_the_middle(open_iidc: OpenIidc) -> None:
    source = open_iidc(width=800, height=600, rate_hz=20.0)
    assert source.read(1.0).image.shape == (600, 800)
    assert source.info.details["rate_hz"] == "20"
    source.close()
    with pytest.raises(errors.DeviceRefusedError, match="at most 1280x960 in steps of 8x2"):
        open_iidc(width=801, height=600)
    raw = open_iidc(width=320, height=240, rate_hz=30.0, pixel_format="raw8", encoding="bgr8")
    assert raw.read(1.0).image.shape == (240, 320, 3)


def test_refusals_say_why(open_iidc: OpenIidc, rig: FireWireRig) -> None:
    with pytest.raises(errors.DeviceRefusedError, match=r"shutter 2 s is out of range: 1e-05 to 0.03 s"):
        open_iidc(exposure_s=2.0)
    rig.shared.no_bandwidth = 1
    with pytest.raises(errors.DriverError, match="ring up"):
        open_iidc()
    with pytest.raises(errors.DeviceNotFoundError, match=f"on the bus: iidc:{GUID:016x}"):
        open_camera("iidc:0123456789abcdef")
    with pytest.raises(errors.DeviceRefusedError, match="not a GUID"):
        open_camera("iidc:flea")


def test_silence_and_unplug_end_in_a_return_without_leaks(open_iidc: OpenIidc, rig: FireWireRig) -> None:
    source = open_iidc()
    source.read(1.0)
    threads = threading.active_count()
    descriptors = None
    cycles = int(os.environ.get("VICAL_FAULT_CYCLES", "8"))
    for _ in range(cycles):
        rig.shared.unplugged = 1
        with pytest.raises(errors.DeviceLostError):
            read_on(source)
        rig.shared.unplugged = 0
        frame = wait_for_frame(source)
        assert frame.exposure_ns == 5_000_000  # settings were applied again
        open_now = len(list(Path("/proc/self/fd").iterdir()))
        descriptors = descriptors or open_now
        assert open_now <= descriptors
    assert source.stats().reconnects == cycles
    assert threading.active_count() == threads
    rig.shared.stopped = 1  # a short unplug: same node, but the camera has forgotten to send
    with pytest.raises(errors.DeviceLostError, match="no frame for"):
        read_on(source)
    rig.shared.stopped = 0
    wait_for_frame(source)


def wait_for_frame(source: Any) -> Any:
    for _ in range(50):
        with contextlib.suppress(errors.DeviceLostError):
            frame = source.read(0.5)
            if frame is not None:
                return frame
    raise AssertionError("the camera did not come back")


def read_on(source: Any) -> None:
    while True:
        source.read(0.5)


def test_check_camera_finds_nothing_wrong(rig: FireWireRig) -> None:
    assert check_camera("iidc:", **VGA) == []
    (problem,) = check_camera("iidc:", **{**VGA, "exposure_s": 5.0})
    assert "out of range" in problem
