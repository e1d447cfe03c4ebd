"""Role estimate: inertial samples and points in, by stamp behind a short lag; calibration out at 5 Hz."""

from __future__ import annotations

import logging
import threading
import time
from contextlib import suppress

from vical_daemon import topics
from vical_daemon.bus import Bus, Subscription
from vical_daemon.checkpoint import Checkpoint
from vical_daemon.config import Config
from vical_daemon.estimate_role import PUBLISH_S, EstimateRole
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.result import Status
from vical_daemon.estimation.wording import event_text
from vical_daemon.estimators import Estimator, input_keys, make_estimator, make_watch
from vical_daemon.health import StatusSender
from vical_daemon.inbox import Inbox
from vical_daemon.memory import Memory
from vical_daemon.messages import MessageError, decode_string
from vical_daemon.places import make_private, runtime_directory
from vical_daemon.publications import publish
from vical_daemon.wall_clock import WallClock, shared_clock

__all__ = ["EstimateRole", "run"]

_log = logging.getLogger(__name__)
INBOX = 20_000  # 20 s at 1000 Hz: what arrives while the estimator starts


def run(config: Config, bus: Bus, stop: threading.Event, *, clock: WallClock | None = None) -> None:
    """Calibrate what arrives on the bus until `stop`.

    Args:
        config: The rig.
        bus: Where samples come from and estimates go.
        stop: Ends the role.
        clock: Monotonic to UNIX time; None: the one that all processes of the service share.
    """
    folder = make_private(runtime_directory()) if clock is None else None
    clock = clock or shared_clock(make_private(runtime_directory()))
    inbox = Inbox(bus, input_keys(config), INBOX)
    memory = Memory(config, bus, clock)
    priors = memory.priors()
    checkpoint = Checkpoint(folder, config, clock)
    estimator = _resumed(checkpoint, memory) or _started(config, priors, memory)
    role = EstimateRole(config, estimator, inspect=memory.watch, watch=make_watch(config))
    commands = bus.subscribe(topics.COMMAND.key(config.rig, "estimate"), depth=8)
    status = StatusSender(config.rig, "estimate", bus, clock)
    while not stop.is_set():
        inbox.wait(PUBLISH_S / 2)
        if _reset_wanted(commands):
            _log.info("calibration reset by command")
            checkpoint.forget()
            role.reset(make_estimator(config, priors), make_watch(config))
        if memory.replaced:
            checkpoint.forget()
            priors = memory.begin_again()
            role.reset(_started(config, priors, memory), make_watch(config))
        while True:  # a bounded number at a time, so that publications stay on time when data pile up
            for sample in inbox.take(256):
                role.take(sample)
            publish(bus, role.step(time.monotonic()))
            status.tick(lambda: role.statuses(inbox.dropped))
            if role.latest is not None and role.latest.status is Status.CONVERGED:
                checkpoint.save(role.estimator, memory.devices)
            if not len(inbox) or stop.is_set():
                break
    checkpoint.forget()  # who stops the service may touch the rig
    commands.close()
    inbox.close()
    if role.latest is not None and role.latest.cameras:
        publish(bus, role.finish())  # without a solution it would try once more to find one, for seconds
    memory.close(role.latest)
    status.tick(lambda: role.statuses(inbox.dropped), force=True)


def _resumed(checkpoint: Checkpoint, memory: Memory) -> Estimator | None:
    """Return the estimator of a process that ended without being asked to; None: there was none."""
    found = checkpoint.load(memory.devices)
    if found is None:
        return None
    estimator, age_s = found
    event = Event(EventKind.RESUMED, value=age_s)
    _log.info("%s", event_text(event))
    memory.announce(event)
    return estimator


def _started(config: Config, priors: dict[str, CameraPrior], memory: Memory) -> Estimator:
    """Return an estimator that knows no more than config and store."""
    for name in memory.stored:
        _log.info("%s: starting from the calibration stored for these devices", name)
    return make_estimator(config, priors)


def _reset_wanted(commands: Subscription) -> bool:
    """Read the commands that have come; other words than ``reset`` are not for us."""
    wanted = False
    while (sample := commands.recv(0.0)) is not None:
        with suppress(MessageError):  # of somebody else, and no command
            wanted |= decode_string(sample.payload).strip() == "reset"
    return wanted
