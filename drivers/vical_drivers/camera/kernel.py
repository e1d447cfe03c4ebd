"""The system-call boundary of the V4L2 grabber: open, ioctl, mmap, poll, clocks and the two folders.

Everything above this file is plain Python; a test or a demonstration puts a fake device below it
(`vical_mocks.v4l2_kernel`), and all of the driver's own code runs.
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import select
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt


class Mapping(Protocol):
    """Memory of one kernel buffer."""

    @property
    def array(self) -> npt.NDArray[np.uint8]:
        """The bytes, shape (length,), uint8."""
        ...

    def close(self) -> None:
        """Unmap, or leave it to the last user of the memory; may be called twice."""
        ...


class Kernel(Protocol):
    """What the driver asks of the operating system.

    Attributes:
        sysfs: Where sysfs is mounted.
        dev: Where the device nodes are.
    """

    sysfs: Path
    dev: Path

    def open(self, path: str) -> int:
        """Open a device node for reading and writing, non-blocking; raises OSError."""
        ...

    def close(self, fd: int) -> None:
        """Close a descriptor."""
        ...

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure) -> None:
        """Run a request that fills `argument` in place; raises OSError."""
        ...

    def mmap(self, fd: int, length: int, offset: int) -> Mapping:
        """Map one buffer, shared; raises OSError."""
        ...

    def poll(self, watched: Sequence[tuple[int, int]], timeout_s: float) -> dict[int, int]:
        """Wait for (descriptor, events) and return descriptor -> events; {} on timeout."""
        ...

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""
        ...

    def realtime_ns(self) -> int:
        """CLOCK_REALTIME, ns."""
        ...


class _MappedMemory:
    """An mmap whose views may outlive it: then the last view frees the memory."""

    def __init__(self, fd: int, length: int, offset: int) -> None:
        self._map: mmap.mmap | None = mmap.mmap(
            fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset
        )
        self._array: npt.NDArray[np.uint8] | None = np.frombuffer(self._map, dtype=np.uint8)

    @property
    def array(self) -> npt.NDArray[np.uint8]:
        """The bytes."""
        if self._array is None:
            raise ValueError("the buffer is unmapped")
        return self._array

    def close(self) -> None:
        """Unmap; memory that a borrowed frame still shows goes when that frame goes."""
        self._array = None
        if self._map is not None:
            try:
                self._map.close()
            except BufferError:
                pass
            self._map = None


class LinuxKernel:
    """The real one."""

    sysfs = Path("/sys")
    dev = Path("/dev")

    def open(self, path: str) -> int:
        """See `Kernel.open`."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, fd: int) -> None:
        """See `Kernel.close`."""
        os.close(fd)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure) -> None:
        """See `Kernel.ioctl`."""
        fcntl.ioctl(fd, request, argument, True)

    def mmap(self, fd: int, length: int, offset: int) -> Mapping:
        """See `Kernel.mmap`."""
        return _MappedMemory(fd, length, offset)

    def poll(self, watched: Sequence[tuple[int, int]], timeout_s: float) -> dict[int, int]:
        """See `Kernel.poll`."""
        poller = select.poll()
        for fd, events in watched:
            poller.register(fd, events)
        return dict(poller.poll(max(0.0, timeout_s) * 1e3))

    def monotonic_ns(self) -> int:
        """See `Kernel.monotonic_ns`."""
        return time.monotonic_ns()

    def realtime_ns(self) -> int:
        """See `Kernel.realtime_ns`."""
        return time.time_ns()
