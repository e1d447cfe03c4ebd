"""V4L2 requests, decoded and answered for the fake kernel.

They are decoded with `struct` from the kernel's documentation, not with the driver's own structures, so
that a wrong layout on either side shows.
"""

from __future__ import annotations

import ctypes
import errno
import struct
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from vical_mocks.v4l2_camera import INACTIVE, Bytes, FakeCamera, FakeControl, FrameTruth

VIDEO, META = 1, 13
_T = TypeVar("_T")
_NEXT_CONTROL = 0x80000000


class VirtualClock:
    """Time that passes only when somebody waits."""

    def __init__(self, start_ns: int = 5_000_000_000_000) -> None:
        self.now_ns = start_ns

    def sleep_until(self, t_ns: int) -> None:
        """Jump."""
        self.now_ns = max(self.now_ns, t_ns)


class RealClock:
    """CLOCK_MONOTONIC, for benchmarks and demonstrations."""

    @property
    def now_ns(self) -> int:
        """Now."""
        return time.monotonic_ns()

    def sleep_until(self, t_ns: int) -> None:
        """Sleep."""
        time.sleep(max(0, t_ns - time.monotonic_ns()) * 1e-9)


@dataclass
class KernelBuffer:
    """One buffer of a queue, and the frame in it."""

    memory: Bytes
    queued: bool = False
    used: int = 0
    flags: int = 0
    t_ns: int = 0
    sequence: int = 0


@dataclass
class Queue:
    """Buffers of one node and the descriptor that owns them."""

    owner: int
    buffers: list[KernelBuffer] = field(default_factory=list)
    done: deque[int] = field(default_factory=deque)
    streaming: bool = False


@dataclass
class PluggedCamera:
    """A camera in its port."""

    camera: FakeCamera
    number: int
    gone: bool = False
    t_on_ns: int = 0
    next_frame: int = 0
    kept: int = 0  # frames that never left the camera
    pending: FrameTruth | None = None
    queues: dict[int, Queue] = field(default_factory=dict)  # by buffer type
    events: deque[int] = field(default_factory=deque)


@dataclass
class OpenNode:
    """One descriptor: the camera behind it, which of its nodes, and the controls it watches."""

    plugged: PluggedCamera
    kind: int
    subscribed: set[int] = field(default_factory=set)


class Requests(ABC):
    """What a kernel answers; `FakeKernel` adds the descriptors and the time.

    Args:
        clock: Time of this kernel.
    """

    def __init__(self, clock: VirtualClock | RealClock) -> None:
        self.clock = clock
        self._plugged: dict[str, PluggedCamera] = {}  # by path of the node
        self._handlers: dict[int, Callable[[OpenNode, bytearray], None]] = {
            0: self._querycap, 2: self._enum_fmt, 4: self._g_fmt, 5: self._s_fmt, 9: self._querybuf,
            15: self._qbuf, 17: self._dqbuf, 18: self._streamon, 19: self._streamoff, 21: self._g_parm,
            22: self._s_parm, 37: self._querymenu, 71: self._g_ctrl, 72: self._s_ctrl, 74: self._sizes,
            75: self._rates, 89: self._dqevent, 90: self._subscribe, 103: self._query_ctrl,
        }  # fmt: skip

    @abstractmethod
    def _run(self, plugged: PluggedCamera) -> None:
        """Let the camera do what it did until now."""

    def _note_control(self, camera: FakeCamera) -> None:
        camera.note_control(self.clock.now_ns)
        for plugged in self._plugged.values():
            foreseen = plugged.pending
            if plugged.camera is camera and foreseen and foreseen.t_start_ns > self.clock.now_ns:
                plugged.pending = None  # it has not begun to expose: it will have the new exposure

    # -- offsets from linux/videodev2.h on 64 bit ------------------------------------------

    def _querycap(self, held: OpenNode, data: bytearray) -> None:
        camera = held.plugged.camera
        own = 0x04000001 if held.kind == VIDEO else 0x04800000
        texts = (camera.driver.encode(), camera.name.encode(), f"usb-fake-{camera.port}".encode())
        struct.pack_into("<16s32s32sIII", data, 0, *texts, 0x060100, 0x84A00001, own)

    def _enum_fmt(self, held: OpenNode, data: bytearray) -> None:
        (index,) = struct.unpack_from("<I", data, 0)
        name = _pick(list(held.plugged.camera.formats), index)
        struct.pack_into("<32s4s", data, 12, name.encode(), name.ljust(4).encode())

    def _g_fmt(self, held: OpenNode, data: bytearray) -> None:
        camera = held.plugged.camera
        if held.kind == META:
            struct.pack_into("<4sI", data, 8, b"UVCH", 10240)
            return
        code = camera.pixel_format.ljust(4).encode()
        stride = 0 if camera.pixel_format == "MJPG" else camera.stride
        struct.pack_into(
            "<II4sIII", data, 8, camera.width, camera.height, code, 1, stride, camera.image_bytes
        )

    def _s_fmt(self, held: OpenNode, data: bytearray) -> None:
        camera = held.plugged.camera
        if held.kind == VIDEO:
            width, height, code = struct.unpack_from("<II4s", data, 8)
            name = code.decode().rstrip()
            camera.pixel_format = name if name in camera.formats else next(iter(camera.formats))
            sizes = camera.formats[camera.pixel_format]
            nearest = min(sizes, key=lambda s: abs(s[0] - width) + abs(s[1] - height))
            camera.width, camera.height = nearest
        self._g_fmt(held, data)

    def _sizes(self, held: OpenNode, data: bytearray) -> None:
        index, code = struct.unpack_from("<I4s", data, 0)
        sizes = held.plugged.camera.formats.get(code.decode().rstrip(), {})
        struct.pack_into("<III", data, 8, 1, *_pick(list(sizes), index))

    def _rates(self, held: OpenNode, data: bytearray) -> None:
        index, code, width, height = struct.unpack_from("<I4sII", data, 0)
        sizes = held.plugged.camera.formats.get(code.decode().rstrip(), {})
        rate = _pick(list(sizes.get((width, height), ())), index)
        struct.pack_into("<III", data, 16, 1, 1000, round(rate * 1000))

    def _g_parm(self, held: OpenNode, data: bytearray) -> None:
        struct.pack_into("<IIII", data, 4, 0x1000, 0, 1000, round(held.plugged.camera.rate_hz * 1000))

    def _s_parm(self, held: OpenNode, data: bytearray) -> None:
        camera = held.plugged.camera
        numerator, denominator = struct.unpack_from("<II", data, 12)
        rates = camera.formats[camera.pixel_format][camera.width, camera.height]
        camera.rate_hz = min(rates, key=lambda r: abs(r - denominator / numerator))
        self._g_parm(held, data)

    def _reqbufs(self, fd: int, held: OpenNode, data: bytearray) -> None:
        (count,) = struct.unpack_from("<I", data, 0)
        queue = held.plugged.queues.get(held.kind)
        if queue is not None and queue.owner != fd:
            raise OSError(errno.EBUSY, "another descriptor streams")
        if count == 0:
            held.plugged.queues.pop(held.kind, None)
            return
        granted = min(count, held.plugged.camera.max_buffers)
        size = held.plugged.camera.image_bytes if held.kind == VIDEO else 10240
        buffers = [KernelBuffer(np.zeros(size, np.uint8)) for _ in range(granted)]
        held.plugged.queues[held.kind] = Queue(fd, buffers)
        struct.pack_into("<I", data, 0, granted)

    def _querybuf(self, held: OpenNode, data: bytearray) -> None:
        (index,) = struct.unpack_from("<I", data, 0)
        buffer = _pick(held.plugged.queues[held.kind].buffers, index)
        struct.pack_into("<Q", data, 64, index << 12)
        struct.pack_into("<I", data, 72, buffer.memory.size)

    def _qbuf(self, held: OpenNode, data: bytearray) -> None:
        self._run(held.plugged)
        (index,) = struct.unpack_from("<I", data, 0)
        buffer = _pick(held.plugged.queues[held.kind].buffers, index)
        if buffer.queued:
            raise OSError(errno.EINVAL, "already queued")
        buffer.queued = True

    def _dqbuf(self, held: OpenNode, data: bytearray) -> None:
        self._run(held.plugged)
        if held.plugged.gone:
            raise OSError(errno.ENODEV, "gone")
        queue = held.plugged.queues[held.kind]
        if not queue.done:
            raise OSError(errno.EAGAIN, "nothing ready")
        index = queue.done.popleft()
        b = queue.buffers[index]
        struct.pack_into("<IIII", data, 0, index, held.kind, b.used, b.flags)
        struct.pack_into("<qq", data, 24, b.t_ns // 1_000_000_000, b.t_ns % 1_000_000_000 // 1000)
        struct.pack_into("<I", data, 56, b.sequence & 0xFFFFFFFF)

    def _streamon(self, held: OpenNode, _data: bytearray) -> None:
        held.plugged.queues[held.kind].streaming = True
        if held.kind == VIDEO:
            held.plugged.t_on_ns = self.clock.now_ns + 1_000_000
            held.plugged.next_frame, held.plugged.kept, held.plugged.pending = 0, 0, None
            held.plugged.camera.truth.clear()

    def _streamoff(self, held: OpenNode, _data: bytearray) -> None:
        held.plugged.queues[held.kind].streaming = False

    def _query_ctrl(self, held: OpenNode, data: bytearray) -> None:
        (wanted,) = struct.unpack_from("<I", data, 0)
        camera = held.plugged.camera
        number = wanted & 0x0FFFFFFF
        ordered = sorted(camera.controls, key=lambda c: c.control_id)
        if wanted & _NEXT_CONTROL:
            c = _pick([c for c in ordered if c.control_id > number], 0)
        else:
            c = _pick([c for c in ordered if c.control_id == number], 0)
        if c.broken:
            raise OSError(c.broken, "the camera does not know it")
        flags = 0 if _active(camera, c) else INACTIVE
        struct.pack_into("<II32s", data, 0, c.control_id, c.kind, c.name.encode())
        struct.pack_into("<qqQqI", data, 40, c.minimum, c.maximum, c.step, c.value, flags)

    def _querymenu(self, held: OpenNode, data: bytearray) -> None:
        control_id, index = struct.unpack_from("<II", data, 0)
        control = held.plugged.camera.control(control_id)
        if control is None or index not in control.menu:
            raise OSError(errno.EINVAL, "no such entry")
        struct.pack_into("<32s", data, 8, control.menu[index].encode())

    def _g_ctrl(self, held: OpenNode, data: bytearray) -> None:
        control, address = self._batch(held, data)
        ctypes.memmove(address + 12, struct.pack("<i", control.value), 4)

    def _s_ctrl(self, held: OpenNode, data: bytearray) -> None:
        control, address = self._batch(held, data)
        camera = held.plugged.camera
        if not _active(camera, control):
            raise OSError(errno.EACCES, "inactive")
        (value,) = struct.unpack("<i", ctypes.string_at(address + 12, 4))
        self._run(held.plugged)
        control.value = min(max(value, control.minimum), control.maximum)
        self._note_control(camera)

    @staticmethod
    def _batch(held: OpenNode, data: bytearray) -> tuple[FakeControl, int]:
        _which, count = struct.unpack_from("<II", data, 0)
        (address,) = struct.unpack_from("<Q", data, 24)
        (control_id,) = struct.unpack("<I", ctypes.string_at(address, 4))
        control = held.plugged.camera.control(control_id)
        if count != 1 or control is None:
            raise OSError(errno.EINVAL, "no such control")
        if control.broken or control.stalled:
            raise OSError(control.broken or control.stalled, "the camera does not know it")
        return control, int(address)

    def _subscribe(self, held: OpenNode, data: bytearray) -> None:
        kind, control_id = struct.unpack_from("<II", data, 0)
        if kind != 3:
            raise OSError(errno.EINVAL, "only control events")
        held.subscribed.add(control_id)

    def _dqevent(self, held: OpenNode, data: bytearray) -> None:
        if not held.plugged.events:
            raise OSError(errno.ENOENT, "no event")
        struct.pack_into("<I", data, 0, 3)
        struct.pack_into("<I", data, 96, held.plugged.events.popleft())


def _pick(items: list[_T], index: int) -> _T:
    if index >= len(items):
        raise OSError(errno.EINVAL, "index out of range")
    return items[index]


def _active(camera: FakeCamera, control: FakeControl) -> bool:
    if control.off_unless is None:
        return True
    master = camera.control(control.off_unless[0])
    return master is None or master.value == control.off_unless[1]
