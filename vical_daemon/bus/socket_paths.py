"""The unix sockets of the bus on this computer, and who may use them. Does not need zenoh."""

from __future__ import annotations

import grp
import os
import pwd
import socket
import stat
from enum import Enum
from pathlib import Path

from vical_daemon.config.paths import chosen_runtime_directory, runtime_directory

SERVICE_SOCKET = Path("/run/vical/zenoh.sock")
PATH_BYTES = 107
"""Longest path of a unix socket (unix(7): 108 with the zero at its end)."""
_TRY_S = 0.5


class Reach(Enum):
    """Result of connecting to a socket."""

    OPEN = "a router answers"
    SILENT = "no answer"
    CLOSED = "not for this user"


def own_socket() -> Path:
    """Return the socket of this user's router; for the service, of the service's router."""
    return runtime_directory() / "zenoh.sock"


def local_sockets() -> list[Path]:
    """Return where a bus may be on this computer, this user's own first.

    A runtime folder that the environment names is the only one: a command must not reach another rig. Any
    other is skipped if another user owns it: anyone can create one below /tmp.
    """
    own = own_socket()
    if chosen_runtime_directory() is not None:
        return [own]
    try:
        ours = own.parent.stat().st_uid in (os.getuid(), 0)
    except OSError:
        ours = False
    return [own, SERVICE_SOCKET] if ours and own != SERVICE_SOCKET else [SERVICE_SOCKET]


def reach(path: Path) -> Reach:
    """Try to connect to a unix socket."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(_TRY_S)
        try:
            probe.connect(str(path))
        except PermissionError:
            return Reach.CLOSED
        except OSError:
            return Reach.SILENT
    return Reach.OPEN


def loopback_answers(port: int) -> bool:
    """Return whether a process accepts connections on a port of 127.0.0.1."""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=_TRY_S):
            return True
    except OSError:
        return False


def why_closed(path: Path) -> str:
    """Return one line: who owns the socket, and what the user can do."""
    for part in (*reversed(path.absolute().parents), path):
        try:
            found = part.stat()
        except OSError:
            break
        if os.access(part, os.W_OK if part == path else os.X_OK):
            continue
        for_group = stat.S_IWGRP if part == path else stat.S_IXGRP
        if not found.st_mode & for_group or found.st_gid == 0:
            return f"the bus at {path} belongs to user {_user(found.st_uid)}, who alone may use it"
        group, members = _group(found.st_gid)
        if _user(os.getuid()) in members:
            return (
                f"the bus at {path} belongs to group {group}, which you joined after this login: log in again"
            )
        return (
            f"the bus at {path} belongs to group {group}; try: sudo usermod -aG {group} $USER, "
            "then log in again (or bus.readers: loopback in its config)"
        )
    return f"the bus at {path} is not for this user; see its folder's owner and mode"


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def _group(number: int) -> tuple[str, list[str]]:
    try:
        entry = grp.getgrgid(number)
    except KeyError:
        return str(number), []
    return entry.gr_name, entry.gr_mem
