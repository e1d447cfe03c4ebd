"""A recording back on the bus, with the time between stamps that there was."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from vical_daemon.bus.interface import Bus
from vical_daemon.bus.topics import STATUS, check_name
from vical_daemon.logs import Recording
from vical_daemon.logs.channel import stamp_of

_PROGRESS_S = 1.0


def replay(
    recording: Recording,
    bus: Bus,
    stop: threading.Event,
    *,
    speed: float = 1.0,
    rig: str | None = None,
    everything: bool = False,
    progress: Callable[[float], None] | None = None,
) -> dict[str, float]:
    """Publish a recording; stamps stay as recorded. What the imu's driver said of its stamps comes with them.

    Args:
        recording: What to publish.
        bus: Where to.
        stop: Ends it early.
        speed: Times real time; 0: as fast as it goes.
        rig: Name of the rig in the keys; None: as recorded.
        everything: Every stream, not only the best one of each camera.
        progress: Called about once a second with the seconds of the recording that are played.

    Returns:
        ``messages``, ``duration_s`` and ``late_ms``, by how much the latest message came late.
    """
    prefix = f"vical/{check_name(rig)}/" if rig else ""
    begin_s, count, late_s, shown_s = time.monotonic(), 0, 0.0, 0.0
    first_ns = recording.begin_ns
    streams, also = recording.streams if everything else None, [STATUS.key(recording.rig, "imu")]
    for key, payload in recording.messages(streams, also):
        data_s = ((stamp_of(payload) or first_ns) - first_ns) * 1e-9
        wait_s = begin_s + data_s / speed - time.monotonic() if speed else 0.0
        if wait_s > 0:
            stop.wait(wait_s)
        elif speed:
            late_s = max(late_s, -wait_s)
        if stop.is_set():
            break
        bus.publish(prefix + key.split("/", 2)[2] if prefix else key, payload)
        count += 1
        now_s = time.monotonic()
        if progress is not None and now_s - shown_s >= _PROGRESS_S:
            shown_s = now_s
            progress(data_s)
    return {"messages": count, "duration_s": time.monotonic() - begin_s, "late_ms": late_s * 1e3}
