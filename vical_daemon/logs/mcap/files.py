"""The file of an MCAP writer, with its errors, its size, and its lock."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vical_daemon.service.atomic_file import sync_folder, why_refused

PART_SUFFIX = ".part"


class LogError(Exception):
    """A log cannot be written or read; the message is one line for the user."""


class LockedFile:
    """An exclusively created, locked file that an MCAP writer can use.

    The lock says "still being written": it dies with the process, so that a file left by a killed
    recorder differs from one that another recorder is writing. Errors are kept as well as raised,
    because a native writer that calls back may swallow them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.error: OSError | None = None
        self._fd = self._folder_fd = -1
        while self._fd < 0:  # a cleanup may remove it as a leftover before it is locked
            try:
                self._folder_fd = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
                self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
            except OSError as error:
                self.close()
                raise LogError(f"cannot create {path}: {why_refused(error)}") from None
            fcntl.flock(self._fd, fcntl.LOCK_EX)
            if os.fstat(self._fd).st_nlink == 0:
                self.close()
        self._position = 0
        self.size = 0

    def write(self, data: bytes | bytearray) -> int:
        """Write all of the data (called by the MCAP writer)."""
        view = memoryview(data)
        try:
            while view:
                written = os.write(self._fd, view)
                view = view[written:]
                self._position += written
        except OSError as error:
            self.error = self.error or error
            raise
        self.size = max(self.size, self._position)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move the write position (the writer fills in the length of a finished chunk)."""
        self._position = os.lseek(self._fd, offset, whence)
        return self._position

    def flush(self) -> None:
        """Nothing is buffered here."""

    def sync(self) -> None:
        """Force data to the disk: survives a power cut, not only a crash. Takes 20 ms and more."""
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            self.error = self.error or error

    def publish(self, name: str) -> None:
        """Give the finished file its final name, never over an existing one, also if its folder was moved.

        Raises:
            LogError: The name is taken, or the file was deleted.
        """
        try:
            os.stat(name, dir_fd=self._folder_fd)
        except OSError:
            pass
        else:
            raise LogError(f"{self.path.with_name(name)} exists already; remove it or choose another name")
        try:
            os.rename(self.path.name, name, src_dir_fd=self._folder_fd, dst_dir_fd=self._folder_fd)
            sync_folder(self._folder_fd)
        except OSError as error:
            raise LogError(f"cannot finish {self.path}: {describe(error)}") from None

    def close(self) -> None:
        """Close the file and release the lock; may be called twice."""
        descriptors, self._fd, self._folder_fd = (self._fd, self._folder_fd), -1, -1
        for descriptor in descriptors:
            if descriptor >= 0:
                with suppress(OSError):  # a network disk: what was not written, `sync` has reported
                    os.close(descriptor)


def describe(error: OSError) -> str:
    """Return the text of an operating system error."""
    return error.strerror or str(error)


@contextmanager
def _locked(path: Path, how: int) -> Iterator[int]:
    """Hold the lock of a file; BlockingIOError: another process is writing it."""
    access = os.O_RDWR if how == fcntl.LOCK_EX else os.O_RDONLY
    descriptor = os.open(path, access | os.O_NONBLOCK | os.O_CLOEXEC)  # it may be a pipe: do not wait
    try:
        fcntl.flock(descriptor, how | fcntl.LOCK_NB)
        yield descriptor
    finally:
        os.close(descriptor)


def is_being_written(path: Path) -> bool:
    """Return whether a living process holds the lock of a file."""
    try:
        with _locked(path, fcntl.LOCK_SH):
            return False
    except BlockingIOError:
        return True
    except OSError:
        return False


def holds_data(path: Path) -> bool:
    """Whether a recorder that is gone left data in a file; one that it left empty is removed.

    The lock is held while it is looked at and removed: a recorder that has just made it finds it gone and
    makes another (`LockedFile`).
    """
    try:
        with _locked(path, fcntl.LOCK_EX) as descriptor:
            if os.fstat(descriptor).st_size:
                return True
            path.unlink(missing_ok=True)
    except (BlockingIOError, FileNotFoundError):  # being written, or gone
        return False
    except OSError:  # another user's file: reading it later will report the error
        return True
    return False


def publish(part: Path, path: Path) -> None:
    """Give a finished file its final name, never over an existing one."""
    if path.exists():
        raise LogError(f"{path} exists already; remove it or choose another name")
    part.rename(path)
    sync_folder(path.parent)
