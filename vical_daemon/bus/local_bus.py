"""Connects to the bus of this computer as a client."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vical_daemon.bus.socket_paths import (
    Reach,
    local_sockets,
    loopback_answers,
    reach,
    why_closed,
)
from vical_daemon.bus.zenoh_bus import BusError, ZenohBus, open_bus
from vical_daemon.config.paths import LOOPBACK_PORT


def open_local_bus(
    sockets: Sequence[Path] = (), tcp_port: int = LOOPBACK_PORT, **credentials: Any
) -> ZenohBus:
    """Connect to the bus of this computer: over a unix socket, else over loopback TCP if the rig opens it.

    Args:
        sockets: Sockets to try, in order; empty: this user's own, then the service's.
        tcp_port: Loopback port to try afterwards; 0: none.
        **credentials: As in `zenoh_bus.open_bus`.

    Raises:
        BusError: There is no bus here, or not for this user; the message says what to do.
    """
    sockets = sockets or local_sockets()
    closed = []
    for path in sockets:
        found = reach(path)
        if found is Reach.OPEN:
            return open_bus(mode="client", socket=path, **credentials)
        if found is Reach.CLOSED:
            closed.append(path)
    if tcp_port and loopback_answers(tcp_port):
        return open_bus(mode="client", tcp_port=tcp_port, **credentials)
    if closed:
        raise BusError(why_closed(closed[0]))
    tried = [str(path) for path in sockets] + ([f"tcp/127.0.0.1:{tcp_port}"] if tcp_port else [])
    raise BusError(
        f"no bus at {', '.join(tried)}: nothing answers; start `vical run -c FILE` (or vical.target) there"
    )
