"""Publishes the status of a role once a second, from its own loop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus
from vical_daemon.bus.messages import DiagnosticStatus, Level, encode_diagnostics
from vical_daemon.service.wall_clock import WallClock

STATUS_PERIOD_S = 1.0


class StatusSender:
    """Publishes the status of one role, at most once a second.

    Args:
        rig: Name of the rig.
        role: Name of the role, becomes the last part of the key.
        bus: Where the status goes.
        clock: Source of the stamps; every status includes its offset.
    """

    def __init__(self, rig: str, role: str, bus: Bus, clock: WallClock) -> None:
        self._key = topics.STATUS.key(rig, role)
        self._role, self._bus, self._clock = role, bus, clock
        self._next_s = 0.0

    def tick(self, statuses: Callable[[], list[DiagnosticStatus]], *, force: bool = False) -> None:
        """Publish if a second has passed; call it from the role's own loop."""
        now_s = time.monotonic()
        if now_s < self._next_s and not force:
            return
        self._next_s = now_s + STATUS_PERIOD_S
        clock = DiagnosticStatus(Level.OK, "clock", values=self._clock.status_values())
        payload = encode_diagnostics(self._clock.now_ns(), self._role, [*statuses(), clock])
        self._bus.publish(self._key, payload)

    def run_until(
        self,
        stop: threading.Event,
        statuses: Callable[[], list[DiagnosticStatus]],
        openings: Callable[[], int] = lambda: 0,
    ) -> None:
        """Publish once a second until `stop`, for a role whose work is done by device threads.

        Args:
            stop: Ends it.
            statuses: Makes what is published.
            openings: How often devices were opened. A change is published at once, as the device may be new.
        """
        opened = 0
        while not stop.is_set():
            before, opened = opened, openings()
            self.tick(statuses, force=opened != before)
            stop.wait(STATUS_PERIOD_S / 10)
