"""One open V4L2 node: thin, typed functions over the requests, and errors a person understands."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vical_drivers.access import how_to_open
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.kernel import Kernel, Mapping
from vical_drivers.errors import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    DevicePermissionError,
    DeviceRefusedError,
    DriverError,
)

_GONE = frozenset({errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN})
_FAILING = frozenset({errno.EIO, errno.EPIPE})


@dataclass(frozen=True, slots=True)
class NodeIdentity:
    """What QUERYCAP says.

    Attributes:
        driver: Kernel driver, e.g. "uvcvideo".
        card: Name of the device.
        bus_info: Where it is plugged in.
        capabilities: Of this node (device_caps).
    """

    driver: str
    card: str
    bus_info: str
    capabilities: int

    @property
    def captures_video(self) -> bool:
        """The node delivers pictures in single-planar buffers by streaming."""
        wanted = abi.CAP_VIDEO_CAPTURE | abi.CAP_STREAMING
        return self.capabilities & wanted == wanted

    @property
    def captures_metadata(self) -> bool:
        """The node delivers metadata."""
        return bool(self.capabilities & abi.CAP_META_CAPTURE)


@dataclass(frozen=True, slots=True)
class ObtainedFormat:
    """What the driver settled for: four-character code, pixels, bytes per row and per image."""

    pixel_format: str
    width: int
    height: int
    stride: int
    image_bytes: int


@dataclass(frozen=True, slots=True)
class DequeuedBuffer:
    """One filled buffer as the kernel describes it; `t_ns` in the clock that `flags` names."""

    index: int
    bytes_used: int
    flags: int
    t_ns: int
    sequence: int


def translate(error: OSError, path: str, doing: str) -> DriverError:
    """Return the driver error for a failed system call: what, where, what to try."""
    code = error.errno
    if code in (errno.EACCES, errno.EPERM):
        return DevicePermissionError(f"{path}: no permission to {doing}; {how_to_open(path, 'video')}")
    if code == errno.ENOENT:
        return DeviceNotFoundError(f"{path}: no such device; `vical camera list` shows what is there")
    if code == errno.EBUSY:
        return DeviceBusyError(
            f"{path}: another process streams from it{_holders(path)}; stop that one first"
        )
    if code in _GONE:  # whatever was asked of it then
        return DeviceLostError(f"{path}: the camera went away; check its cable")
    if code in _FAILING:
        return DeviceLostError(
            f"{path}: the camera fails to {doing} ({os.strerror(code or 0)}); check its cable"
        )
    if code == errno.ENOTTY:
        return DeviceRefusedError(f"{path}: not a V4L2 device, or it cannot {doing}")
    if code == errno.ENOSPC:
        return DeviceRefusedError(f"{path}: not enough USB bandwidth to {doing}; use MJPG or another port")
    return DeviceRefusedError(f"{path}: cannot {doing}: {os.strerror(code or 0)}")


def _holders(path: str) -> str:
    """Name the processes that hold the device, as far as this user may see them."""
    target = os.path.realpath(path)
    found = []
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with contextlib.suppress(OSError):  # it ended meanwhile, or belongs to somebody else
            pid = link.parent.parent.name
            if str(link.readlink()) == target and int(pid) != os.getpid():
                name = (link.parent.parent / "comm").read_text(encoding="ascii", errors="replace").strip()
                found.append(f"{name} pid {pid}")
    return f" ({', '.join(sorted(set(found)))})" if found else ""


class VideoNode:
    """An open node. Every method raises a `DriverError` with the node's path.

    Args:
        kernel: The system-call boundary.
        path: Device node or a link to it.
        buf_type: abi.BUF_TYPE_VIDEO_CAPTURE or abi.BUF_TYPE_META_CAPTURE.
    """

    def __init__(self, kernel: Kernel, path: str, buf_type: int = abi.BUF_TYPE_VIDEO_CAPTURE) -> None:
        self.path = path
        self.mappings: list[Mapping] = []
        self.streaming = False
        self._kernel = kernel
        self._buf_type = buf_type
        try:
            self.fd = kernel.open(path)
        except OSError as error:
            raise translate(error, path, "open it") from error

    @contextlib.contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise translate(error, self.path, doing) from error

    def request(self, number: int, argument: object, doing: str) -> None:
        """Run one request; `doing` completes "cannot ..."."""
        with self._errors(doing):
            self._kernel.ioctl(self.fd, number, argument)  # type: ignore[arg-type]

    def identity(self) -> NodeIdentity:
        """Ask who the device is."""
        cap = abi.Capability()
        self.request(abi.VIDIOC_QUERYCAP, cap, "answer who it is")
        whole: int = cap.capabilities
        own: int = cap.device_caps if whole & abi.CAP_DEVICE_CAPS else whole
        driver, card, bus = (f.decode("utf-8", "replace") for f in (cap.driver, cap.card, cap.bus_info))
        return NodeIdentity(driver, card, bus, own)

    def pixel_formats(self) -> list[str]:
        """Return the four-character codes on offer."""
        found: list[str] = []
        while True:
            desc = abi.FmtDesc(index=len(found), type=self._buf_type)
            if not self._enumerate(abi.VIDIOC_ENUM_FMT, desc):
                return found
            found.append(abi.fourcc_name(desc.pixelformat))

    def sizes(self, pixel_format: str) -> list[tuple[int, int]]:
        """Return the sizes on offer; a stepwise range gives its smallest and its largest."""
        found: list[tuple[int, int]] = []
        while True:
            size = abi.FrmSizeEnum(index=len(found), pixel_format=abi.fourcc(pixel_format))
            if not self._enumerate(abi.VIDIOC_ENUM_FRAMESIZES, size):
                return found
            if size.type != abi.FRMSIZE_TYPE_DISCRETE:
                s = size.size.stepwise
                return [(s[0], s[3]), (s[1], s[4])]
            found.append((size.size.discrete[0], size.size.discrete[1]))

    def size_offered(self, pixel_format: str, width: int, height: int) -> bool:
        """Tell whether a size is on offer; True where the driver does not enumerate sizes."""
        size = abi.FrmSizeEnum(index=0, pixel_format=abi.fourcc(pixel_format))
        if not self._enumerate(abi.VIDIOC_ENUM_FRAMESIZES, size):
            return True
        if size.type == abi.FRMSIZE_TYPE_DISCRETE:
            return (width, height) in self.sizes(pixel_format)
        lo_w, hi_w, step_w, lo_h, hi_h, step_h = size.size.stepwise
        fits_w = lo_w <= width <= hi_w and (width - lo_w) % max(step_w, 1) == 0
        return bool(fits_w and lo_h <= height <= hi_h and (height - lo_h) % max(step_h, 1) == 0)

    def rates_hz(self, pixel_format: str, width: int, height: int) -> list[float]:
        """Return the frame rates on offer; a range gives its slowest and its fastest."""
        found: list[float] = []
        while True:
            code = abi.fourcc(pixel_format)
            ival = abi.FrmIvalEnum(index=len(found), pixel_format=code, width=width, height=height)
            if not self._enumerate(abi.VIDIOC_ENUM_FRAMEINTERVALS, ival):
                return found
            if ival.type != abi.FRMIVAL_TYPE_DISCRETE:
                return [_rate_hz(ival.ival.stepwise[1]), _rate_hz(ival.ival.stepwise[0])]
            found.append(_rate_hz(ival.ival.discrete))

    def _enumerate(self, number: int, argument: object) -> bool:
        try:
            self._kernel.ioctl(self.fd, number, argument)  # type: ignore[arg-type]
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return False
            raise translate(error, self.path, "list what it offers") from error
        return True

    def current_format(self) -> ObtainedFormat:
        """Return the format that is set."""
        fmt = abi.Format(type=self._buf_type)
        self.request(abi.VIDIOC_G_FMT, fmt, "report its format")
        return _obtained(fmt)

    def set_format(self, pixel_format: str, width: int, height: int) -> ObtainedFormat:
        """Ask for a format and return what the driver made of it, which may differ."""
        fmt = abi.Format(type=self._buf_type)
        fmt.fmt.pix.width, fmt.fmt.pix.height = width, height
        fmt.fmt.pix.pixelformat = abi.fourcc(pixel_format)
        fmt.fmt.pix.field = abi.FIELD_NONE
        self.request(abi.VIDIOC_S_FMT, fmt, f"deliver {pixel_format} {width}x{height}")
        return _obtained(fmt)

    def set_metadata_format(self, data_format: str) -> str:
        """Ask for a metadata format and return the one obtained."""
        fmt = abi.Format(type=self._buf_type)
        fmt.fmt.meta.dataformat = abi.fourcc(data_format)
        self.request(abi.VIDIOC_S_FMT, fmt, f"deliver {data_format} metadata")
        return abi.fourcc_name(fmt.fmt.meta.dataformat)

    def set_rate(self, rate_hz: float | None) -> float:
        """Ask for a frame rate (None: leave it) and return the obtained one, Hz; 0.0 where unknown."""
        parm = abi.StreamParm(type=self._buf_type)
        if not self._enumerate(abi.VIDIOC_G_PARM, parm):
            return 0.0
        if rate_hz is not None and parm.parm.capture.capability & abi.CAP_TIMEPERFRAME:
            parm.parm.capture.timeperframe = abi.Fract(1_000_000, round(rate_hz * 1_000_000))
            if not self._enumerate(abi.VIDIOC_S_PARM, parm):  # it says that it can, and cannot: as it runs
                self._enumerate(abi.VIDIOC_G_PARM, parm)
        return _rate_hz(parm.parm.capture.timeperframe)

    def start(self, buffers: int) -> int:
        """Get buffers, map and queue them, start the stream; returns the count that was granted."""
        wanted = abi.RequestBuffers(count=buffers, type=self._buf_type, memory=abi.MEMORY_MMAP)
        self.request(abi.VIDIOC_REQBUFS, wanted, "hand out buffers")
        for index in range(wanted.count):
            buffer = abi.Buffer(index=index, type=self._buf_type, memory=abi.MEMORY_MMAP)
            self.request(abi.VIDIOC_QUERYBUF, buffer, "describe a buffer")
            with self._errors("map a buffer"):
                self.mappings.append(self._kernel.mmap(self.fd, buffer.length, buffer.m.offset))
            self.queue(index)
        self.request(abi.VIDIOC_STREAMON, abi.BufferType(self._buf_type), "start to stream")
        self.streaming = True
        return len(self.mappings)

    def queue(self, index: int) -> None:
        """Give a buffer back to the kernel."""
        buffer = abi.Buffer(index=index, type=self._buf_type, memory=abi.MEMORY_MMAP)
        self.request(abi.VIDIOC_QBUF, buffer, "take a buffer back")

    def dequeue(self) -> DequeuedBuffer | None:
        """Take a filled buffer; None where none is ready."""
        buffer = abi.Buffer(type=self._buf_type, memory=abi.MEMORY_MMAP)
        try:
            self._kernel.ioctl(self.fd, abi.VIDIOC_DQBUF, buffer)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return None
            raise translate(error, self.path, "read a frame") from error
        t_ns = buffer.tv_sec * 1_000_000_000 + buffer.tv_usec * 1_000
        return DequeuedBuffer(buffer.index, buffer.bytesused, buffer.flags, t_ns, buffer.sequence)

    def close(self) -> None:
        """Stop the stream, unmap, free the buffers, close; may be called twice, never raises."""
        if self.fd < 0:
            return
        if self.streaming:
            self.streaming = False
            with contextlib.suppress(OSError):  # unplugged: the kernel has stopped it
                self._kernel.ioctl(self.fd, abi.VIDIOC_STREAMOFF, abi.BufferType(self._buf_type))
        for mapping in self.mappings:
            mapping.close()
        if self.mappings:
            self.mappings = []
            none = abi.RequestBuffers(count=0, type=self._buf_type, memory=abi.MEMORY_MMAP)
            with contextlib.suppress(OSError):  # unplugged: they went with it
                self._kernel.ioctl(self.fd, abi.VIDIOC_REQBUFS, none)
        fd, self.fd = self.fd, -1
        with contextlib.suppress(OSError):  # free in any case; what close says of an unplugged device is moot
            self._kernel.close(fd)


def _rate_hz(interval: abi.Fract) -> float:
    return interval.denominator / interval.numerator if interval.numerator else 0.0


def _obtained(fmt: abi.Format) -> ObtainedFormat:
    pix = fmt.fmt.pix
    name = abi.fourcc_name(pix.pixelformat)
    return ObtainedFormat(name, pix.width, pix.height, pix.bytesperline, pix.sizeimage)
