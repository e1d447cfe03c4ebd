"""A kernel with V4L2 cameras in it, behind open, ioctl, mmap and poll: everything above runs for real.

Requests are decoded here with `struct` from the kernel's documentation, not with the driver's own
structures, so that a wrong layout on either side shows. Time is virtual by default: `poll` jumps to the
next event, and a test of minutes takes milliseconds.
"""

from __future__ import annotations

import ctypes
import errno
import shutil
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from vical_mocks.v4l2_camera import INACTIVE, Bytes, FakeCamera, FakeControl, FrameTruth

POLLIN, POLLPRI, POLLERR, POLLHUP = 1, 2, 8, 16
_VIDEO, _META = 1, 13
_FIRST_FD = 1000
_T = TypeVar("_T")


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
class FakeMapping:
    """Memory of one buffer."""

    kernel: FakeKernel
    array: Bytes

    def close(self) -> None:
        """Unmap; may be called twice."""
        self.kernel.mappings.discard(id(self))


@dataclass
class _Buffer:
    memory: Bytes
    queued: bool = False
    used: int = 0
    flags: int = 0
    t_ns: int = 0
    sequence: int = 0


@dataclass
class _Queue:
    """Buffers of one node and the descriptor that owns them."""

    owner: int
    buffers: list[_Buffer] = field(default_factory=list)
    done: deque[int] = field(default_factory=deque)
    streaming: bool = False


@dataclass
class _Plugged:
    """A camera in its port."""

    camera: FakeCamera
    number: int
    gone: bool = False
    t_on_ns: int = 0
    next_frame: int = 0
    pending: FrameTruth | None = None
    queues: dict[int, _Queue] = field(default_factory=dict)  # by buffer type
    events: deque[int] = field(default_factory=deque)


@dataclass
class _Open:
    plugged: _Plugged
    kind: int
    subscribed: set[int] = field(default_factory=set)


class FakeKernel:
    """See the module; `root` receives a small sysfs and /dev.

    Args:
        root: Empty folder.
        clock: `VirtualClock` or `RealClock`.
    """

    def __init__(self, root: Path, clock: VirtualClock | RealClock | None = None) -> None:
        self.sysfs, self.dev = root / "sys", root / "dev"
        self.clock = clock or VirtualClock()
        self.mappings: set[int] = set()
        self.requests: list[int] = []
        self._open: dict[int, _Open] = {}
        self._plugged: dict[str, _Plugged] = {}  # by path of the node
        self._next_fd = _FIRST_FD
        (self.dev / "v4l/by-id").mkdir(parents=True)
        (self.sysfs / "class/video4linux").mkdir(parents=True)
        self._handlers: dict[int, Callable[[_Open, bytearray], None]] = {
            0: self._querycap, 2: self._enum_fmt, 4: self._g_fmt, 5: self._s_fmt, 9: self._querybuf,
            15: self._qbuf, 17: self._dqbuf, 18: self._streamon, 19: self._streamoff, 21: self._g_parm,
            22: self._s_parm, 37: self._querymenu, 71: self._g_ctrl, 72: self._s_ctrl, 74: self._sizes,
            75: self._rates, 89: self._dqevent, 90: self._subscribe, 103: self._query_ctrl,
        }  # fmt: skip

    # -- the world: plug, unplug, look for leaks -----------------------------------------------------

    @property
    def open_descriptors(self) -> int:
        """Descriptors that are open now."""
        return len(self._open)

    def plug(self, camera: FakeCamera, number: int = 0) -> str:
        """Put a camera into its port; returns the node's path. Its metadata node is the next number."""
        plugged = _Plugged(camera, number)
        usb = self.sysfs / "devices" / camera.port
        for index in range(2 if camera.uvc else 1):
            name = f"video{number + index}"
            folder = usb / f"{camera.port}:1.0/video4linux" / name
            folder.mkdir(parents=True)
            (folder / "name").write_text(camera.name + "\n")
            (folder / "index").write_text(f"{index}\n")
            (folder / "device").symlink_to(folder.parent.parent)
            (self.sysfs / "class/video4linux" / name).symlink_to(folder)
            (self.dev / name).touch()
            self._plugged[str(self.dev / name)] = plugged
            link = f"usb-{camera.serial_number}-video-index{index}"
            (self.dev / "v4l/by-id" / link).symlink_to(self.dev / name)
        (usb / "idVendor").write_text("1d6b\n")
        (usb / "serial").write_text(camera.serial_number + "\n")
        (usb / "descriptors").write_bytes(camera.usb_descriptors())
        return str(self.dev / f"video{number}")

    def unplug(self, camera: FakeCamera) -> None:
        """Pull a camera out: open descriptors stay, but say ENODEV."""
        for path, plugged in list(self._plugged.items()):
            if plugged.camera is camera:
                plugged.gone = True
                del self._plugged[path]
                Path(path).unlink()
                (self.sysfs / "class/video4linux" / Path(path).name).unlink()
        for link in (self.dev / "v4l/by-id").glob(f"usb-{camera.serial_number}-*"):
            link.unlink()
        shutil.rmtree(self.sysfs / "devices" / camera.port)

    def set_by_other_process(self, camera: FakeCamera, control_id: int, value: int) -> None:
        """Change a control as another program would; subscribers get an event."""
        control = camera.control(control_id)
        assert control is not None
        control.value = value
        self._note_control(camera)
        for held in self._open.values():
            if held.plugged.camera is camera and control_id in held.subscribed:
                held.plugged.events.append(control_id)

    def _note_control(self, camera: FakeCamera) -> None:
        camera.note_control(self.clock.now_ns)
        for plugged in self._plugged.values():
            foreseen = plugged.pending
            if plugged.camera is camera and foreseen and foreseen.t_start_ns > self.clock.now_ns:
                plugged.pending = None  # it has not begun to expose: it will have the new exposure

    # -- the boundary --------------------------------------------------------------------------------

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC."""
        return self.clock.now_ns

    def realtime_ns(self) -> int:
        """CLOCK_REALTIME: another epoch."""
        return self.clock.now_ns + 1_700_000_000_000_000_000

    def open(self, path: str) -> int:
        """Open a node."""
        real = str(Path(path).resolve())
        plugged = self._plugged.get(real)
        if plugged is None:
            raise OSError(errno.ENOENT, "no such device", path)
        if plugged.camera.open_errno:
            raise OSError(plugged.camera.open_errno, "refused", path)
        kind = _VIDEO if real.endswith(f"video{plugged.number}") else _META
        self._next_fd += 1
        self._open[self._next_fd] = _Open(plugged, kind)
        return self._next_fd

    def close(self, fd: int) -> None:
        """Close, and free what the descriptor owned."""
        held = self._open.pop(fd)
        queue = held.plugged.queues.get(held.kind)
        if queue is not None and queue.owner == fd:
            del held.plugged.queues[held.kind]

    def mmap(self, fd: int, length: int, offset: int) -> FakeMapping:
        """Map the buffer at `offset` (its index in pages)."""
        held = self._held(fd)
        memory = held.plugged.queues[held.kind].buffers[offset >> 12].memory
        assert memory.size == length
        mapping = FakeMapping(self, memory)
        self.mappings.add(id(mapping))
        return mapping

    def poll(self, watched: Sequence[tuple[int, int]], timeout_s: float) -> dict[int, int]:
        """Wait, in this kernel's time."""
        deadline = self.clock.now_ns + round(timeout_s * 1e9)
        while True:
            ready = {fd: found for fd, events in watched if (found := self._ready(fd, events))}
            if ready or self.clock.now_ns >= deadline:
                return ready
            self.clock.sleep_until(min([deadline, *(self._next_event_ns(fd) for fd, _ in watched)]))

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure) -> None:
        """Decode and run one request."""
        held = self._held(fd)
        number = request & 0xFF
        self.requests.append(number)
        size = (request >> 16) & 0x3FFF
        if (request >> 8) & 0xFF != ord("V") or size != ctypes.sizeof(argument):
            raise OSError(errno.ENOTTY, "not a V4L2 request")
        if injected := held.plugged.camera.request_errno.get(number, 0):
            raise OSError(injected, "injected")
        data = bytearray(ctypes.string_at(ctypes.addressof(argument), size))
        if number == 8:
            self._reqbufs(fd, held, data)
        elif number in self._handlers:
            self._check_owner(fd, held, number)
            self._handlers[number](held, data)
        else:
            raise OSError(errno.ENOTTY, "unknown request")
        ctypes.memmove(ctypes.addressof(argument), bytes(data), size)

    def _held(self, fd: int) -> _Open:
        held = self._open.get(fd)
        if held is None:
            raise OSError(errno.EBADF, "closed")
        if held.plugged.gone:
            raise OSError(errno.ENODEV, "gone")
        return held

    @staticmethod
    def _check_owner(fd: int, held: _Open, number: int) -> None:
        queue = held.plugged.queues.get(held.kind)
        if number in (5, 9, 15, 17, 18, 19) and queue is not None and queue.owner != fd:
            raise OSError(errno.EBUSY, "another descriptor streams")

    def _ready(self, fd: int, events: int) -> int:
        held = self._open[fd]
        self._run(held.plugged)
        if held.plugged.gone:
            return POLLERR | POLLHUP
        queue = held.plugged.queues.get(held.kind)
        found = POLLPRI if held.plugged.events and events & POLLPRI else 0
        if queue is None or not queue.streaming:
            raise AssertionError("a capture descriptor that is not streaming was polled")
        return found | (POLLIN if queue.done and events & POLLIN else 0)

    def _next_event_ns(self, fd: int) -> int:
        plugged = self._open[fd].plugged
        if plugged.pending is None:
            plugged.pending = plugged.camera.frame(plugged.next_frame, plugged.t_on_ns)
        return plugged.pending.t_ready_ns

    # -- frames --------------------------------------------------------------------------------------

    def _run(self, plugged: _Plugged) -> None:
        """Deliver every frame that is ready by now."""
        video = plugged.queues.get(_VIDEO)
        while not plugged.gone and video is not None and video.streaming:
            if plugged.pending is None:
                plugged.pending = plugged.camera.frame(plugged.next_frame, plugged.t_on_ns)
            truth = plugged.pending
            if truth.t_ready_ns > self.clock.now_ns:
                return
            plugged.pending = None
            plugged.next_frame += 1
            self._deliver(plugged, video, truth)

    def _deliver(self, plugged: _Plugged, video: _Queue, truth: FrameTruth) -> None:
        camera = plugged.camera
        camera.truth.append(truth)
        fault = camera.faults.get(truth.number, "")
        if fault == "unplug":
            self.unplug(camera)
            return
        index = next((i for i, b in enumerate(video.buffers) if b.queued), None)
        if index is not None and fault != "lost":
            buffer = video.buffers[index]
            used = 0 if fault == "empty" else camera.fill(truth.number, buffer.memory)
            buffer.used = used // 2 if fault == "short" else used
            buffer.flags = camera.time_flags() | (0x40 if fault == "flagged" else 0)
            buffer.t_ns, buffer.sequence, buffer.queued = truth.t_stamp_ns, truth.number, False
            video.done.append(index)
        meta = plugged.queues.get(_META)
        if meta is not None and meta.streaming:
            index = next((i for i, b in enumerate(meta.buffers) if b.queued), None)
            if index is not None:
                data = camera.metadata(truth)
                buffer = meta.buffers[index]
                buffer.memory[: len(data)] = np.frombuffer(data, dtype=np.uint8)
                buffer.used, buffer.sequence, buffer.queued = len(data), truth.number, False
                meta.done.append(index)

    # -- requests; offsets from linux/videodev2.h on 64 bit ------------------------------------------

    def _querycap(self, held: _Open, data: bytearray) -> None:
        camera = held.plugged.camera
        own = 0x04000001 if held.kind == _VIDEO else 0x04800000
        texts = (camera.driver.encode(), camera.name.encode(), f"usb-fake-{camera.port}".encode())
        struct.pack_into("<16s32s32sIII", data, 0, *texts, 0x060100, 0x84A00001, own)

    def _enum_fmt(self, held: _Open, data: bytearray) -> None:
        (index,) = struct.unpack_from("<I", data, 0)
        name = _pick(list(held.plugged.camera.formats), index)
        struct.pack_into("<32s4s", data, 12, name.encode(), name.ljust(4).encode())

    def _g_fmt(self, held: _Open, data: bytearray) -> None:
        camera = held.plugged.camera
        if held.kind == _META:
            struct.pack_into("<4sI", data, 8, b"UVCH", 10240)
            return
        code = camera.pixel_format.ljust(4).encode()
        stride = 0 if camera.pixel_format == "MJPG" else camera.stride
        struct.pack_into(
            "<II4sIII", data, 8, camera.width, camera.height, code, 1, stride, camera.image_bytes
        )

    def _s_fmt(self, held: _Open, data: bytearray) -> None:
        camera = held.plugged.camera
        if held.kind == _VIDEO:
            width, height, code = struct.unpack_from("<II4s", data, 8)
            name = code.decode().rstrip()
            camera.pixel_format = name if name in camera.formats else next(iter(camera.formats))
            sizes = camera.formats[camera.pixel_format]
            nearest = min(sizes, key=lambda s: abs(s[0] - width) + abs(s[1] - height))
            camera.width, camera.height = nearest
        self._g_fmt(held, data)

    def _sizes(self, held: _Open, data: bytearray) -> None:
        index, code = struct.unpack_from("<I4s", data, 0)
        sizes = held.plugged.camera.formats.get(code.decode().rstrip(), {})
        struct.pack_into("<III", data, 8, 1, *_pick(list(sizes), index))

    def _rates(self, held: _Open, data: bytearray) -> None:
        index, code, width, height = struct.unpack_from("<I4sII", data, 0)
        sizes = held.plugged.camera.formats.get(code.decode().rstrip(), {})
        rate = _pick(list(sizes.get((width, height), ())), index)
        struct.pack_into("<III", data, 16, 1, 1000, round(rate * 1000))

    def _g_parm(self, held: _Open, data: bytearray) -> None:
        struct.pack_into("<IIII", data, 4, 0x1000, 0, 1000, round(held.plugged.camera.rate_hz * 1000))

    def _s_parm(self, held: _Open, data: bytearray) -> None:
        camera = held.plugged.camera
        numerator, denominator = struct.unpack_from("<II", data, 12)
        rates = camera.formats[camera.pixel_format][camera.width, camera.height]
        camera.rate_hz = min(rates, key=lambda r: abs(r - denominator / numerator))
        self._g_parm(held, data)

    def _reqbufs(self, fd: int, held: _Open, data: bytearray) -> None:
        (count,) = struct.unpack_from("<I", data, 0)
        queue = held.plugged.queues.get(held.kind)
        if queue is not None and queue.owner != fd:
            raise OSError(errno.EBUSY, "another descriptor streams")
        if count == 0:
            held.plugged.queues.pop(held.kind, None)
            return
        granted = min(count, held.plugged.camera.max_buffers)
        size = held.plugged.camera.image_bytes if held.kind == _VIDEO else 10240
        buffers = [_Buffer(np.zeros(size, np.uint8)) for _ in range(granted)]
        held.plugged.queues[held.kind] = _Queue(fd, buffers)
        struct.pack_into("<I", data, 0, granted)

    def _querybuf(self, held: _Open, data: bytearray) -> None:
        (index,) = struct.unpack_from("<I", data, 0)
        buffer = _pick(held.plugged.queues[held.kind].buffers, index)
        struct.pack_into("<Q", data, 64, index << 12)
        struct.pack_into("<I", data, 72, buffer.memory.size)

    def _qbuf(self, held: _Open, data: bytearray) -> None:
        self._run(held.plugged)
        (index,) = struct.unpack_from("<I", data, 0)
        buffer = _pick(held.plugged.queues[held.kind].buffers, index)
        if buffer.queued:
            raise OSError(errno.EINVAL, "already queued")
        buffer.queued = True

    def _dqbuf(self, held: _Open, data: bytearray) -> None:
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

    def _streamon(self, held: _Open, _data: bytearray) -> None:
        held.plugged.queues[held.kind].streaming = True
        if held.kind == _VIDEO:
            held.plugged.t_on_ns = self.clock.now_ns + 1_000_000
            held.plugged.next_frame, held.plugged.pending = 0, None
            held.plugged.camera.truth.clear()

    def _streamoff(self, held: _Open, _data: bytearray) -> None:
        held.plugged.queues[held.kind].streaming = False

    def _query_ctrl(self, held: _Open, data: bytearray) -> None:
        (wanted,) = struct.unpack_from("<I", data, 0)
        camera = held.plugged.camera
        later = [c for c in sorted(camera.controls, key=lambda c: c.control_id)
                 if c.control_id > wanted & 0x0FFFFFFF]  # fmt: skip
        c = _pick(later, 0)
        flags = 0 if _active(camera, c) else INACTIVE
        struct.pack_into("<II32s", data, 0, c.control_id, c.kind, c.name.encode())
        struct.pack_into("<qqQqI", data, 40, c.minimum, c.maximum, c.step, c.value, flags)

    def _querymenu(self, held: _Open, data: bytearray) -> None:
        control_id, index = struct.unpack_from("<II", data, 0)
        control = held.plugged.camera.control(control_id)
        if control is None or index not in control.menu:
            raise OSError(errno.EINVAL, "no such entry")
        struct.pack_into("<32s", data, 8, control.menu[index].encode())

    def _g_ctrl(self, held: _Open, data: bytearray) -> None:
        control, address = self._batch(held, data)
        ctypes.memmove(address + 12, struct.pack("<i", control.value), 4)

    def _s_ctrl(self, held: _Open, data: bytearray) -> None:
        control, address = self._batch(held, data)
        camera = held.plugged.camera
        if not _active(camera, control):
            raise OSError(errno.EACCES, "inactive")
        (value,) = struct.unpack("<i", ctypes.string_at(address + 12, 4))
        self._run(held.plugged)
        control.value = min(max(value, control.minimum), control.maximum)
        self._note_control(camera)

    @staticmethod
    def _batch(held: _Open, data: bytearray) -> tuple[FakeControl, int]:
        _which, count = struct.unpack_from("<II", data, 0)
        (address,) = struct.unpack_from("<Q", data, 24)
        (control_id,) = struct.unpack("<I", ctypes.string_at(address, 4))
        control = held.plugged.camera.control(control_id)
        if count != 1 or control is None:
            raise OSError(errno.EINVAL, "no such control")
        return control, int(address)

    def _subscribe(self, held: _Open, data: bytearray) -> None:
        kind, control_id = struct.unpack_from("<II", data, 0)
        if kind != 3:
            raise OSError(errno.EINVAL, "only control events")
        held.subscribed.add(control_id)

    def _dqevent(self, held: _Open, data: bytearray) -> None:
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
