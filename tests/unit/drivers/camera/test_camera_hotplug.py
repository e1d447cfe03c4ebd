"""The udev socket: messages parsed byte for byte, the wait ends, the listing follows the plugs."""

from __future__ import annotations

import struct
import time

import pytest
from vical_drivers.camera import list_cameras
from vical_drivers.camera.hotplug import HotplugMonitor, parse_event, wait_for_camera
from vical_mocks.v4l2_camera import FakeCamera, UvcClockModel

PROPERTIES = b"ACTION=add\0SUBSYSTEM=video4linux\0DEVNAME=/dev/video3\0ID_SERIAL=Acme_Cam_7\0"


def udev_message(properties: bytes) -> bytes:
    header = (
        b"libudev\0"
        + struct.pack(">I", 0xFEEDCAFE)
        + struct.pack("=IIIIIII", 40, 40, len(properties), 0, 0, 0, 0)
    )
    return header + properties


def test_message_of_udev() -> None:
    event = parse_event(udev_message(PROPERTIES))
    assert event is not None
    assert (event.action, event.subsystem, event.path) == ("add", "video4linux", "/dev/video3")
    assert event.properties["ID_SERIAL"] == "Acme_Cam_7"


def test_message_of_the_kernel() -> None:
    body = b"remove@/devices/x/video3\0ACTION=remove\0SUBSYSTEM=video4linux\0DEVNAME=video3\0SEQNUM=7"
    event = parse_event(body)
    assert event is not None
    assert (event.action, event.path) == ("remove", "/dev/video3")


@pytest.mark.parametrize(
    "message", [b"", b"libudev\0", b"libudev\0" + bytes(40), b"nonsense", b"a@b\0SUBSYSTEM=usb\0"]
)
def test_other_messages_are_ignored(message: bytes) -> None:
    assert parse_event(message) is None


def test_wait_ends_after_its_time() -> None:
    started = time.monotonic()
    wait_for_camera(0.05)
    assert 0.04 < time.monotonic() - started < 2.0


def test_monitor_times_out_and_closes_twice() -> None:
    try:
        monitor = HotplugMonitor()
    except OSError as error:
        pytest.skip(f"no netlink socket here: {error}")
    with monitor:
        assert monitor.wait(0.01) is None
    monitor.close()


def test_listing_names_each_camera_by_its_stable_path(kernel) -> None:
    kernel.plug(FakeCamera(driver="uvcvideo", uvc=UvcClockModel()), number=0)  # with a metadata node
    kernel.plug(FakeCamera(serial_number="SN2", port="1-2", open_errno=13), number=2)
    one, two = list_cameras(kernel=kernel, schemes=("v4l2",))
    assert one.details["uri"].endswith("by-id/usb-SN0001-video-index0")
    assert one.serial_number == "SN0001"
    assert one.details["formats"] == "GREY up to 1280x1024"
    assert "no permission" in two.details["problem"]
    assert kernel.open_descriptors == 0
