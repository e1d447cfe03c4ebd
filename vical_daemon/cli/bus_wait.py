"""Waiting for a bus that nobody hosts yet, in commands that a person leaves running."""

from __future__ import annotations

import sys
import threading
import time

from vical_daemon.bus.interface import Bus
from vical_daemon.bus.zenoh_bus import BusError
from vical_daemon.cli import bus_access

_RETRY_S = 0.5
_NOBODY = "nothing answers"  # of `zenoh_session`: all other refusals will not change by waiting


def wait_for_bus(
    config_path: str | None, endpoint: str | None, *, end_s: float, stop: threading.Event, quiet: bool = False
) -> Bus | None:
    """Open the bus as `open_client` does; where nothing answers, say so once and try until something does.

    Args:
        config_path: See `open_client`.
        endpoint: See `open_client`.
        end_s: When to give up, CLOCK_MONOTONIC; infinity: never.
        stop: Ends the waiting (None is returned).
        quiet: Say nothing.

    Raises:
        BusError: Nobody came, or the bus cannot be used for another reason.
    """
    reported = False
    while not stop.is_set():
        try:
            return bus_access.open_client(config_path, endpoint)
        except BusError as error:
            if _NOBODY not in str(error) or time.monotonic() >= end_s:
                raise
            if not reported and not quiet:
                print(f"vical: waiting: {error}", file=sys.stderr)
            reported = True
        stop.wait(min(_RETRY_S, max(0.0, end_s - time.monotonic())))
    return None
