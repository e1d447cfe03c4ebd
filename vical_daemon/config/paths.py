"""Folders of the service for run time and state: those of systemd, else the user's own."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

LOOPBACK_PORT = 7447
"""zenoh's usual port, used for the loopback endpoint if the config names no other."""


def runtime_directory() -> Path:
    """Return the folder for sockets and files until the next boot (``/run/vical`` as a service)."""
    given = chosen_runtime_directory()
    if given is not None:
        return given
    session = _absolute("XDG_RUNTIME_DIR")
    if session is not None and _is_own(session):
        return session / "vical"
    return Path(tempfile.gettempdir()) / f"vical-{os.getuid()}"


def chosen_runtime_directory() -> Path | None:
    """Return the runtime folder that the environment names; None: it names none."""
    given = os.environ.get("VICAL_RUNTIME_DIR") or _first("RUNTIME_DIRECTORY")
    return Path(given) if given else None


def state_directory() -> Path:
    """Return the folder for calibrations and recordings (``/var/lib/vical`` as a service)."""
    given = os.environ.get("VICAL_STATE_DIR") or _first("STATE_DIRECTORY")
    if given:
        return Path(given)
    home = _absolute("XDG_STATE_HOME")
    if home is not None:
        return home / "vical"
    try:
        return Path.home() / ".local" / "state" / "vical"
    except RuntimeError:  # a user without HOME and without a passwd entry
        return runtime_directory() / "state"


def make_private(folder: Path) -> Path:
    """Create a folder that only this user (and group) may enter, and return it.

    Raises:
        OSError: It cannot be made, or belongs to another user, who could place files there.
    """
    try:
        folder.mkdir(mode=0o750, parents=True, exist_ok=True)
    except OSError as error:
        reason = f"cannot be made ({error.strerror}); set VICAL_RUNTIME_DIR or bus.socket"
        raise OSError(error.errno, reason, str(folder)) from None
    if folder.stat().st_uid not in (os.getuid(), 0):
        raise PermissionError(13, "belongs to another user; set VICAL_RUNTIME_DIR", str(folder))
    return folder


def _absolute(variable: str) -> Path | None:
    """Return a folder that the session names; a relative one counts as none (XDG base directories)."""
    path = Path(os.environ.get(variable, ""))
    return path if path.is_absolute() else None


def _is_own(folder: Path) -> bool:
    """Whether a folder exists and is this user's: after `su` the variable names that of another session."""
    try:
        return folder.stat().st_uid == os.getuid()
    except OSError:
        return False


def _first(variable: str) -> str:
    """Return the first folder of a variable in which systemd separates folders with colons."""
    return os.environ.get(variable, "").split(":")[0]
