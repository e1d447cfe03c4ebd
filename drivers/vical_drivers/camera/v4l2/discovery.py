"""Which V4L2 cameras there are, who they are, and how to find one again after a replug."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from vical_drivers.camera.formats import FORMATS
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.kernel import Kernel
from vical_drivers.camera.v4l2.node import VideoNode
from vical_drivers.errors import DeviceNotFoundError, DriverError
from vical_drivers.samples import DeviceInfo


@dataclass(frozen=True, slots=True)
class NodeEntry:
    """A V4L2 node as sysfs shows it, without opening it.

    Attributes:
        path: Device node.
        name: Of the device.
        index: Number of the node within its device.
        serial_number: Of the USB device; "" where there is none.
        port: Where the device is plugged in: the name of its folder in sysfs.
        stable_path: A link under v4l/by-id (or by-path) that survives a replug; "" where there is none.
    """

    path: str
    name: str
    index: int
    serial_number: str
    port: str
    stable_path: str = ""

    def is_same_device(self, other: NodeEntry) -> bool:
        """Tell whether two entries are one camera, by serial number, else by port."""
        if (self.name, self.index) != (other.name, other.index):
            return False
        if self.serial_number or other.serial_number:
            return self.serial_number == other.serial_number
        return self.port == other.port

    @property
    def identity(self) -> str:
        """What keys a stored calibration: the serial number, else the port and what is plugged in there."""
        return self.serial_number or f"port-{self.port} {self.name}"


def list_nodes(kernel: Kernel) -> list[NodeEntry]:
    """Return all V4L2 nodes in the order of their numbers."""
    folder = kernel.sysfs / "class/video4linux"
    links = _stable_links(kernel.dev)
    nodes = sorted(folder.glob("video*"), key=_number) if folder.is_dir() else []
    return [_entry(kernel.dev / node.name, node, links) for node in nodes]


def _number(node: Path) -> int:
    return int("".join(filter(str.isdigit, node.name)) or 0)


def _entry(path: Path, node: Path, links: dict[str, str]) -> NodeEntry:
    device = (node / "device").resolve()
    return NodeEntry(
        path=str(path),
        name=_read(node / "name"),
        index=int(_read(node / "index") or 0),
        serial_number=_serial_number(device),
        port=device.name,
        stable_path=links.get(path.name, ""),
    )


def _serial_number(device: Path) -> str:
    # the serial number is a file of the USB device, one or two folders above its interface
    for folder in (device, *list(device.parents)[:2]):
        text = _read(folder / "serial")
        if text and (folder / "idVendor").exists():
            return text
    return ""


def _stable_links(dev: Path) -> dict[str, str]:
    links: dict[str, str] = {}
    for kind in ("by-path", "by-id"):  # by-id comes last and wins
        for link in sorted((dev / "v4l" / kind).glob("*")):
            links[link.resolve().name] = str(link)
    return links


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def find_node(kernel: Kernel, name: str) -> NodeEntry:
    """Return the entry of a camera named by a path, a link, a number or a serial number.

    Raises:
        DeviceNotFoundError: Nothing of that name.
    """
    nodes = list_nodes(kernel)
    if name.isdigit() and len(name) <= 3:
        name = str(kernel.dev / f"video{name}")
    if not name.startswith("/"):
        for entry in nodes:
            if entry.serial_number == name:
                return entry
        known = ", ".join(e.stable_path or e.path for e in nodes) or "none"
        raise DeviceNotFoundError(f"v4l2:{name}: no camera with that serial number; there are: {known}")
    real = Path(os.path.realpath(name))  # `resolve` raises RuntimeError for a link to itself
    for entry in nodes:
        if Path(os.path.realpath(entry.path)) == real:
            return entry
    # a node without sysfs entry (a container): use it as it is
    return NodeEntry(path=name, name="", index=0, serial_number="", port=real.name)


def twin_ports(kernel: Kernel, camera: NodeEntry) -> frozenset[str]:
    """Return the ports of other cameras that have the same name and serial number."""
    alike = (entry.port for entry in list_nodes(kernel) if entry.is_same_device(camera))
    return frozenset(port for port in alike if port != camera.port)


def find_again(kernel: Kernel, lost: NodeEntry, twins: frozenset[str] = frozenset()) -> NodeEntry | None:
    """Return where a camera is now, which may be another number or port; None while it is away.

    Args:
        kernel: The system.
        lost: The camera as it was.
        twins: Ports of cameras that cannot be told from it, see `twin_ports`.
    """
    if not lost.name:
        return lost
    alike = [e for e in list_nodes(kernel) if e.is_same_device(lost) and e.port not in twins]
    return min(alike, key=lambda entry: entry.port != lost.port, default=None)


def metadata_node(kernel: Kernel, camera: NodeEntry) -> NodeEntry | None:
    """Return the metadata node of a UVC camera; None where it has none or it cannot be asked."""
    # a device with several cameras has several: the driver makes each right after its picture node
    for entry in list_nodes(kernel):
        if entry.port != camera.port or entry.index <= camera.index:
            continue
        try:
            node = VideoNode(kernel, entry.path, abi.BUF_TYPE_META_CAPTURE)
        except DriverError:
            continue
        try:
            if node.identity().captures_metadata:
                return entry
        except DriverError:
            continue
        finally:
            node.close()
    return None


def list_v4l2_cameras(kernel: Kernel) -> list[DeviceInfo]:
    """Return every node that delivers pictures; one that cannot be opened is listed with the reason."""
    found = []
    for entry in list_nodes(kernel):
        details = {"uri": f"v4l2:{entry.stable_path or entry.path}"}
        model = entry.name
        try:
            node = VideoNode(kernel, entry.path)
            try:
                identity = node.identity()
                if not identity.captures_video:
                    continue
                model = identity.card
                details |= {"driver": identity.driver, "bus": identity.bus_info}
                details["formats"] = ", ".join(_offers(node))
            finally:
                node.close()
        except DriverError as error:
            details["problem"] = str(error)
        found.append(
            DeviceInfo(
                kind="camera",
                model=model,
                serial_number=entry.identity,
                path=entry.path,
                protocol="v4l2",
                details=details,
            )
        )
    return found


def _offers(node: VideoNode) -> list[str]:
    offers = []
    for name in (n for n in FORMATS if n in node.pixel_formats()):
        sizes = node.sizes(name)
        largest = max(sizes, key=lambda s: s[0] * s[1], default=None)
        offers.append(f"{name} up to {largest[0]}x{largest[1]}" if largest else name)
    return offers
