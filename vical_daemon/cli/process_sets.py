"""The table of roles and of the processes they run in, and roles as threads of one process."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

from vical_daemon.bus.interface import Bus
from vical_daemon.cli.errors import EXIT_USAGE, CliError, describe_known
from vical_daemon.cli.options import suggest
from vical_daemon.config.model import Config

_log = logging.getLogger(__name__)

PROCESSES: dict[str, tuple[str, ...]] = {
    "acquire": ("imu", "camera"),
    "record": ("record",),
    "calibrate": ("detect", "estimate"),
    "web": ("web",),
}
"""Process (`vical run NAME`, unit `vical-NAME.service`) -> its roles."""
ROLE_MODULES = {
    "imu": "vical_daemon.acquire.imu",
    "camera": "vical_daemon.acquire.camera",
    "record": "vical_daemon.record.role",
    "detect": "vical_daemon.detect.role",
    "estimate": "vical_daemon.calibrate.role",
    "web": "vical_daemon.web.role",
}
"""Role -> the module whose `run` it is; imported when the role starts."""


def role_names(words: Sequence[str]) -> list[str]:
    """Turn process and role names, as typed, into roles in the order of the table.

    Raises:
        CliError: A name that is neither.
    """
    roles = [role for names in PROCESSES.values() for role in names]
    wanted: set[str] = set()
    for word in words:
        if word in PROCESSES:
            wanted.update(PROCESSES[word])
        elif word in roles:
            wanted.add(word)
        else:
            known = [*PROCESSES, *roles]
            hint = suggest(word, known) or f" (known: {', '.join(dict.fromkeys(known))})"
            raise CliError(f"{word!r} is neither a process nor a role{hint}", EXIT_USAGE)
    return [role for role in roles if role in wanted]


def needed_processes(config: Config) -> list[str]:
    """Return the processes that a config asks for."""
    needed = ["acquire", "record"]
    if config.cameras and config.imus:
        needed.append("calibrate")
    if config.web.enabled:
        needed.append("web")
    return needed


_importing = threading.Lock()
"""One role at a time: two threads that each import what the other is importing end in a deadlock error."""
STOP_S = 10.0
PATIENCE_S: dict[str, float] = {"estimate": 30.0}
"""How long a role may take to stop: the estimator ends the step it is in, which a busy machine stretches."""


class RoleThreads:
    """Roles running as threads of this process, on one bus.

    A role that dies of a programming error is not started again here: `failed` is set, and whoever runs
    the process ends it, so that systemd (or the parent) starts it afresh.

    Args:
        config: The rig.
        bus: What they talk through.
    """

    def __init__(self, config: Config, bus: Bus) -> None:
        self._config, self._bus = config, bus
        self._threads: dict[str, threading.Thread] = {}
        self._stops: dict[str, threading.Event] = {}
        self.failed = threading.Event()
        self.errors: dict[str, Exception] = {}

    def start(self, role: str, options: Mapping[str, Any] | None = None) -> None:
        """Start a role; `options` are further arguments of its `run`."""
        stop = self._stops[role] = threading.Event()

        def guarded() -> None:
            try:
                with _importing:
                    run = import_module(ROLE_MODULES[role]).run  # loads scipy, OpenCV: for a minute
                run(self._config, self._bus, stop, **(options or {}))
            except Exception as error:
                self.errors[role] = error
                self.failed.set()
                if describe_known(error) is None:  # a bug; a known error is reported in one line
                    _log.exception("role %s failed", role)

        thread = self._threads[role] = threading.Thread(target=guarded, name=f"role {role}", daemon=True)
        thread.start()

    def stop(self, role: str, timeout_s: float | None = None) -> bool:
        """End a role; False if it does not end in time (None: as long as such a role may take)."""
        self._stops[role].set()
        self._threads[role].join(PATIENCE_S.get(role, STOP_S) if timeout_s is None else timeout_s)
        stuck = self._threads[role].is_alive()
        if stuck:
            _log.error("role %s does not stop", role)
        return not stuck

    def stop_all(self) -> bool:
        """End all roles, the last started first: consumers are started first and see the last data."""
        ended = [self.stop(role) for role in reversed(list(self._threads))]
        return all(ended)

    def raise_failure(self) -> None:
        """Raise what a role died of, if one did."""
        for error in self.errors.values():
            raise error
