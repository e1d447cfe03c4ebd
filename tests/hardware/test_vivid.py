"""The V4L2 grabber on the kernel's own virtual camera (`modprobe vivid`), with its injected faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vical_drivers import errors
from vical_drivers.camera import CameraSettings, check_camera, list_cameras
from vical_drivers.camera.v4l2.camera import V4l2Camera

pytestmark = pytest.mark.hardware

OpenVivid = Callable[..., V4l2Camera]
SMALL = {"width": 320, "height": 180, "rate_hz": 30.0}


@pytest.fixture(scope="module")
def node() -> str:
    for name in sorted(Path("/sys/class/video4linux").glob("video*/name")):
        if name.read_text().startswith("vivid") and "cap" in name.read_text():
            return f"/dev/{name.parent.name}"
    pytest.skip("no vivid camera: sudo modprobe vivid n_devs=1 node_types=0x1")


@pytest.fixture
def open_vivid(node: str) -> Iterator[OpenVivid]:
    opened: list[V4l2Camera] = []

    def open_it(**settings: Any) -> V4l2Camera:
        source = V4l2Camera(node, CameraSettings(**{**SMALL, **settings}))
        opened.append(source)
        return source

    yield open_it
    for source in opened:
        source.close()


def take(source: V4l2Camera, count: int) -> list[Any]:
    frames = [source.read(5.0) for _ in range(count)]
    assert all(frame is not None for frame in frames)
    return frames


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_a_picture_that_is_still_held_does_not_keep_the_camera_busy(open_vivid: OpenVivid) -> None:
    source = open_vivid(borrow=True)
    (frame,) = take(source, 1)
    copy = frame.image.copy()
    source.close()
    again = open_vivid()
    take(again, 2)
    assert np.array_equal(frame.image, copy)  # its memory outlives the camera


def test_is_listed(node: str) -> None:
    found = {camera.path: camera for camera in list_cameras(schemes=("v4l2",))}
    assert found[node].details["driver"] == "vivid"


def test_frames_follow_the_clock_of_the_driver(open_vivid: OpenVivid) -> None:
    source = open_vivid()
    assert source.info.details["size"] == "320x180"
    frames = take(source, 45)
    assert {f.stamp_rule for f in frames} == {"raw-eof"}  # it has no exposure
    numbers = np.array([f.sequence for f in frames])
    stamps = np.array([f.t_exposure_mid_ns for f in frames], dtype=float)
    slope = np.polyfit(numbers, stamps, 1)[0]
    assert slope == pytest.approx(1e9 / 30.0, rel=0.02)
    assert source.stats().lost == sum(f.dropped_before for f in frames)


@pytest.mark.parametrize(
    ("pixel_format", "encoding", "shape"),
    [
        ("GREY", "mono8", (180, 320)),
        ("Y16", "mono16", (180, 320)),
        ("YUYV", "mono8", (180, 320)),
        ("YUYV", "bgr8", (180, 320, 3)),
        ("UYVY", "bgr8", (180, 320, 3)),
        ("NV12", "bgr8", (180, 320, 3)),
        ("RGGB", "bgr8", (180, 320, 3)),
        ("RG10", "mono8", (180, 320)),
        ("BGR3", "bgr8", (180, 320, 3)),
        ("RGB3", "mono8", (180, 320)),
    ],
)
def test_every_format_shows_the_same_picture(
    open_vivid: OpenVivid, pixel_format: str, encoding: str, shape: tuple[int, ...]
) -> None:
    source = open_vivid(pixel_format="BGR3", encoding="bgr8")
    plain = take(source, 2)[1].image[shape[0] * 3 // 4].astype(float)  # a row below the moving text
    source.close()
    frame = take(open_vivid(pixel_format=pixel_format, encoding=encoding), 2)[1]
    assert frame.image.shape == shape
    row = frame.image[shape[0] * 3 // 4].astype(float)
    if encoding != "bgr8":
        weights = [0.25, 0.5, 0.25] if pixel_format.startswith("RG1") else [0.114, 0.587, 0.299]
        plain = plain @ np.array(weights)
        row /= 257 if encoding == "mono16" else 1
        if pixel_format == "YUYV":  # luma as it comes: 16 to 235
            plain = 16 + plain * 219 / 255
    assert np.median(np.abs(row - plain)) < 6.0
    assert np.ptp(row) > 100


@pytest.mark.parametrize(("source", "rule"), [(0, "eof-readout-exposure/2"), (1, "soe+exposure/2")])
def test_both_anchors(open_vivid: OpenVivid, source: int, rule: str) -> None:
    camera = open_vivid(assume_exposure_s=0.01, controls={"timestamp_source": source})
    assert take(camera, 3)[2].stamp_rule == rule
    camera.controls.set("timestamp_source", 0)


def test_dropped_buffers_are_counted_by_sequence(open_vivid: OpenVivid) -> None:
    source = open_vivid(controls={"percentage_of_dropped_buffers": 30})
    frames = take(source, 40)
    source.controls.set("percentage_of_dropped_buffers", 0)
    lost = sum(f.dropped_before for f in frames[1:])
    assert lost == frames[-1].sequence - frames[0].sequence - 39
    assert 3 <= lost <= 40


def test_a_flagged_buffer_is_skipped(open_vivid: OpenVivid) -> None:
    source = open_vivid()
    take(source, 2)
    source.controls.set("inject_v4l2_buf_flag_error", 1)
    take(source, 10)
    assert source.stats().extra["flagged_buffers"] == 1


def test_wrapping_numbers_and_stamps(open_vivid: OpenVivid) -> None:
    source = open_vivid(controls={"wrap_sequence_number": 1})
    frames = take(source, 140)  # it starts 128 frames before the wrap
    assert frames[0].sequence > 0xFFFFFF00 > frames[-1].sequence
    assert source.stats().lost < 100
    source.controls.set("wrap_sequence_number", 0)
    source.close()
    source = open_vivid(controls={"wrap_timestamp": 1})
    assert take(source, 2)[1].stamp_rule in ("raw-arrival", "raw-eof")
    source.controls.set("wrap_timestamp", 0)


def test_a_second_process_is_refused(open_vivid: OpenVivid, node: str) -> None:
    first = open_vivid()
    with pytest.raises(errors.DeviceBusyError, match="another process"):
        V4l2Camera(node, CameraSettings(**SMALL))
    take(first, 2)


def test_refusals(open_vivid: OpenVivid, node: str) -> None:
    with pytest.raises(errors.DeviceRefusedError, match="it offers"):
        open_vivid(width=321, height=181)
    with pytest.raises(errors.DeviceRefusedError, match="no pixel format MJPG"):
        open_vivid(pixel_format="MJPG")
    with pytest.raises(errors.DeviceRefusedError, match="assume_exposure_s"):
        open_vivid(exposure_s=0.01)
    assert check_camera(node, **SMALL, assume_exposure_s=0.01) == []


def test_injected_failures_free_everything(open_vivid: OpenVivid) -> None:
    held = open_vivid()
    controls = held.controls
    for button in ("inject_vidioc_reqbufs_error", "inject_vidioc_streamon_error"):
        if controls.find(button) is None:
            continue
        before = open_files()
        controls.set(button, 1)
        held.close()
        with pytest.raises(errors.DriverError):
            open_vivid()
        held = open_vivid()
        controls = held.controls
        assert open_files() == before
    take(held, 2)


def test_a_disconnect_is_told_leaves_nothing_and_the_camera_comes_back(open_vivid: OpenVivid) -> None:
    """Vivid plugs itself in again when the last file is closed."""
    source = open_vivid()
    before = open_files()
    take(source, 3)
    source.controls.set("disconnect", 1)
    with pytest.raises(errors.DeviceLostError):
        take(source, 20)
    assert open_files() == before - 1
    take(source, 3)
    assert source.stats().reconnects == 1
    assert open_files() == before
