"""A kernel with V4L2 cameras in it, behind open, ioctl, mmap and poll: everything above runs for real.

Time is virtual by default: `poll` jumps to the next event, and a test of minutes takes milliseconds. The
requests themselves are decoded in `v4l2_requests`.
"""

from __future__ import annotations

import ctypes
import errno
import shutil
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from vical_drivers.host_clocks import HostClocks

from vical_mocks.v4l2_camera import Bytes, FakeCamera, FrameTruth
from vical_mocks.v4l2_requests import (
    META,
    VIDEO,
    OpenNode,
    PluggedCamera,
    Queue,
    RealClock,
    Requests,
    VirtualClock,
)

__all__ = ["FakeKernel", "FakeMapping", "RealClock", "VirtualClock"]

POLLIN, POLLPRI, POLLERR, POLLHUP = 1, 2, 8, 16
_FIRST_FD = 1000


@dataclass
class FakeMapping:
    """Memory of one buffer."""

    kernel: FakeKernel
    array: Bytes

    def close(self) -> None:
        """Unmap; may be called twice."""
        self.kernel.mappings.discard(id(self))


class FakeKernel(Requests):
    """See the module; `root` receives a small sysfs and /dev.

    Args:
        root: Empty folder.
        clock: `VirtualClock` or `RealClock`.
    """

    def __init__(self, root: Path, clock: VirtualClock | RealClock | None = None) -> None:
        self.sysfs, self.dev = root / "sys", root / "dev"
        super().__init__(clock or VirtualClock())
        self.mappings: set[int] = set()
        self.requests: deque[int] = deque(maxlen=10_000)
        self.suspended_ns = 0
        self._open: dict[int, OpenNode] = {}
        self._next_fd = _FIRST_FD
        (self.dev / "v4l/by-id").mkdir(parents=True)
        (self.sysfs / "class/video4linux").mkdir(parents=True)

    # -- the world: plug, unplug, look for leaks -----------------------------------------------------

    @property
    def open_descriptors(self) -> int:
        """Descriptors that are open now."""
        return len(self._open)

    def plug(self, camera: FakeCamera, number: int = 0) -> str:
        """Put a camera into its port; returns the node's path. Its metadata node is the next number."""
        plugged = PluggedCamera(camera, number)
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
            link = self.dev / "v4l/by-id" / f"usb-{camera.serial_number}-video-index{index}"
            link.unlink(missing_ok=True)  # of two cameras with one serial number the last one has the link
            link.symlink_to(self.dev / name)
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

    # -- the boundary --------------------------------------------------------------------------------

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC."""
        return self.clock.now_ns

    def clocks(self) -> HostClocks:
        """The wall clock has another epoch; CLOCK_BOOTTIME is ahead by `suspended_ns`."""
        now_ns = self.clock.now_ns
        return HostClocks(now_ns, now_ns + 1_700_000_000_000_000_000, now_ns + self.suspended_ns)

    def open(self, path: str) -> int:
        """Open a node."""
        real = str(Path(path).resolve())
        plugged = self._plugged.get(real)
        if plugged is None:
            raise OSError(errno.ENOENT, "no such device", path)
        if plugged.camera.open_errno:
            raise OSError(plugged.camera.open_errno, "refused", path)
        kind = VIDEO if real.endswith(f"video{plugged.number}") else META
        self._next_fd += 1
        self._open[self._next_fd] = OpenNode(plugged, kind)
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

    def _held(self, fd: int) -> OpenNode:
        held = self._open.get(fd)
        if held is None:
            raise OSError(errno.EBADF, "closed")
        if held.plugged.gone:
            raise OSError(errno.ENODEV, "gone")
        return held

    @staticmethod
    def _check_owner(fd: int, held: OpenNode, number: int) -> None:
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

    def _run(self, plugged: PluggedCamera) -> None:
        """Deliver every frame that is ready by now."""
        video = plugged.queues.get(VIDEO)
        while not plugged.gone and video is not None and video.streaming:
            if plugged.pending is None:
                plugged.pending = plugged.camera.frame(plugged.next_frame, plugged.t_on_ns)
            truth = plugged.pending
            if truth.t_ready_ns > self.clock.now_ns:
                return
            plugged.pending = None
            plugged.next_frame += 1
            self._deliver(plugged, video, truth)

    def _deliver(self, plugged: PluggedCamera, video: Queue, truth: FrameTruth) -> None:
        camera = plugged.camera
        camera.truth.append(truth)
        fault = camera.faults.get(truth.number, "")
        if fault == "unplug":
            self.unplug(camera)
            return
        if fault == "kept":
            plugged.kept += 1
            return
        sequence = truth.number - plugged.kept
        index = next((i for i, b in enumerate(video.buffers) if b.queued), None)
        if index is not None and fault != "lost":
            buffer = video.buffers[index]
            used = 0 if fault == "empty" else camera.fill(truth.number, buffer.memory)
            buffer.used = used // 2 if fault == "short" else used
            buffer.flags = camera.time_flags() | (0x40 if fault == "flagged" else 0)
            buffer.t_ns, buffer.sequence, buffer.queued = truth.t_stamp_ns, sequence, False
            video.done.append(index)
        meta = plugged.queues.get(META)
        if meta is not None and meta.streaming:
            index = next((i for i, b in enumerate(meta.buffers) if b.queued), None)
            if index is not None:
                data = camera.metadata(truth)
                buffer = meta.buffers[index]
                buffer.memory[: len(data)] = np.frombuffer(data, dtype=np.uint8)
                buffer.used, buffer.sequence, buffer.queued = len(data), sequence, False
                meta.done.append(index)
