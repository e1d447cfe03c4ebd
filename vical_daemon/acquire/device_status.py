"""The status of one device: level, one line for a person, and every counter."""

from __future__ import annotations

from vical_daemon.acquire.device_loop import DeviceHealth
from vical_daemon.acquire.direct_queue import DirectQueue
from vical_daemon.acquire.publish_queue import PublishQueue
from vical_daemon.bus.messages import DiagnosticStatus, Level

STUCK_S = 5.0
"""A device loop that has not turned for this long, s, is stuck: STALE, and systemd restarts the process."""
_RECENT_S = 10.0
"""Samples dropped so recently, s, are a problem of now: the status comes once a second."""
_BEGINNING = {"opening": "opening", "silent": "open, no data yet"}
"""States without a problem so far, in words."""


def device_status(
    name: str,
    health: DeviceHealth,
    queue: PublishQueue | DirectQueue,
    nominal_rate_hz: float,
    extra: dict[str, str] | None = None,
) -> DiagnosticStatus:
    """Return the status of one device: level, one line for a person, and every counter."""
    stats, info = health.stats, health.info
    level, message = _level(health, queue, nominal_rate_hz)
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
        "queue_depth": str(queue.waiting),
        "queue_dropped": str(queue.dropped),
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


def _level(
    health: DeviceHealth, queue: PublishQueue | DirectQueue, nominal_rate_hz: float
) -> tuple[Level, str]:
    if health.loop_age_s > STUCK_S:
        return Level.STALE, f"its thread is stuck for {health.loop_age_s:.0f} s"
    if health.state == "ended":
        return Level.WARN, health.problem
    if health.state != "streaming":
        first = health.openings <= 1 and not health.problem  # opened again, it has been silent for long
        text = health.problem or _BEGINNING.get(health.state, health.state)
        return Level.WARN if first and health.state in _BEGINNING else Level.ERROR, text
    if health.data_age_s > max(2.0, 5 / nominal_rate_hz):
        return Level.ERROR, f"no data for {health.data_age_s:.1f} s"
    if queue.drop_age_s < _RECENT_S:
        rate = f"{health.stats.rate_hz:.1f} Hz; " if health.stats.rate_hz else ""
        return Level.WARN, f"{rate}{queue.dropped} samples dropped since the start: the bus is too slow"
    if health.stats.rate_hz and abs(health.stats.rate_hz / nominal_rate_hz - 1) > 0.1:
        return Level.WARN, f"{health.stats.rate_hz:.1f} Hz instead of {nominal_rate_hz:g} Hz"
    before = f"; {queue.dropped} samples dropped before by a slow bus" if queue.dropped else ""
    return Level.OK, f"{health.stats.rate_hz:.1f} Hz, {health.stats.lost} lost{before}"
