"""Role record: writes all messages into MCAP segments."""

from __future__ import annotations

import threading
from pathlib import Path

from vical_daemon.bus.interface import Bus, Sample
from vical_daemon.bus.topics import TOPICS, rig_expression
from vical_daemon.config.model import Config
from vical_daemon.config.paths import state_directory
from vical_daemon.logs.mcap import LogFolder
from vical_daemon.record.queue import RecordQueue, arrival
from vical_daemon.record.recorder import Recorder
from vical_daemon.service.health import StatusSender
from vical_daemon.service.wall_clock import WallClock, service_clock

_PERIOD_S = 0.1
_STUCK_S = 120.0
"""A disk may hold up a write for so long before the process is restarted, which costs what waits in memory:
Linux calls a task that waits longer hung (hung_task_timeout_secs)."""


def run(config: Config, bus: Bus, stop: threading.Event, *, clock: WallClock | None = None) -> None:
    """Record what arrives on the bus until `stop`.

    The bus thread only stamps and queues; this thread writes, flushes, rotates and obeys commands.

    Args:
        config: The rig.
        bus: Where messages come from.
        stop: Ends the role; messages that have arrived are still written.
        clock: Monotonic to UNIX time; None: the clock that all processes of the service share.
    """
    clock = clock or service_clock()
    path = Path(config.record.directory) if config.record.directory else state_directory() / "log"
    folder = LogFolder(path, quota_bytes=config.record.quota_bytes, reserve_bytes=config.record.reserve_bytes)
    recorder, queue = Recorder(config, folder, clock), RecordQueue()
    status = StatusSender(config.rig, "record", bus, clock)
    status.repeat_while_busy(_STUCK_S, lambda busy_s: [recorder.held_up(queue, busy_s)])

    def take(sample: Sample) -> None:
        item = arrival(sample, clock)
        if item is not None and recorder.wants(item.topic):
            queue.put(item)

    subscription = bus.subscribe(rig_expression(config.rig), take)
    known = {topic.key(config.rig, "x").replace("/x", "/*") for topic in TOPICS if topic.keep_last}
    for expression in sorted(known):  # last values from before this role started
        for sample in bus.latest(expression, 0.5):
            take(sample)
    recorder.tick()
    while not stop.is_set():
        for item in queue.take(_PERIOD_S):
            recorder.write(item)
        recorder.tick()
        status.tick(lambda: [recorder.status(queue, subscription.dropped)])
    subscription.close()
    for item in queue.take(0):
        recorder.write(item)
    recorder.close()
    status.finish(lambda: [recorder.status(queue, subscription.dropped)])
