"""Role estimate: inertial samples and points in, by stamp behind a short lag; calibration out at 5 Hz."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, Sample, Subscription
from vical_daemon.bus.messages import DiagnosticStatus, Level, MessageError, decode_string
from vical_daemon.bus.outgoing import Message, publish
from vical_daemon.bus.subscriber_queue import SubscriberQueue
from vical_daemon.calibrate.checkpoint import Checkpoint
from vical_daemon.calibrate.estimators import Estimator, input_keys, make_estimator, make_watch
from vical_daemon.calibrate.persistence import CalibrationPersistence
from vical_daemon.calibrate.worker import PUBLISH_S, STUCK_S, EstimateRole
from vical_daemon.config.model import Config
from vical_daemon.config.paths import make_private, runtime_directory
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.result import Status
from vical_daemon.estimation.wording import event_text
from vical_daemon.service.health import StatusSender
from vical_daemon.service.progress import Progress, Restarts
from vical_daemon.service.wall_clock import WallClock, service_clock

__all__ = ["EstimateRole", "run"]

_log = logging.getLogger(__name__)
QUEUE_LIMIT = 20_000  # 20 s at 1000 Hz: what arrives while the estimator starts
_WELL_S = 1.0  # images wait that long now and then
_OURS = "vical_daemon/"  # in the path of our code


def run(config: Config, bus: Bus, stop: threading.Event, *, clock: WallClock | None = None) -> None:
    """Calibrate what arrives on the bus until `stop`.

    Args:
        config: The rig.
        bus: Where samples come from and estimates go.
        stop: Ends the role.
        clock: Monotonic to UNIX time; None: the one that all processes of the service share.
    """
    folder = make_private(runtime_directory()) if clock is None else None
    clock = clock or service_clock()
    queue = SubscriberQueue(bus, input_keys(config), QUEUE_LIMIT)
    persistence = CalibrationPersistence(config, bus, clock)
    priors = persistence.priors()
    checkpoint = Checkpoint(folder, config, clock)
    estimator = _resumed(checkpoint, persistence) or _new_estimator(config, priors, persistence)
    role = EstimateRole(config, estimator, inspect=persistence.watch, watch=make_watch(config))
    supervisor = _Supervisor(config, role, persistence, checkpoint)
    commands = bus.subscribe(topics.COMMAND.key(config.rig, "estimate"), depth=8)
    status = StatusSender(config.rig, "estimate", bus, clock)
    while not stop.is_set():
        queue.wait(PUBLISH_S / 2)
        if _reset_wanted(commands):
            _log.info("calibration reset by command")
            checkpoint.forget()
            role.reset(make_estimator(config, priors), make_watch(config))
        if persistence.replaced:
            checkpoint.forget()
            priors = persistence.begin_again()
            role.reset(_new_estimator(config, priors, persistence), make_watch(config))
        while True:  # a bounded number at a time, so that publications stay on time when data pile up
            publish(bus, supervisor.work(queue.take(256), time.monotonic()))
            status.tick(lambda: supervisor.statuses(queue.dropped, time.monotonic()))
            if role.latest is not None and role.latest.status is Status.CONVERGED and supervisor.well:
                checkpoint.save(role.estimator, persistence.devices)
            if not len(queue) or stop.is_set():
                break
    checkpoint.forget()  # who stops the service may touch the rig
    commands.close()
    queue.close()
    if role.latest is not None and role.latest.cameras:
        publish(
            bus, supervisor.finish()
        )  # without a solution it would try once more to find one, for seconds
    persistence.close(role.latest)
    status.tick(lambda: supervisor.statuses(queue.dropped, time.monotonic()), force=True)


class _Supervisor:
    """Gives the role its work, and a fresh estimator where one fails or no longer gets anywhere.

    An estimator never raises on data. Where it does so nevertheless, the messages to come are good ones: it
    starts again from what is stored for the devices, later and later if that does not help.
    """

    def __init__(
        self, config: Config, role: EstimateRole, persistence: CalibrationPersistence, checkpoint: Checkpoint
    ) -> None:
        self._config, self._role, self._persistence, self._checkpoint = config, role, persistence, checkpoint
        self._progress, self._restarts = Progress(), Restarts()
        self._stuck_s = 0.0
        self._given_up = 0  # messages while it waits for its next start

    @property
    def well(self) -> bool:
        """Whether what arrives is being worked on."""
        return self._stuck_s < _WELL_S

    def work(self, samples: Iterable[Sample], now_s: float) -> list[Message]:
        """Take what has arrived; what is to be published."""
        if self._restarts.waiting_s(now_s) > 0.0:
            self._given_up += sum(1 for _ in samples)
            return []
        try:
            for sample in samples:
                self._role.take(sample)
            messages = self._role.step(now_s)
        except Exception as error:
            self._failed(_describe(error))
            return []
        self._stuck_s = self._progress.look(self._role.images, self._role.settled, now_s)
        if self._stuck_s > 1.5 * STUCK_S:  # the status has reported it by then
            self._failed(f"images arrived and none was used or refused for {self._stuck_s:.0f} s")
        return messages

    def finish(self) -> list[Message]:
        """End of the data; the last word."""
        try:
            return self._role.finish()
        except Exception as error:
            _log.error("the estimator failed at the end: %s", _describe(error))
            return []

    def _failed(self, why: str) -> None:
        self._stuck_s = 0.0
        self._checkpoint.forget()
        priors = self._persistence.priors(wait_s=0.0)
        self._role.reset(make_estimator(self._config, priors), make_watch(self._config))
        pause_s = self._restarts.failed(why, time.monotonic())
        text = f"the estimator failed and starts again{f' in {pause_s:.0f} s' if pause_s else ''}: {why}"
        _log.error("%s", text)
        self._persistence.announce(Event(EventKind.ESTIMATOR_RESTARTED, said=text))

    def statuses(self, dropped: int, now_s: float) -> list[DiagnosticStatus]:
        """Return the health of the estimator."""
        first, *others = self._role.statuses(dropped + self._given_up, self._stuck_s)
        values = {**first.values, "estimator_restarts": str(self._restarts.count)}
        wait_s = self._restarts.waiting_s(now_s)
        if wait_s > 0.0:
            text = f"the estimator failed {self._restarts.count} times, starts again in {wait_s:.0f} s: "
            first = replace(first, level=Level.ERROR, message=text + self._restarts.why)
        return [replace(first, values=values), *others]


def _describe(error: Exception) -> str:
    """One line on an exception: what, and where in our code."""
    _log.debug("the estimator raised", exc_info=error)
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if _OURS in frame.filename] or frames
    where = f" ({Path(ours[-1].filename).name}, line {ours[-1].lineno})" if ours else ""
    return " ".join(f"{type(error).__name__}: {error}".split())[:200] + where


def _resumed(checkpoint: Checkpoint, persistence: CalibrationPersistence) -> Estimator | None:
    """Return the estimator of a process that ended without being asked to; None: there was none."""
    found = checkpoint.load(persistence.devices)
    if found is None:
        return None
    estimator, age_s = found
    event = Event(EventKind.RESUMED, value=age_s)
    _log.info("%s", event_text(event))
    persistence.announce(event)
    return estimator


def _new_estimator(
    config: Config, priors: dict[str, CameraPrior], persistence: CalibrationPersistence
) -> Estimator:
    """Return an estimator that knows no more than config and store."""
    for name in persistence.stored:
        _log.info("%s: starting from the calibration stored for these devices", name)
    return make_estimator(config, priors)


def _reset_wanted(commands: Subscription) -> bool:
    """Read the commands that have come; other words than ``reset`` are not for us."""
    wanted = False
    while (sample := commands.recv(0.0)) is not None:
        with suppress(MessageError):  # of somebody else, and no command
            wanted |= decode_string(sample.payload).strip() == "reset"
    return wanted
