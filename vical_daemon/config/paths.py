"""Where the service keeps what: run time, state and logs; systemd says where, else the user's own folders."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

LOOPBACK_PORT = 7447
"""zenoh's usual port: of the loopback endpoint, where the config opens one without naming a port."""


def runtime_directory() -> Path:
    """Sockets and files that live until the next boot (`RUNTIME_DIRECTORY`, ``/run/vical`` as a service)."""
    given = os.environ.get("VICAL_RUNTIME_DIR") or _first("RUNTIME_DIRECTORY")
    if given:
        return Path(given)
    session = os.environ.get("XDG_RUNTIME_DIR")
    return Path(session) / "vical" if session else Path(tempfile.gettempdir()) / f"vical-{os.getuid()}"


def state_directory() -> Path:
    """What must survive: calibrations and recordings (`STATE_DIRECTORY`, ``/var/lib/vical`` as a service)."""
    given = os.environ.get("VICAL_STATE_DIR") or _first("STATE_DIRECTORY")
    if given:
        return Path(given)
    home = os.environ.get("XDG_STATE_HOME")
    if home:
        return Path(home) / "vical"
    try:
        return Path.home() / ".local" / "state" / "vical"
    except RuntimeError:  # a user without HOME and without an entry in the list of users
        return runtime_directory() / "state"


def make_private(folder: Path) -> Path:
    """Create a folder that only this user (and group) may enter, and return it.

    Raises:
        PermissionError: It exists and belongs to somebody else, who could put files there for us to read.
    """
    folder.mkdir(mode=0o750, parents=True, exist_ok=True)
    if folder.stat().st_uid not in (os.getuid(), 0):
        raise PermissionError(13, "belongs to another user; set VICAL_RUNTIME_DIR", str(folder))
    return folder


def _first(variable: str) -> str:
    """Systemd separates several folders with colons."""
    return os.environ.get(variable, "").split(":")[0]
