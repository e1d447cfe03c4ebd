"""What the V4L2 grabber does when things go wrong; each outcome of the table in `v4l2.py`."""

from __future__ import annotations

import errno
import threading

import numpy as np
import pytest
from vical_drivers import errors
from vical_drivers.camera import check_camera
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.v4l2.camera import V4l2Camera
from vical_drivers.camera.v4l2.discovery import NodeEntry
from vical_mocks.v4l2_camera import CID_EXPOSURE_AUTO, FakeCamera

REQBUFS, STREAMON, DQEVENT = 8, 18, 89


def read_on(source: V4l2Camera) -> None:
    while True:
        source.read(1.0)


def test_unplug_is_told_and_the_camera_comes_back_under_another_number(open_fake, kernel) -> None:
    camera = FakeCamera(faults={5: "unplug"})
    source = open_fake(camera, exposure_s=0.004)
    for _ in range(5):
        source.read(1.0)
    with pytest.raises(errors.DeviceLostError, match="went away"):
        source.read(1.0)
    assert kernel.open_descriptors == 0 and not kernel.mappings
    with pytest.raises(errors.DeviceLostError, match="still away"):
        source.read(0.2)
    camera.faults = {}
    for control in camera.controls:  # a camera forgets its settings without power
        control.value = {0x009A0901: 3, 0x009A0902: 100}.get(control.control_id, control.value)
    kernel.plug(camera, number=4)
    frame = source.read(1.0)
    assert frame.exposure_ns == 4_000_000
    assert frame.dropped_before == 0
    assert source.stats().reconnects == 1


@pytest.mark.parametrize("code", [errno.ENODEV, errno.EIO])
def test_an_unplug_is_called_an_unplug_whatever_was_asked_then(open_fake, kernel, code: int) -> None:
    camera = FakeCamera()
    source = open_fake(camera, exposure_s=0.004)
    source.read(1.0)
    kernel._plugged[str(kernel.dev / "video0")].events.append(CID_EXPOSURE_AUTO)
    camera.request_errno[DQEVENT] = code
    with pytest.raises(errors.DeviceLostError) as raised:
        read_on(source)
    said = {errno.ENODEV: "the camera went away", errno.EIO: "the camera fails to report changes"}[code]
    assert str(raised.value).startswith(f"{kernel.dev}/video0: {said}")
    assert "check its cable" in str(raised.value)


def test_another_camera_in_the_same_place_is_not_taken_for_the_lost_one(open_fake, kernel) -> None:
    camera = FakeCamera(faults={1: "unplug"})
    source = open_fake(camera)
    source.read(1.0)
    with pytest.raises(errors.DeviceLostError):
        source.read(1.0)
    kernel.plug(FakeCamera(serial_number="OTHER"), number=0)
    with pytest.raises(errors.DeviceLostError, match="still away"):
        source.read(0.1)


@pytest.mark.parametrize("port", ["1-3", "1-4"])
def test_of_two_cameras_with_one_serial_number_the_lost_one_comes_back(open_fake, kernel, port: str) -> None:
    """Its twin, found first, is in use: it was tried again and again, and the lost one never came back."""
    kernel.plug(FakeCamera(port="1-1"), number=0)
    camera = FakeCamera(port="1-3", faults={1: "unplug"})
    source = open_fake(camera, number=2)
    source.read(1.0)
    with pytest.raises(errors.DeviceLostError, match="went away"):
        source.read(1.0)
    with pytest.raises(errors.DeviceLostError, match="video2: the camera is still away"):
        source.read(0.1)
    camera.faults, camera.port = {}, port
    kernel.plug(camera, number=6)
    assert source.read(1.0) is not None and source._entry.path.endswith("video6")


def test_without_serial_numbers_another_camera_in_the_port_has_another_identity() -> None:
    def identity(name: str, port: str, serial_number: str = "") -> str:
        return NodeEntry("/dev/video0", name, 0, serial_number, port).identity

    assert identity("One", "1-1") != identity("Two", "1-1")
    assert identity("One", "1-1") != identity("One", "1-2")
    assert identity("One", "1-1", "SN") == identity("One", "1-2", "SN") == "SN"


@pytest.mark.parametrize(
    ("fault", "counter"),
    [("empty", "empty_buffers"), ("flagged", "flagged_buffers"), ("short", "corrupt_images")],
)
def test_bad_buffers_are_counted_skipped_and_given_back(open_fake, fault: str, counter: str) -> None:
    source = open_fake(FakeCamera(faults=dict.fromkeys(range(2, 12), fault)), buffers=3)
    frames = [source.read(1.0) for _ in range(6)]
    assert [f.sequence for f in frames] == [0, 1, 12, 13, 14, 15]
    assert frames[2].dropped_before == 10
    stats = source.stats()
    assert (stats.samples, stats.lost, stats.extra[counter]) == (6, 10, 10)


def test_a_jump_of_the_sequence_is_a_loss(open_fake) -> None:
    source = open_fake(FakeCamera(faults={3: "lost", 4: "lost"}))
    frames = [source.read(1.0) for _ in range(5)]
    assert [f.dropped_before for f in frames] == [0, 0, 0, 2, 0]
    assert source.stats().lost == 2
    assert source.stats().rate_hz == pytest.approx(30.0, rel=1e-6)


def test_frames_that_never_leave_the_camera_are_found_by_the_stamps(open_fake) -> None:
    kept = dict.fromkeys([*range(20, 33), 50, 70, 72], "kept") | {40: "lost", 90: "lost", 91: "kept"}
    camera = FakeCamera(faults=kept)
    source = open_fake(camera)
    frames = [source.read(1.0) for _ in range(100)]
    assert [(k, f.dropped_before) for k, f in enumerate(frames) if f.dropped_before] == [
        (21, 13),  # 13 at once, and the sequence goes on by one; known when the old pace is back
        (27, 1),  # one that the driver counted: it does not count twice
        (37, 1),
        (57, 2),  # two with one frame in between
        (73, 1),  # the driver's count, at once
        (74, 1),  # next to it
    ]
    stats = source.stats()
    assert (stats.lost, stats.extra["lost_in_camera"]) == (19, 17)
    assert stats.rate_hz == pytest.approx(30.0, rel=1e-3)
    assert stats.jitter_us < 4000.0  # the losses are no jitter, but for the frame between two of them


def test_a_slow_reader_loses_frames_and_knows_how_many(open_fake, kernel) -> None:
    camera = FakeCamera()
    source = open_fake(camera, buffers=4)
    source.read(1.0)
    kernel.clock.sleep_until(kernel.clock.now_ns + 1_000_000_000)
    got = [source.read(1.0) for _ in range(8)]
    assert sum(f.dropped_before for f in got) == got[-1].sequence - 8 > 20


def test_format_refused_says_what_is_on_offer(open_fake) -> None:
    with pytest.raises(errors.DeviceRefusedError, match=r"GREY \(640x480 1280x1024\)"):
        open_fake(FakeCamera(), width=800, height=600)
    with pytest.raises(errors.DeviceRefusedError, match="no pixel format YUYV"):
        open_fake(FakeCamera(serial_number="2", port="1-2"), number=2, pixel_format="YUYV")
    with pytest.raises(errors.DeviceRefusedError, match="nothing on offer gives bgr8"):
        open_fake(FakeCamera(serial_number="3", port="1-3"), number=4, encoding="bgr8")


def test_permission_denied_names_the_group(open_fake) -> None:
    with pytest.raises(
        errors.DevicePermissionError, match=r"belongs to group \w+: sudo usermod -aG|only root may use it"
    ):
        open_fake(FakeCamera(open_errno=errno.EACCES))


def test_two_processes_on_one_camera(open_fake, kernel) -> None:
    camera = FakeCamera()
    first = open_fake(camera)
    with pytest.raises(errors.DeviceBusyError, match="another process"):
        V4l2Camera(str(kernel.dev / "video0"), kernel=kernel)
    assert first.read(1.0) is not None
    assert kernel.open_descriptors == 1


def test_missing_device_and_serial_number(kernel) -> None:
    with pytest.raises(errors.DeviceNotFoundError, match="no such device"):
        V4l2Camera(str(kernel.dev / "video9"), kernel=kernel)
    with pytest.raises(errors.DeviceNotFoundError, match="serial number"):
        V4l2Camera("SN42", kernel=kernel)


def test_silence_is_none_after_the_timeout(open_fake, kernel) -> None:
    source = open_fake(FakeCamera(faults=dict.fromkeys(range(300), "lost")))
    before = kernel.clock.now_ns
    polls = len(kernel.requests)
    assert source.read(2.0) is None
    assert kernel.clock.now_ns - before == 2_000_000_000
    assert len(kernel.requests) == polls  # no busy loop: not one request was made in vain


@pytest.mark.parametrize("request_number", [REQBUFS, STREAMON, 5, 9])
def test_every_failure_while_opening_frees_everything(open_fake, kernel, request_number: int) -> None:
    with pytest.raises(errors.DriverError):
        open_fake(FakeCamera(request_errno={request_number: errno.EINVAL}))
    assert kernel.open_descriptors == 0 and not kernel.mappings


def test_granted_buffers_are_taken_as_they_are(open_fake) -> None:
    source = open_fake(FakeCamera(max_buffers=2), buffers=8)  # v4l2loopback grants two
    assert source.info.details["buffers"] == "2"
    assert [source.read(1.0).sequence for _ in range(5)] == [0, 1, 2, 3, 4]


def test_controls_out_of_range_inactive_or_unknown_say_so(open_fake) -> None:
    source = open_fake(FakeCamera())
    with pytest.raises(errors.DeviceRefusedError, match="out of range: 0 to 255"):
        source.controls.set("gain", 300)
    with pytest.raises(errors.DeviceRefusedError, match="automatic control"):
        source.controls.set("gain", 100)
    with pytest.raises(errors.DeviceRefusedError, match=r"no control 'zoom'; it offers: .*exposure"):
        source.controls.set("zoom", 1)
    source.controls.set("gain_automatic", 0)
    assert source.controls.set("gain", 100) == source.controls.get("gain") == 100


def test_named_controls_switch_automatics_off_first(open_fake) -> None:
    camera = FakeCamera()
    open_fake(camera, controls={"gain": 77, "gain_automatic": 0}, exposure_s=0.01, rate_hz=60)
    assert camera.control(0x00980913).value == 77
    assert camera.exposure_ns == 10_000_000
    assert camera.control(0x009A0903).value == 0  # else the camera halves its rate in the dark


def test_check_camera_reports_in_words(kernel) -> None:
    camera = FakeCamera()
    path = kernel.plug(camera)
    assert check_camera(path, kernel=kernel, width=640, height=480, rate_hz=30, exposure_s=0.01) == []
    (rate,) = check_camera(path, kernel=kernel, rate_hz=50, exposure_s=0.01)
    assert "asked for rate_hz 50, got 60" in rate
    camera.control(CID_EXPOSURE_AUTO).value = 3
    (exposure,) = check_camera(path, kernel=kernel, rate_hz=30)
    assert "the exposure is automatic, so stamps are not mid-exposure (raw-eof)" in exposure
    (missing,) = check_camera(str(kernel.dev / "video7"), kernel=kernel)
    assert "no such device" in missing


def test_hundred_fault_cycles_leak_nothing(open_fake, kernel) -> None:
    before = set(threading.enumerate())  # threads of earlier tests may end meanwhile
    faults = {2: "empty", 3: "flagged", 4: "lost", 6: "unplug"}
    camera = FakeCamera(formats={"GREY": {(64, 48): (30.0,)}}, faults=faults)
    source = open_fake(camera, exposure_s=0.004)
    for cycle in range(100):
        with pytest.raises(errors.DeviceLostError):
            read_on(source)
        assert kernel.open_descriptors == 0 and not kernel.mappings
        kernel.plug(camera, number=cycle % 3)
    stats = source.stats()
    assert (stats.reconnects, stats.samples) == (99, 300)
    assert not set(threading.enumerate()) - before


def test_borrowed_frames_show_kernel_memory_until_the_next_read(open_fake, kernel) -> None:
    source = open_fake(FakeCamera(), borrow=True, buffers=3)
    first = source.read(1.0)
    assert not first.image.flags.owndata
    seen = [int.from_bytes(source.read(1.0).image[0, :4].tobytes(), "little") for _ in range(10)]
    assert seen == list(range(1, 11))  # buffers go round; none is stuck
    copied = open_fake(FakeCamera(serial_number="2", port="1-2"), number=2)
    one, two = copied.read(1.0), copied.read(1.0)
    assert one.image.flags.owndata and not np.array_equal(one.image, two.image)


def test_settings_are_checked_before_a_device_is_touched() -> None:
    for wrong in ({"width": 640}, {"encoding": "rgb"}, {"stamp": "now"}, {"rate_hz": 0}, {"buffers": 1}):
        with pytest.raises(errors.DeviceRefusedError, match="camera: "):
            CameraSettings(**wrong)
