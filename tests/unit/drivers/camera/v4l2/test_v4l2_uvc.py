"""USB cameras: stamps from the metadata node within 50 us of the truth, and an honest fallback."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from vical_drivers.camera.v4l2.uvc import UvcClock, clock_frequency_hz, parse_metadata
from vical_mocks.v4l2_camera import FakeCamera, UvcClockModel

SIZES = {"YUYV": {(64, 48): (30.0,)}}


def usb_camera(**clock: float) -> FakeCamera:
    return FakeCamera(driver="uvcvideo", stamps="first-packet", formats=SIZES, uvc=UvcClockModel(**clock))


def errors_us(camera: FakeCamera, source, frames: int) -> tuple[np.ndarray, list[str]]:
    errors, rules = [], []
    for _ in range(frames):
        frame = source.read(1.0)
        errors.append((frame.t_exposure_mid_ns - camera.truth[frame.sequence].t_mid_ns) * 1e-3)
        rules.append(frame.stamp_rule)
    return np.array(errors), rules


@pytest.mark.parametrize(
    "clock",
    [
        {"frequency_hz": 48e6, "skew_ppm": 37.0},  # wraps after 89 s: twice in this test
        {"frequency_hz": 15e6, "skew_ppm": -80.0},
        {"frequency_hz": 30e6, "skew_ppm": 60.0, "states_frequency": False},
        {"frequency_hz": 26.6e6, "skew_ppm": 0.0, "states_frequency": False},  # no common frequency
        {"frequency_hz": 48e6, "skew_ppm": 20.0, "delay_mean_ns": 1_500_000},
    ],
)
def test_fitted_pts_are_within_50_us_of_the_truth(open_fake, clock: dict[str, float]) -> None:
    camera = usb_camera(**clock)
    source = open_fake(camera, exposure_s=0.012, buffers=4)
    errors, rules = errors_us(camera, source, 2750 if clock.get("skew_ppm") == 37.0 else 900)
    assert set(rules[300:]) == {"uvc-pts+exposure/2"}
    settled = errors[450:]  # after 15 s
    assert np.abs(settled).max() < 50.0, (settled.min(), settled.max())
    stats = source.stats()
    assert stats.extra["uvc_fit_used"] == 1.0
    if clock.get("states_frequency", True) or clock["frequency_hz"] == 30e6:
        assert stats.clock_skew_ppm == pytest.approx(clock["skew_ppm"], abs=3.0)


def test_first_frames_fall_back_to_the_first_packet(open_fake) -> None:
    camera = usb_camera()
    source = open_fake(camera, exposure_s=0.012)
    errors, rules = errors_us(camera, source, 90)
    assert rules[0] == "first-packet-exposure/2"
    assert rules[-1] == "uvc-pts+exposure/2"
    assert np.abs(errors).max() < 5_000  # the fallback is late by the USB delay, never by an exposure


@pytest.mark.parametrize("scatter_ns", [2e6, 60e6])  # the second is what a wrong frame counter does
def test_scattered_clock_readings_are_noticed_and_not_used(open_fake, caplog, scatter_ns: float) -> None:
    caplog.set_level("INFO")
    camera = usb_camera(scatter_ns=scatter_ns)
    source = open_fake(camera, exposure_s=0.012)
    _, rules = errors_us(camera, source, 400)
    assert set(rules[40:]) == {"first-packet-exposure/2"}
    assert "scatter both ways" in caplog.text or "too uncertain" in caplog.text
    assert len(caplog.records) < 8  # said once, not with each frame
    assert source.stats().extra["uvc_fit_used"] == 0.0


def test_a_long_tail_of_lateness_does_no_harm(open_fake) -> None:
    camera = usb_camera(delay_mean_ns=12_000_000)  # a machine under heavy load
    source = open_fake(camera, exposure_s=0.012)
    errors, rules = errors_us(camera, source, 900)
    assert rules.count("uvc-pts+exposure/2") > 600
    fitted = [e for e, rule in zip(errors, rules, strict=True) if rule == "uvc-pts+exposure/2"]
    assert np.percentile(np.abs(fitted), 90) < 400.0


def test_without_metadata_node_the_grabber_says_so(open_fake, caplog) -> None:
    camera = FakeCamera(driver="uvcvideo", stamps="first-packet", formats=SIZES)
    source = open_fake(camera, exposure_s=0.012)
    assert source.read(1.0).stamp_rule == "first-packet-exposure/2"
    assert "no uvc metadata" in caplog.text
    assert source.info.details["uvc_metadata"] == "no"


def test_hwtimestamps_of_the_driver_are_taken_for_what_they_are(open_fake, kernel) -> None:
    parameters = kernel.sysfs / "module/uvcvideo/parameters"
    parameters.mkdir(parents=True)
    (parameters / "hwtimestamps").write_text("1\n")
    camera = FakeCamera(driver="uvcvideo", stamps="soe", formats=SIZES)
    frame = open_fake(camera, exposure_s=0.012).read(1.0)
    assert frame.stamp_rule == "soe(hwtimestamps)+exposure/2"
    assert abs(frame.t_exposure_mid_ns - camera.truth[0].t_mid_ns) < 1000


def test_a_driver_on_the_wall_clock_is_brought_back(open_fake) -> None:
    camera = usb_camera()
    camera.stamp_offset_ns = 1_700_000_000_000_000_000
    source = open_fake(camera, exposure_s=0.012)
    errors, rules = errors_us(camera, source, 600)
    assert rules[-1] == "uvc-pts+exposure/2"
    assert np.abs(errors[300:]).max() < 50.0


def test_a_restarted_camera_clock_starts_a_new_fit() -> None:
    clock = UvcClock(1e6)
    t_ns = 0
    for start in (0, 3_000_000_000):
        for k in range(200):
            t_ns += 10_000_000
            entry = struct.pack("<QHBBIIH", t_ns, 0, 12, 0x0C, 0, start + k * 10_000, 0)
            for header in parse_metadata(entry):
                clock.add(header)
        assert clock.to_host_ns(start + 199 * 10_000) == pytest.approx(t_ns, abs=1_000_000)
    assert clock.restarts == 1


def test_metadata_parser_stops_at_damage() -> None:
    whole = struct.pack("<QHBBIIH", 7, 1, 12, 0x0C, 11, 22, 33) + struct.pack("<QHBB", 8, 2, 2, 0x00)
    headers = list(parse_metadata(whole))
    assert [(h.t_host_ns, h.pts, h.stc, h.device_sof) for h in headers] == [
        (7, 11, 22, 33),
        (8, None, None, None),
    ]
    for cut in range(len(whole)):
        assert len(list(parse_metadata(whole[:cut]))) == (1 if cut >= 22 else 0)
    assert list(parse_metadata(struct.pack("<QHBB", 7, 1, 3, 0x0C) + bytes(20))) == []


def test_clock_frequency_comes_from_the_video_control_header() -> None:
    assert clock_frequency_hz(FakeCamera(uvc=UvcClockModel()).usb_descriptors()) == 48e6
    assert clock_frequency_hz(FakeCamera().usb_descriptors()) is None
    assert clock_frequency_hz(b"\x00\x00") is None
