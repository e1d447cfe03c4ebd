"""Who has a terminal open besides the emulator itself, by inotify: a pseudo terminal does not show it."""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
from pathlib import Path

_OPEN, _CLOSE = 0x20, 0x18  # linux/inotify.h: IN_OPEN, IN_CLOSE_WRITE | IN_CLOSE_NOWRITE
_NONBLOCK, _CLOEXEC = os.O_NONBLOCK, os.O_CLOEXEC
_EVENT = struct.Struct("iIII")


class Openers:
    """Counts how often a terminal is open.

    A system without inotify (or with no instance left) is taken as one where somebody always has it open.

    Args:
        terminal: Descriptor of the terminal; it does not count itself.
    """

    def __init__(self, terminal: int) -> None:
        self._terminal, self._path = terminal, os.ttyname(terminal)
        libc = ctypes.CDLL(None, use_errno=True)
        self._fd = int(libc.inotify_init1(_NONBLOCK | _CLOEXEC))
        if self._fd >= 0 and libc.inotify_add_watch(self._fd, os.fsencode(self._path), _OPEN | _CLOSE) < 0:
            self.close()
        self.count = 0 if self._fd >= 0 else 1

    def fileno(self) -> int:
        """Becomes readable when somebody opens or closes; -1: never."""
        return self._fd

    def closed_by_all(self) -> bool:
        """Take in what happened; True where the last one has closed it since."""
        closed = False
        data = b""
        if self._fd >= 0:
            with contextlib.suppress(BlockingIOError):
                data = os.read(self._fd, 4096)
        while data:
            _, mask, _, length = _EVENT.unpack_from(data)
            data = data[_EVENT.size + length :]
            if mask & _OPEN:
                self.count += 1
            elif mask & _CLOSE:
                self.count = max(0, self.count - 1)
                closed = True
        if closed and self.count == 0:
            self.count = self._seen()  # of two openings at one instant inotify reports one
        return closed and self.count == 0

    def _seen(self) -> int:
        """Count the descriptors of the terminal in all processes that this user may look into."""
        own = f"/proc/{os.getpid()}/fd/{self._terminal}"
        count = 0
        for process in os.scandir("/proc"):
            if process.name.isdigit():
                with contextlib.suppress(OSError):  # gone, or somebody else's
                    links = [Path(entry.path) for entry in os.scandir(f"{process.path}/fd")]
                    count += sum(str(link) != own and _target(link) == self._path for link in links)
        return count

    def close(self) -> None:
        """End; may be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _target(link: Path) -> str:
    try:
        return str(link.readlink())
    except OSError:  # closed meanwhile
        return ""
