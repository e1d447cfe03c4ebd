"""The one way in for files that a user names: regular files only, never more bytes than such a file has.

A device, a pipe or a socket in the place of a file would block for ever or never end. Nothing is read from
standard input: recordings are read twice, settings again by every process.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

_KINDS = (
    (stat.S_ISDIR, errno.EISDIR, "a folder"),
    (stat.S_ISFIFO, errno.EINVAL, "a pipe"),
    (stat.S_ISSOCK, errno.EINVAL, "a socket"),
    (stat.S_ISCHR, errno.EINVAL, "a device"),
    (stat.S_ISBLK, errno.EINVAL, "a device"),
)


def open_file(path: Path, limit: int | None = None) -> BinaryIO:
    """Open a regular file for reading, without ever waiting for somebody at its other end.

    Args:
        path: As the user named it.
        limit: Largest size, bytes; None: whoever reads it piece by piece needs no limit.

    Raises:
        OSError: As the system says, or the file is of another kind or too large; it names the file, and its
            `strerror` is a phrase for a person.
    """
    _refuse(path, path.stat(), limit)  # before it is opened: to open a device may already do something
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        _refuse(path, os.fstat(descriptor), limit)  # what was opened may be another file by now
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_file(path: Path, limit: int) -> bytes:
    """Return what a regular file holds.

    Args:
        path: As the user named it.
        limit: Largest size, bytes.

    Raises:
        OSError: As `open_file`.
    """
    with open_file(path, limit) as file:
        try:
            data = file.read(limit + 1)  # the size that a file states may be wrong: /proc, a file that grows
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from None
    if len(data) > limit:
        raise _too_large(path, limit)
    return data


def read_text(path: Path, limit: int) -> str:
    """Return the text of a regular file, UTF-8.

    Raises:
        OSError: As `open_file`.
        UnicodeDecodeError: No text.
    """
    return read_file(path, limit).decode("utf-8")


def _refuse(path: Path, about: os.stat_result, limit: int | None) -> None:
    for is_kind, code, name in _KINDS:
        if is_kind(about.st_mode):
            raise OSError(code, f"is {name}, a file is needed", str(path))
    if limit is not None and about.st_size > limit:
        raise _too_large(path, limit)


def _too_large(path: Path, limit: int) -> OSError:
    size = f"{limit / 1e6:.0f} MB" if limit >= 10**6 else f"{limit / 1e3:.0f} kB"
    return OSError(errno.EFBIG, f"larger than {size}, it cannot be the right file", str(path))
