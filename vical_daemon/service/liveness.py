"""Liveness of this process, from the status messages that its roles publish in their own loops.

It feeds the watchdog of systemd, which restarts the process if a role stops publishing or reports a stuck
thread. An unplugged device is *not* a reason: a restart would not plug it in, and would interrupt the others.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import DiagnosticsMessage, Level, MessageError, decode_diagnostics

FRESH_S = 5.0
START_S = 300.0
"""Longest time to the first status of a role; a slow card needed 60 s to load scipy and OpenCV."""


class Liveness:
    """Watches the status messages of some roles.

    Args:
        roles: The roles of this process.
        begin_s: When the roles were started, by the clock of `now_s`.
    """

    def __init__(self, roles: Sequence[str], begin_s: float) -> None:
        self._roles, self._begin_s = tuple(roles), begin_s
        self._seen: dict[str, tuple[float, DiagnosticsMessage]] = {}
        self._lock = threading.Lock()

    def take(self, sample: Sample, now_s: float) -> None:
        """Take a status message; others are ignored."""
        try:
            message = decode_diagnostics(sample.payload)
        except MessageError:
            return
        if message.frame_id in self._roles:
            with self._lock:
                self._seen[message.frame_id] = (now_s, message)

    def ready(self) -> bool:
        """Whether every role has published a status."""
        with self._lock:
            return len(self._seen) == len(self._roles)

    def problem(self, now_s: float) -> str:
        """Return why the process is not alive; "" if it is."""
        with self._lock:
            seen = dict(self._seen)
        for role in self._roles:
            if role not in seen:
                if now_s - self._begin_s > START_S:
                    return f"{role} has not started within {START_S:.0f} s"
                continue
            at_s, message = seen[role]
            if now_s - at_s > FRESH_S:
                return f"{role} has been silent for {now_s - at_s:.0f} s"
            for status in message.statuses:
                if status.level is Level.STALE:
                    return f"{status.name}: {status.message}"
        return ""

    def summary(self) -> str:
        """Return one line for `systemctl status`: each component with its message, the worst first."""
        with self._lock:
            messages = [message for _, message in self._seen.values()]
            missing = [role for role in self._roles if role not in self._seen]
        statuses = [s for message in messages for s in message.statuses if s.name != "clock"]
        statuses.sort(key=lambda status: -int(status.level))
        texts = [f"{s.name}: {s.message}" if s.message else s.name for s in statuses]
        return "; ".join(([f"starting: {', '.join(missing)}"] if missing else []) + texts)[:500]
