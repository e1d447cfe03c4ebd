"""How a role tells that it is well: a status once a second, from its own loop and its own counters."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from vical_daemon import topics
from vical_daemon.bus import Bus
from vical_daemon.device_loop import DeviceHealth
from vical_daemon.direct_outbox import DirectOutbox
from vical_daemon.messages import DiagnosticStatus, Level, encode_diagnostics
from vical_daemon.outbox import Outbox
from vical_daemon.wall_clock import WallClock

STATUS_PERIOD_S = 1.0
STUCK_S = 5.0
"""A thread that has not gone round for so long is stuck: its component is STALE and the watchdog bites."""


class StatusSender:
    """Publishes the status of one role, at most once a second.

    Args:
        rig: Name of the rig.
        role: Name of the role, becomes the last part of the key.
        bus: Where to.
        clock: Stamps, and the clock pair in every status.
    """

    def __init__(self, rig: str, role: str, bus: Bus, clock: WallClock) -> None:
        self._key = topics.STATUS.key(rig, role)
        self._role, self._bus, self._clock = role, bus, clock
        self._next_s = 0.0

    def tick(self, statuses: Callable[[], list[DiagnosticStatus]], *, force: bool = False) -> None:
        """Publish if a second has gone by; call it from the role's own loop."""
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
            openings: How often devices were opened: it may be another device now, which is told at once.
        """
        opened = 0
        while not stop.is_set():
            before, opened = opened, openings()
            self.tick(statuses, force=opened != before)
            stop.wait(STATUS_PERIOD_S / 10)


def device_status(
    name: str,
    health: DeviceHealth,
    outbox: Outbox | DirectOutbox,
    nominal_rate_hz: float,
    extra: dict[str, str] | None = None,
) -> DiagnosticStatus:
    """Return the status of one device: level, one line for a person, and every counter."""
    stats, info = health.stats, health.info
    level, message = _judge(health, outbox, nominal_rate_hz)
    values = {
        "state": health.state,
        "samples": str(stats.samples),
        "lost": str(stats.lost),
        "rate_hz": f"{stats.rate_hz:.3f}",
        "clock_skew_ppm": f"{stats.clock_skew_ppm:.2f}",
        "checksum_errors": str(stats.checksum_errors),
        "resync_bytes": str(stats.resync_bytes),
        "reconnects": str(stats.reconnects),
        "openings": str(health.openings),
        "data_age_s": f"{health.data_age_s:.3f}",
        "queue_depth": str(outbox.waiting),
        "queue_dropped": str(outbox.dropped),
    }
    if stats.jitter_us is not None:
        values["jitter_us"] = f"{stats.jitter_us:.1f}"
    if info is not None:
        values |= {
            "model": info.model,
            "firmware": info.firmware,
            "path": info.path,
            "protocol": info.protocol,
        }
    values |= {key: f"{value:g}" for key, value in stats.extra.items()} | (extra or {})
    return DiagnosticStatus(level, name, message, info.serial_number if info else "", values)


def _judge(health: DeviceHealth, outbox: Outbox | DirectOutbox, nominal_rate_hz: float) -> tuple[Level, str]:
    if health.loop_age_s > STUCK_S:
        return Level.STALE, f"its thread is stuck for {health.loop_age_s:.0f} s"
    if health.state != "streaming":
        return Level.ERROR, health.problem or health.state
    if health.data_age_s > max(2.0, 5 / nominal_rate_hz):
        return Level.ERROR, f"no data for {health.data_age_s:.1f} s"
    if outbox.dropped:
        return Level.WARN, f"{outbox.dropped} samples dropped: the bus is too slow"
    if health.stats.rate_hz and abs(health.stats.rate_hz / nominal_rate_hz - 1) > 0.1:
        return Level.WARN, f"{health.stats.rate_hz:.1f} Hz instead of {nominal_rate_hz:g} Hz"
    return Level.OK, f"{health.stats.rate_hz:.1f} Hz, {health.stats.lost} lost"
