"""Messages on their way to the bus: key and payload."""

from __future__ import annotations

from collections.abc import Iterable

from vical_daemon.bus.interface import Bus

Message = tuple[str, bytes]


def publish(bus: Bus, messages: Iterable[Message]) -> None:
    """Put messages on the bus, in order."""
    for key, payload in messages:
        bus.publish(key, payload)
