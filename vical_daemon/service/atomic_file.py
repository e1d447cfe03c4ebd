"""Atomic file writes: after a crash or power cut a file has its old or its new content."""

from __future__ import annotations

import errno
import os
import stat
from contextlib import suppress
from pathlib import Path


def atomic_write(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Write a file atomically: a reader finds the old or the new content, never a part of it.

    Args:
        path: The file; its folder is created if missing.
        data: The new content.
        durable: Wait until it is on the disk. False: for what is of no use after a power cut.

    Raises:
        OSError: The write failed; the old content is kept and no temporary file is left.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from None  # `write` does not name the file
    if not durable:
        return
    sync_folder(path.parent)


def why_refused(error: OSError) -> str:
    """Say why nothing can be written; below systemd, whose sandbox may be the reason, what to do."""
    text, own = error.strerror or str(error), os.environ.get("STATE_DIRECTORY")
    if own and error.errno in (errno.EROFS, errno.EACCES):
        return (
            f"{text}; outside of {own} the service needs ReadWritePaths= in its unit, and a folder that "
            "belongs to its user (docs/service.md, Sandbox)"
        )
    return text


def sync_folder(folder: Path | int) -> None:
    """Make a rename in a folder survive a power cut, where the file system can do that.

    Some network disks, and those of virtual machines, sync files alone.

    Args:
        folder: Its path, or a descriptor of it.
    """
    descriptor = folder if isinstance(folder, int) else os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        if descriptor != folder:
            os.close(descriptor)


def write_output(path: Path, data: str | bytes) -> None:
    """Write a file that a person asked for; a disk that is full leaves the earlier one as it was.

    Pipes and devices are written to, and links followed. The mode of an earlier file is kept.

    Args:
        path: The file.
        data: Its content; text becomes UTF-8, with ? for what that lacks (names of files that are not UTF-8).

    Raises:
        OSError: It cannot be written, or its folder is missing; names the file.
    """
    content = data.encode(errors="replace") if isinstance(data, str) else data
    place = Path(os.path.realpath(path))
    try:
        before = path.stat()
    except FileNotFoundError:
        before = None
        place.parent.stat()  # `atomic_write` would make it
    regular = before is None or stat.S_ISREG(before.st_mode)
    replaces = regular and (before is None or os.access(place.parent, os.W_OK))
    try:
        if replaces:
            atomic_write(place, content)
        else:
            path.write_bytes(content)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    if before is not None and replaces:
        with suppress(OSError):  # another user's file
            place.chmod(stat.S_IMODE(before.st_mode))
