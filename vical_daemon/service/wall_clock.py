"""One offset from CLOCK_MONOTONIC to UNIX time for all processes, so that NTP cannot shift one sensor.

Inside a host, stamps are monotonic. On the bus they are UNIX time = monotonic + offset. The first process
measures the offset and stores it in a file. A later step of the wall clock has no effect until all processes
of the service have stopped and the runtime directory is gone, or until the next boot.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

from vical_daemon.config.paths import make_private, runtime_directory
from vical_daemon.service.atomic_file import atomic_write

FILE_NAME = "wall_clock.json"
_END_NS = 2**31 * 1_000_000_000
"""Where the stamps of ROS 2 end, UNIX time in ns: their seconds are of 32 bits, with a sign."""
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class WallClockError(Exception):
    """The computer's date is none that a stamp can have; one line with a remedy."""


@dataclass(frozen=True, slots=True)
class WallClock:
    """Attributes: `offset_ns` UNIX minus CLOCK_MONOTONIC, ns; `boot_id` of the boot that it holds for."""

    offset_ns: int
    boot_id: str = ""

    def unix_ns(self, t_host_ns: int) -> int:
        """Convert a monotonic stamp to UNIX time, ns."""
        return t_host_ns + self.offset_ns

    def now_ns(self) -> int:
        """Return UNIX time by this clock, ns; it never steps."""
        return time.monotonic_ns() + self.offset_ns

    def step_ns(self) -> int:
        """Return how far the wall clock has stepped since the offset was measured, ns."""
        return measure_offset_ns() - self.offset_ns

    def status_values(self) -> dict[str, str]:
        """Return the values that every status includes."""
        return {
            "wall_minus_monotonic_ns": str(self.offset_ns),
            "boot_id": self.boot_id,
            "wall_clock_step_s": f"{self.step_ns() * 1e-9:.6f}",
        }


def measure_offset_ns() -> int:
    """Return UNIX time minus CLOCK_MONOTONIC, ns: the tightest of a few bracketed readings."""
    best_width_ns, best_offset_ns = None, 0
    for _ in range(5):
        before_ns = time.monotonic_ns()
        unix_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        if best_width_ns is None or after_ns - before_ns < best_width_ns:
            best_width_ns = after_ns - before_ns
            best_offset_ns = unix_ns - (before_ns + after_ns) // 2
    return best_offset_ns


def private_clock() -> WallClock:
    """Return a clock for a single process (demo, tests).

    Raises:
        WallClockError: The computer's date is wrong by decades.
    """
    clock = WallClock(measure_offset_ns(), boot_id())
    if not _holds(clock):
        date = time.strftime("%Y-%m-%d", time.gmtime(clock.now_ns() * 1e-9))
        raise WallClockError(
            f"the computer's date is {date}, and stamps of ROS 2 end on 2038-01-19; set it: timedatectl"
        )
    return clock


def service_clock() -> WallClock:
    """Return the clock that all processes of the service share."""
    return shared_clock(make_private(runtime_directory()))


def shared_clock(folder: Path) -> WallClock:
    """Return the clock of the service: the first process writes the file, the others read it.

    Replaces a file of an earlier boot, or one that cannot be read.

    Args:
        folder: The runtime directory.

    Raises:
        WallClockError: See `private_clock`.
    """
    path = folder / FILE_NAME
    clock = _read(path)
    if clock is not None and _holds(clock):  # a valid file is never replaced: no lock needed
        return clock
    with _alone_in(folder):
        clock = _read(path)  # another role may have been faster
        if clock is None or not _holds(clock):
            clock = private_clock()
            atomic_write(path, msgspec.json.encode(clock))
    return clock


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold the folder's lock; the kernel releases it if the process dies."""
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def boot_id() -> str:
    """Return the kernel's id of this boot, or ""."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _holds(clock: WallClock) -> bool:
    """Whether a clock is of this boot, and its stamps can be written."""
    return clock.boot_id == boot_id() and 0 <= clock.now_ns() < _END_NS


def _read(path: Path) -> WallClock | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=WallClock)
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError):
        return None
