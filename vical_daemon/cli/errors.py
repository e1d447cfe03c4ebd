"""What a command raises when it knows what went wrong, and how any failure ends for the user."""

from __future__ import annotations

import os
import sys
import tempfile
import traceback
from datetime import UTC, datetime
from pathlib import Path

EXIT_FAILURE = 1
EXIT_USAGE = 2
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE, what a shell reports for `cat big | head -1`
EXIT_INTERRUPTED = 130  # 128 + SIGINT

_OURS = ("vical_daemon", "vical_drivers", "vical_mocks")


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
    operating system's refusals that name a file.
    """
    if type(error).__module__.split(".")[0] in _OURS:
        return _one_line(str(error)), int(getattr(error, "exit_code", EXIT_FAILURE))
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror or type(error).__name__}", EXIT_FAILURE
    return None


def write_crash_log(error: BaseException) -> Path | None:
    """Write the traceback of a bug to a file of its own; None where no folder can be written."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
    text = f"argv: {sys.argv}\npython: {sys.version}\n\n" + "".join(traceback.format_exception(error))
    for folder in _log_folders():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"crash-{stamp}-{os.getpid()}.log"
            path.write_text(text, encoding="utf-8")
        except OSError:
            continue
        return path
    return None


def _log_folders() -> list[Path]:
    folders = [Path(d) for d in os.environ.get("LOGS_DIRECTORY", "").split(":") if d]
    state = os.environ.get("XDG_STATE_HOME", "")
    home = os.environ.get("HOME", "")
    if state:
        folders.append(Path(state) / "vical")
    elif home:
        folders.append(Path(home) / ".local" / "state" / "vical")
    return [*folders, Path(tempfile.gettempdir())]


def _one_line(text: str) -> str:
    return " ".join(text.split())
