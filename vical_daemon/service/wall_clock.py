"""One offset from CLOCK_MONOTONIC to UNIX time for all processes: NTP never tears two sensors apart.

Inside a host stamps are monotonic; on the wire they are UNIX time = monotonic + one offset that whichever
process comes first measures and leaves in a file. A later step of the wall clock changes nothing until all
processes of the service have been stopped and the runtime directory is gone, or the machine boots again.
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
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True)
class WallClock:
    """Attributes: `offset_ns` UNIX minus CLOCK_MONOTONIC, ns; `boot_id` of the boot that it holds for."""

    offset_ns: int
    boot_id: str = ""

    def unix_ns(self, t_host_ns: int) -> int:
        """Turn a monotonic stamp into the stamp that travels."""
        return t_host_ns + self.offset_ns

    def now_ns(self) -> int:
        """UNIX time by this clock: never steps."""
        return time.monotonic_ns() + self.offset_ns

    def step_ns(self) -> int:
        """How far the wall clock has moved away since the offset was taken, ns."""
        return measure_offset_ns() - self.offset_ns

    def status_values(self) -> dict[str, str]:
        """The pair that every status carries."""
        return {
            "wall_minus_monotonic_ns": str(self.offset_ns),
            "boot_id": self.boot_id,
            "wall_clock_step_s": f"{self.step_ns() * 1e-9:.6f}",
        }


def measure_offset_ns() -> int:
    """UNIX time minus CLOCK_MONOTONIC, ns: the tightest of a few bracketed readings."""
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
    """A clock for a process that shares its stamps with nobody (demo, tests)."""
    return WallClock(measure_offset_ns(), boot_id())


def service_clock() -> WallClock:
    """Return the clock that all processes of the service share."""
    return shared_clock(make_private(runtime_directory()))


def shared_clock(folder: Path) -> WallClock:
    """Return the clock of the service: the first process to come makes the file, the others read it.

    A file of an earlier boot, or one that cannot be read, is replaced.

    Args:
        folder: The runtime directory.
    """
    path = folder / FILE_NAME
    clock = _read(path)
    if clock is not None and clock.boot_id == boot_id():  # such a file is never replaced: no lock needed
        return clock
    with _alone_in(folder):
        clock = _read(path)  # another role may have been faster
        if clock is None or clock.boot_id != boot_id():
            clock = private_clock()
            atomic_write(path, msgspec.json.encode(clock))
    return clock


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold the folder's lock; it is gone with the process."""
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def boot_id() -> str:
    """The kernel's name for this boot; empty where it has none."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _read(path: Path) -> WallClock | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=WallClock)
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError):
        return None
