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
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vical_drivers.host_clocks import HostClocks, read_all_clocks

_libc = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = ctypes.c_void_p
_libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
_libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]


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

    def clocks(self) -> HostClocks:
        """All clocks of the host now."""
        ...


class _MappedMemory:
    """Shared memory of a device, unmapped when its last view goes.

    Not `mmap.mmap`: that duplicates the descriptor, and a picture somebody still holds would keep a camera
    busy that was closed long ago.
    """

    def __init__(self, fd: int, length: int, offset: int) -> None:
        address = _libc.mmap(None, length, mmap.PROT_READ | mmap.PROT_WRITE, mmap.MAP_SHARED, fd, offset)
        if address in (None, ctypes.c_void_p(-1).value):
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))
        memory = (ctypes.c_uint8 * length).from_address(address)
        weakref.finalize(memory, _libc.munmap, address, length)
        self._array: npt.NDArray[np.uint8] | None = np.ctypeslib.as_array(memory)

    @property
    def array(self) -> npt.NDArray[np.uint8]:
        """The bytes."""
        if self._array is None:
            raise ValueError("the buffer is unmapped")
        return self._array

    def close(self) -> None:
        """Let go; memory that a borrowed frame still shows goes when that frame goes."""
        self._array = None


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

    def clocks(self) -> HostClocks:
        """See `Kernel.clocks`."""
        return read_all_clocks()
