"""Hotplug events from udev's netlink socket: no polling of folders, no library.

Group 2 of NETLINK_KOBJECT_UEVENT carries udev's own messages: they come after the rules have run, so
permissions and links are in place.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import time
from dataclasses import dataclass

from vical_drivers.closing import Closing

_NETLINK_KOBJECT_UEVENT = 15
_UDEV_GROUP = 2
_UDEV_PREFIX = b"libudev\0"
_UDEV_MAGIC = 0xFEEDCAFE
_SETTLE_S = 0.05


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """One event of udev.

    Attributes:
        action: add, remove, change, bind ...
        subsystem: e.g. video4linux, firewire, usb.
        path: Device node; "" where the device has none.
        properties: Everything udev knows.
    """

    action: str
    subsystem: str
    path: str
    properties: dict[str, str]


def parse_event(message: bytes) -> DeviceEvent | None:
    """Parse a netlink message of udev (or of the kernel itself); None where it is neither."""
    if message.startswith(_UDEV_PREFIX):
        if len(message) < 24 or struct.unpack_from(">I", message, 8)[0] != _UDEV_MAGIC:
            return None
        offset, length = struct.unpack_from("=II", message, 16)
        body = message[offset : offset + length]
    else:
        head, _, body = message.partition(b"\0")
        if b"@" not in head:
            return None
    properties = {}
    for item in body.split(b"\0"):
        key, equals, value = item.decode("utf-8", "replace").partition("=")
        if equals:
            properties[key] = value
    if "ACTION" not in properties:
        return None
    name = properties.get("DEVNAME", "")
    path = name if name.startswith("/") or not name else f"/dev/{name}"
    return DeviceEvent(properties["ACTION"], properties.get("SUBSYSTEM", ""), path, properties)


class HotplugMonitor(Closing):
    """Listens to udev.

    Raises:
        OSError: The socket is not to be had (a container without netlink).
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, _NETLINK_KOBJECT_UEVENT)
        try:
            self._socket.bind((0, _UDEV_GROUP))
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise

    def wait(self, timeout_s: float) -> DeviceEvent | None:
        """Return the next event, or None after `timeout_s`."""
        poller = select.poll()
        poller.register(self._socket.fileno(), select.POLLIN)
        deadline = time.monotonic() + timeout_s
        while True:
            left_s = deadline - time.monotonic()
            if not poller.poll(max(0.0, left_s) * 1e3):
                return None
            with contextlib.suppress(OSError):  # ENOBUFS: events were lost, the next one will do
                message, (_sender, groups) = self._socket.recvfrom(65536)
                event = parse_event(message)
                # only root may send to the group, but anybody may send to this socket alone
                if event is not None and groups:
                    return event
            if left_s <= 0:
                return None

    def close(self) -> None:
        """Free the socket; may be called twice."""
        self._socket.close()


def wait_for_camera(timeout_s: float, subsystems: tuple[str, ...] = ("video4linux", "firewire")) -> None:
    """Return when a camera was added, or after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    try:
        monitor = HotplugMonitor()
    except OSError:
        time.sleep(max(0.0, timeout_s))
        return
    with monitor:
        while (left_s := deadline - time.monotonic()) > 0:
            event = monitor.wait(left_s)
            if event is not None and event.action in ("add", "bind") and event.subsystem in subsystems:
                time.sleep(_SETTLE_S)  # the metadata node comes with the picture node
                return
