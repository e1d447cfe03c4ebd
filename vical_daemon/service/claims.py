"""Which process does which job for which device: two that publish on one key would contradict each other."""

from __future__ import annotations

import fcntl
import logging
import os
import re
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from vical_drivers.closing import Closing

from vical_daemon.config.model import Config

_log = logging.getLogger(__name__)
_POLL_S = 0.1


def job_name(config: Config, role: str, device: str) -> str:
    """Name what a role does for a device on a rig's bus, e.g. ``rover.estimate.cam0``; fit for a file."""
    bus = "" if config.bus.socket is None else re.sub(r"\W+", ".", config.bus.socket)  # may share a folder
    return f"{config.rig}.{role}.{device}{bus}"


class ClaimedError(Exception):
    """Another process holds a claim; the message is its name."""


class Claims(Closing):
    """Locks on names, e.g. ``rover.estimate.cam0``. They live in the kernel: they go with the process.

    Args:
        folder: The runtime directory, which all processes of a bus share.
        names: What this process alone will do.
        wait_s: How long an earlier process may take to end, s.
        stop: Ends the wait.

    Raises:
        ClaimedError: Another process still holds one of them.
        OSError: The folder cannot be written.
    """

    def __init__(self, folder: Path, names: Iterable[str], wait_s: float, stop: threading.Event) -> None:
        self._held: list[int] = []
        end_s = time.monotonic() + wait_s
        try:
            for name in names:
                path = folder / f"{name}.claim"  # for reading: root may have made it
                self._held.append(os.open(path, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, 0o644))
                free = _lock(self._held[-1])
                if not free:
                    _log.warning("%s: another process does this; waiting %.0f s for it to end", name, wait_s)
                while not free:
                    if time.monotonic() > end_s or stop.wait(_POLL_S):
                        raise ClaimedError(name)
                    free = _lock(self._held[-1])
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let another process have them."""
        held, self._held = self._held, []
        for descriptor in held:
            os.close(descriptor)


def _lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
