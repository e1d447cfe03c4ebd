"""What a command raises when it knows what went wrong, and how any failure ends for the user."""

from __future__ import annotations

import errno
import logging
import os
import sys
import tempfile
import threading
import traceback
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

EXIT_FAILURE = 1
EXIT_USAGE = 2
EXIT_NOT_CONVERGED = 3  # done, but the result is not `converged`
EXIT_CHANGED = 4  # `verify`, `compare`: no longer the same
EXIT_CANNOT_TELL = 5  # `verify`: this recording cannot tell; `compare`: not comparable
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE, what a shell reports for `cat big | head -1`
EXIT_INTERRUPTED = 130  # 128 + SIGINT
NOTHING_TO_RUN = "no IMUs and no cameras: there is nothing to run (`vical devices` prints what to write)"

_OURS = ("vical_daemon", "vical_drivers", "vical_mocks")
_REFUSALS = {
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.ENODEV, errno.ENXIO,
    errno.EMFILE, errno.ENFILE,
}  # fmt: skip
"""What disks and devices refuse with: no bug, even where the system does not name the file."""
_log = logging.getLogger(__name__)


class CliError(Exception):
    """A failure the user can act on; the message is one line: what, where, what to try.

    Args:
        message: One line for a person, without a full stop at the end.
        exit_code: 1: it did not work; 2: bad usage or bad config.
    """

    def __init__(self, message: str, exit_code: int = EXIT_FAILURE) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def describe_known(error: BaseException) -> tuple[str, int] | None:
    """Return (line, exit code) of a failure that was foreseen, None for a bug.

    Foreseen are: every exception class that one of our packages defines (they are raised on purpose,
    with a message for a person; `exit_code` on the class or instance chooses the code), and the
    operating system's refusals that name a file or come from a disk or a device.
    """
    if type(error).__module__.split(".")[0] in _OURS:
        return _one_line(str(error)), int(getattr(error, "exit_code", EXIT_FAILURE))
    if isinstance(error, FileNotFoundError) and _folder_is_gone():
        return "the current folder has been removed; change to another one", EXIT_FAILURE
    if isinstance(error, OSError) and error.filename is None and error.errno in _REFUSALS:
        return error.strerror or str(error), EXIT_FAILURE
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror or type(error).__name__}", EXIT_FAILURE
    return None


def write_crash_log(error: BaseException) -> Path | None:
    """Write the traceback of a bug to a file of its own; None where no folder can be written."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
    text = f"argv: {sys.argv}\npython: {sys.version}\n\n" + "".join(traceback.format_exception(error))
    for folder in _log_folders():
        path = folder / f"crash-{stamp}-{os.getpid()}.log"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        except OSError:
            with suppress(OSError):  # what was written before the disk was full
                path.unlink(missing_ok=True)
            continue
        return path
    return None


def describe(error: BaseException) -> tuple[str, int]:
    """Return (line, exit code) of any failure; a bug also leaves its traceback in a file."""
    known = describe_known(error)
    if known is not None:
        return known
    path = write_crash_log(error)
    where = f"the traceback is in {path}" if path else "no folder to write the traceback to"
    line = _one_line(f"{type(error).__name__}: {error}")
    if isinstance(error, MemoryError):
        why = _one_line(str(error)) or "has this process a limit (ulimit -v, a container)?"
        return f"out of memory: {why}; {where}", EXIT_FAILURE
    return f"internal error: {line}; {where}, please report it", EXIT_FAILURE


def report_thread(args: threading.ExceptHookArgs) -> None:
    """Report in one line what a thread died of (`threading.excepthook`)."""
    if args.exc_value is not None and not isinstance(args.exc_value, SystemExit):
        name = args.thread.name if args.thread is not None else "?"
        _log.error("thread %s ended: %s", name, describe(args.exc_value)[0])


def _folder_is_gone() -> bool:
    try:
        Path.cwd()
    except FileNotFoundError:
        return True
    return False


def _log_folders() -> list[Path]:
    folders = [Path(d) for d in os.environ.get("LOGS_DIRECTORY", "").split(":") if d]
    state = os.environ.get("XDG_STATE_HOME", "")
    home = os.environ.get("HOME", "")
    if Path(state).is_absolute():
        folders.append(Path(state) / "vical")
    elif home:
        folders.append(Path(home) / ".local" / "state" / "vical")
    return [*folders, Path(tempfile.gettempdir())]


def _one_line(text: str) -> str:
    return " ".join(text.split())
