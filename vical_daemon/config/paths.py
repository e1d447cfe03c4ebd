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
    session = os.environ.get("XDG_RUNTIME_DIR")
    return Path(session) / "vical" if session else Path(tempfile.gettempdir()) / f"vical-{os.getuid()}"


def chosen_runtime_directory() -> Path | None:
    """Return the runtime folder that the environment names; None: it names none."""
    given = os.environ.get("VICAL_RUNTIME_DIR") or _first("RUNTIME_DIRECTORY")
    return Path(given) if given else None


def state_directory() -> Path:
    """Return the folder for calibrations and recordings (``/var/lib/vical`` as a service)."""
    given = os.environ.get("VICAL_STATE_DIR") or _first("STATE_DIRECTORY")
    if given:
        return Path(given)
    home = os.environ.get("XDG_STATE_HOME")
    if home:
        return Path(home) / "vical"
    try:
        return Path.home() / ".local" / "state" / "vical"
    except RuntimeError:  # a user without HOME and without a passwd entry
        return runtime_directory() / "state"


def make_private(folder: Path) -> Path:
    """Create a folder that only this user (and group) may enter, and return it.

    Raises:
        PermissionError: It belongs to another user, who could place files there.
    """
    folder.mkdir(mode=0o750, parents=True, exist_ok=True)
    if folder.stat().st_uid not in (os.getuid(), 0):
        raise PermissionError(13, "belongs to another user; set VICAL_RUNTIME_DIR", str(folder))
    return folder


def _first(variable: str) -> str:
    """Return the first folder of a variable in which systemd separates folders with colons."""
    return os.environ.get(variable, "").split(":")[0]
