"""/dev/fw*: find a device by its GUID, and read the bus clock together with the host's.

The kernel's character device (``linux/firewire-cdev.h``); libdc1394 gives neither of the two.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path

from vical_drivers.errors import DeviceBusyError, DeviceLostError, DevicePermissionError

_GET_INFO = struct.Struct("<IIQQQI4x")
_BUS_RESET_BYTES = 40
_ROM_BYTES = 1024
_CYCLE_TIMER2 = struct.Struct("<qiiI4x")  # tv_sec, tv_nsec, clk_id, cycle_timer


def _request(direction: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | ord("#") << 8 | number


IOC_GET_INFO = _request(3, 0x00, _GET_INFO.size)
IOC_GET_CYCLE_TIMER2 = _request(3, 0x14, _CYCLE_TIMER2.size)


def nodes(dev: Path = Path("/dev")) -> list[str]:
    """Return the paths of all FireWire nodes."""
    found = [p for p in dev.iterdir() if p.name.startswith("fw") and p.name[2:].isdigit()]
    return [str(p) for p in sorted(found, key=lambda p: int(p.name[2:]))]


def read_guid(fd: int) -> int:
    """Return the GUID in the configuration ROM of an open node; raises OSError."""
    rom = ctypes.create_string_buffer(_ROM_BYTES)
    reset = ctypes.create_string_buffer(_BUS_RESET_BYTES)
    info = bytearray(_GET_INFO.pack(4, _ROM_BYTES, ctypes.addressof(rom), ctypes.addressof(reset), 0, 0))
    fcntl.ioctl(fd, IOC_GET_INFO, info, True)
    high, low = struct.unpack_from("=II", rom.raw, 12)  # the kernel gives it in the host's byte order
    return int(high) << 32 | int(low)


@contextlib.contextmanager
def _opened(path: str) -> Iterator[int]:
    fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        yield fd
    finally:
        os.close(fd)


def find_node(guid: int | None, dev: Path = Path("/dev"), sysfs: Path = Path("/sys")) -> str | None:
    """Return the node of a device; None while it is not on the bus.

    Sysfs shows to everybody what is on the bus. So a closed node is no obstacle when it is another device's,
    e.g. that of the computer's own adapter, which stays root's.

    Args:
        guid: Of the device; None: any camera will do, the first that may be opened.
        dev: Where the nodes are.
        sysfs: Where sysfs is mounted.

    Raises:
        DevicePermissionError: This user may not open its node.
    """
    closed = []
    for path in nodes(dev):
        facts = sysfs / "bus/firewire/devices" / Path(path).name
        try:
            with _opened(path) as fd:
                if read_guid(fd) == guid or (guid is None and _is_camera(facts)):
                    return path
        except PermissionError:
            known = _read(facts / "guid")
            if not known or (int(known, 16) == guid if guid is not None else _is_camera(facts)):
                closed.append(path)
        except OSError:
            continue
    if closed:
        raise DevicePermissionError(
            f"{', '.join(closed)}: no permission; cameras belong to group 'video': "
            "sudo usermod -aG video $USER, then log in again"
        )
    return None


def _is_camera(facts: Path) -> bool:
    """Tell by sysfs whether a node has a camera unit: of the 1394 Trade Association, or of Point Grey."""
    return any(unit.startswith(("0x00a02d:", "0x00b09d:")) for unit in _read(facts / "units").split())


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:  # no such file, or no sysfs
        return ""


class BusClock:
    """Reads the cycle timer together with CLOCK_MONOTONIC, and holds the camera for this process.

    Args:
        path: Node of the camera.

    Raises:
        DeviceBusyError: Another process of ours holds it.
        DeviceLostError: The node is gone.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as error:
            raise DeviceLostError(f"{path}: the camera went away ({error.strerror})") from error
        try:
            # the bus lets two programs command one camera at once; a lock on the node does not
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.close()
            raise DeviceBusyError(f"{path}: another process streams from it; stop it first") from error

    def read(self) -> tuple[int, int]:
        """Return CYCLE_TIME and the CLOCK_MONOTONIC of the same instant, ns.

        Raises:
            DeviceLostError: The camera went away.
        """
        argument = bytearray(_CYCLE_TIMER2.pack(0, 0, time.CLOCK_MONOTONIC, 0))
        try:
            fcntl.ioctl(self._fd, IOC_GET_CYCLE_TIMER2, argument, True)
        except OSError as error:
            raise DeviceLostError(f"{self.path}: the camera went away ({error.strerror})") from error
        seconds, nanoseconds, _, cycle_time = _CYCLE_TIMER2.unpack(argument)
        return cycle_time, seconds * 1_000_000_000 + nanoseconds

    def close(self) -> None:
        """Let go of the node; may be called twice."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)
