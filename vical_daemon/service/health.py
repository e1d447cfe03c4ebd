"""Publishes the status of a role once a second, from its own loop."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus
from vical_daemon.bus.messages import DiagnosticStatus, Level, encode_diagnostics
from vical_daemon.service import notify
from vical_daemon.service.wall_clock import WallClock

STATUS_PERIOD_S = 1.0
CLOCK_STEP_S = 0.1
"""A step of the system clock that is announced, s. ntpd corrects less than 0.128 s without a step."""
_log = logging.getLogger(__name__)


_DAY_S = 86_400.0
Meanwhile = Callable[[float], list[DiagnosticStatus]]


class _ClockSteps:
    """Announces steps of the system clock, once in a process whatever the number of its roles."""

    def __init__(self) -> None:
        self._lock, self._announced_s = threading.Lock(), 0.0

    def take(self, step_s: float) -> None:
        """Take by how much the system clock is ahead of the clock of all stamps, s."""
        with self._lock:
            if abs(step_s - self._announced_s) < CLOCK_STEP_S:
                return
            self._announced_s = step_s
        if abs(step_s) < CLOCK_STEP_S:
            text = "the system clock was set back: it agrees with vical's stamps again"
        else:
            side = "ahead of" if step_s > 0 else "behind"
            size = f"{abs(step_s):.1f} s" if abs(step_s) < _DAY_S else f"{abs(step_s) / _DAY_S:.0f} days"
            text = (
                f"the system clock was set: it is {size} {side} vical's stamps, "
                "which keep the old time until the next boot"
            )
        _log.warning("%s", text)
        notify.event("clock_set", text, level="warning", step_s=step_s)


_clock_steps = _ClockSteps()
_ANNOUNCE = ("imu", "camera")  # roles that stamp; one process of the service runs both


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
        self._last: list[DiagnosticStatus] = []
        self._ticked_s = 0.0
        self._finished = threading.Event()

    def tick(self, statuses: Callable[[], list[DiagnosticStatus]], *, force: bool = False) -> None:
        """Publish if a second has passed; call it from the role's own loop."""
        now_s = self._ticked_s = time.monotonic()
        if now_s < self._next_s and not force:
            return
        self._next_s = now_s + STATUS_PERIOD_S
        self._last = statuses()
        self._publish(self._last)

    def _publish(self, statuses: list[DiagnosticStatus]) -> None:
        clock = DiagnosticStatus(Level.OK, "clock", values=self._clock.status_values())
        if self._role in _ANNOUNCE:
            _clock_steps.take(1e-9 * self._clock.step_ns())
        self._bus.publish(self._key, encode_diagnostics(self._clock.now_ns(), self._role, [*statuses, clock]))

    def finish(self, statuses: Callable[[], list[DiagnosticStatus]]) -> None:
        """Publish once more; nothing is repeated from then on."""
        self._finished.set()
        self.tick(statuses, force=True)

    def repeat_while_busy(self, stuck_s: float, meanwhile: Meanwhile | None = None) -> None:
        """Publish a status, in a thread, while a turn of the role's loop takes over a second.

        A start takes seconds on a small computer, and a slow disk may hold up a write: the role is alive.

        Args:
            stuck_s: A turn longer than this is reported as stuck, s.
            meanwhile: Makes the status from how long the turn has taken, s; None: the last one again.
        """
        name, args = f"status/{self._role}", (stuck_s, meanwhile)
        threading.Thread(target=self._repeat, args=args, name=name, daemon=True).start()

    def pause(self) -> None:
        """Repeat nothing until the next `tick`: somebody else reports for the role."""
        self._last = []

    def _repeat(self, stuck_s: float, meanwhile: Meanwhile | None) -> None:
        while not self._finished.wait(STATUS_PERIOD_S):
            busy_s, last = time.monotonic() - self._ticked_s, self._last
            if not last or busy_s < STATUS_PERIOD_S:
                continue
            first, *others = last if meanwhile is None else meanwhile(busy_s)
            if busy_s > stuck_s:
                first = replace(first, level=Level.STALE, message=f"stuck: at one step for {busy_s:.0f} s")
            self._publish([first, *others])

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
        opened, turn_s = 0, time.monotonic()
        while not stop.is_set():
            if time.monotonic() - turn_s > STATUS_PERIOD_S:
                # The whole process was held up (SIGSTOP, a paused virtual machine): the device threads, which
                # may have had no turn yet, are not stuck.
                stop.wait(STATUS_PERIOD_S / 2)
            turn_s = time.monotonic()
            before, opened = opened, openings()
            self.tick(statuses, force=opened != before)
            stop.wait(STATUS_PERIOD_S / 10)
