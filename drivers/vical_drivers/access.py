"""What a user can do about a device file that this process may not open."""

from __future__ import annotations

import grp
from pathlib import Path


def how_to_open(path: str | Path, group_if_unknown: str = "?") -> str:
    """Say who may use a device file and what to type.

    Args:
        path: The device file.
        group_if_unknown: Where the system has no name for its group (in a container).
    """
    try:
        gid = Path(path).stat().st_gid
        group = grp.getgrgid(gid).gr_name
    except (OSError, KeyError):
        gid, group = -1, group_if_unknown
    if gid == 0 or group == "?":  # nobody should join group root
        return (
            "only root may use it; `sudo vical install-service` installs udev rules, "
            f"or until the next boot: sudo chmod a+rw {path}"
        )
    return f"it belongs to group {group}: sudo usermod -aG {group} $USER, then log in again"
