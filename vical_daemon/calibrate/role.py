"""Role estimate: takes inertial samples and points, publishes the calibration at 5 Hz."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, Sample, Subscription
from vical_daemon.bus.messages import DiagnosticStatus, Level, MessageError, decode_string
from vical_daemon.bus.outgoing import Message, publish
from vical_daemon.bus.subscriber_queue import SubscriberQueue
from vical_daemon.calibrate.arrival_stamps import LiveStamps
from vical_daemon.calibrate.checkpoint import Checkpoint
from vical_daemon.calibrate.estimators import Estimator, input_keys, make_estimator
from vical_daemon.calibrate.persistence import CalibrationPersistence
from vical_daemon.calibrate.worker import PUBLISH_S, STEP_STUCK_S, STUCK_S, EstimateRole
from vical_daemon.config.model import Config
from vical_daemon.config.paths import make_private, runtime_directory
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.estimation.wording import event_text
from vical_daemon.service.health import StatusSender
from vical_daemon.service.progress import Progress, Restarts
from vical_daemon.service.wall_clock import WallClock, service_clock

__all__ = ["EstimateRole", "run"]

Until = Callable[[CalibrationEstimate | None, set[str]], bool]
_log = logging.getLogger(__name__)
QUEUE_LIMIT = 20_000  # samples: 20 s at 1000 Hz, which may arrive while the estimator starts
_BACKLOG_S = 1.0  # images sometimes wait this long
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
    if config.mode == "verify":
        from vical_daemon.calibrate.verify_role import run_verify

        run_verify(config, bus, stop, clock)
    else:
        calibrate(config, bus, stop, clock, folder=folder)


def calibrate(
    config: Config,
    bus: Bus,
    stop: threading.Event,
    clock: WallClock,
    until: Until | None = None,
    folder: Path | None = None,
    stamps: LiveStamps | None = None,
) -> None:
    """Calibrate until `stop`, or until `until` says that it is enough.

    Args:
        config: The rig.
        bus: Where samples come from and estimates go.
        stop: Ends it.
        clock: Monotonic to UNIX time.
        until: Gets the last estimate and the commands that came since; True: enough.
        folder: Where the running estimator is saved; None: nowhere.
        stamps: Those of the cameras, as known from earlier data.
    """
    queue = SubscriberQueue(bus, input_keys(config), QUEUE_LIMIT)
    persistence = CalibrationPersistence(config, bus, clock)
    priors = persistence.priors()
    checkpoint = Checkpoint(folder, config, clock)
    role, stamps = _begin(config, persistence, checkpoint, priors, stamps)
    supervisor = _Supervisor(config, role, persistence, checkpoint)
    publish(bus, persistence.stored_messages())
    commands = bus.subscribe(topics.COMMAND.key(config.rig, "estimate"), depth=8)
    status = StatusSender(config.rig, "estimate", bus, clock)
    status.repeat_while_busy(STEP_STUCK_S)
    while not stop.is_set():
        queue.wait(PUBLISH_S / 2)
        words = _commands(commands)
        if "accept" in words and persistence.accept(role.latest):
            publish(bus, persistence.stored_messages())
        discarded = persistence.discard(role.latest) if "discard" in words else None
        if discarded is not None or "reset" in words:
            _log.info("starting over by command")
            priors = discarded or priors
            supervisor.start_over(make_estimator(config, priors))
        if persistence.replaced:
            priors = persistence.begin_again()
            supervisor.start_over(_new_estimator(config, priors, persistence))
            publish(bus, persistence.stored_messages())
        while True:  # in batches, so that a backlog does not delay publications
            publish(bus, supervisor.work(queue.take(256), time.monotonic()))
            status.tick(lambda: supervisor.statuses(queue.dropped, time.monotonic()))
            if role.latest is not None and role.latest.status is Status.CONVERGED and supervisor.keeps_up:
                checkpoint.save(role.estimator, persistence.devices, stamps)
            if not len(queue) or stop.is_set():
                break
        if until is not None and until(role.latest, words):
            break
    checkpoint.forget()  # after a stop the rig may be touched
    commands.close()
    queue.close()
    if role.latest is not None and role.latest.cameras:
        publish(bus, supervisor.finish())  # without a solution it would search for one again, for seconds
    persistence.close(role.latest)
    status.finish(lambda: supervisor.statuses(queue.dropped, time.monotonic()))


class _Supervisor:
    """Runs the role, and restarts its estimator if it fails or is stuck.

    An estimator should never raise on data. If it does, the next messages may be fine: it restarts from the
    stored calibration, with growing pauses after repeated failures.
    """

    def __init__(
        self, config: Config, role: EstimateRole, persistence: CalibrationPersistence, checkpoint: Checkpoint
    ) -> None:
        self._config, self._role, self._persistence, self._checkpoint = config, role, persistence, checkpoint
        self._progress, self._restarts = Progress(), Restarts()
        self._stuck_s = 0.0
        self._discarded = 0  # messages during the pause before a restart

    @property
    def keeps_up(self) -> bool:
        """Whether the estimator keeps up with its input."""
        return self._stuck_s < _BACKLOG_S

    def work(self, samples: Iterable[Sample], now_s: float) -> list[Message]:
        """Process samples and return the messages to publish."""
        if self._restarts.waiting_s(now_s) > 0.0:
            self._discarded += sum(1 for _ in samples)
            return []
        stored = self._look_up()
        try:
            for sample in samples:
                self._role.take(sample)
            messages = self._role.step(now_s)
        except Exception as error:
            self._failed(_describe(error))
            return stored
        for event in self._role.news():
            self._persistence.announce(event)
            self.start_over()
        self._stuck_s = self._progress.look(self._role.images, self._role.settled, now_s)
        if self._stuck_s > 1.5 * STUCK_S:  # the status has reported it by then
            self._failed(f"images arrived and none was used or refused for {self._stuck_s:.0f} s")
        return stored + messages

    def _look_up(self) -> list[Message]:
        """Look for what is stored for devices that were opened after this role began; return it if it is new.

        The estimator starts again from it, if it has found nothing yet.
        """
        if not self._persistence.look_up():
            return []
        if self._role.latest is None or not self._role.latest.cameras:
            self.start_over()
        return self._persistence.stored_messages()

    def finish(self) -> list[Message]:
        """Process the rest of the data and return the last messages."""
        try:
            return self._role.finish()
        except Exception as error:
            _log.error("the estimator failed at the end: %s", _describe(error))
            return []

    def start_over(self, estimator: Estimator | None = None) -> None:
        """Go on with another estimator; None: a new one, from the stored calibration."""
        self._stuck_s = 0.0
        self._checkpoint.forget()
        if estimator is None:
            priors = self._persistence.priors(wait_s=0.0)
            estimator = _new_estimator(self._config, priors, self._persistence)
        self._role.reset(estimator)

    def _failed(self, why: str) -> None:
        self.start_over()
        pause_s = self._restarts.failed(why, time.monotonic())
        text = f"the estimator failed and starts again{f' in {pause_s:.0f} s' if pause_s else ''}: {why}"
        _log.error("%s", text)
        self._persistence.announce(Event(EventKind.ESTIMATOR_RESTARTED, said=text))

    def statuses(self, dropped: int, now_s: float) -> list[DiagnosticStatus]:
        """Return the health of the estimator."""
        first, *others = self._role.statuses(dropped + self._discarded, self._stuck_s)
        values = {**first.values, "estimator_restarts": str(self._restarts.count)}
        wait_s = self._restarts.waiting_s(now_s)
        if wait_s > 0.0:
            text = f"the estimator failed {self._restarts.count} times, starts again in {wait_s:.0f} s: "
            first = replace(first, level=Level.ERROR, message=text + self._restarts.why)
        elif self._persistence.problem:
            level = max(first.level, Level.WARN)
            first = replace(
                first, level=level, message=f"{first.message}; not stored: {self._persistence.problem}"
            )
        return [replace(first, values=values), *others]


def _describe(error: Exception) -> str:
    """Return one line on an exception: what, and where in our code."""
    _log.debug("the estimator raised", exc_info=error)
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if _OURS in frame.filename] or frames
    where = f" ({Path(ours[-1].filename).name}, line {ours[-1].lineno})" if ours else ""
    return " ".join(f"{type(error).__name__}: {error}".split())[:200] + where


def _begin(
    config: Config,
    persistence: CalibrationPersistence,
    checkpoint: Checkpoint,
    priors: dict[str, CameraPrior],
    stamps: LiveStamps | None,
) -> tuple[EstimateRole, LiveStamps]:
    """Return the role and its stamps: as a process saved them that crashed or was killed, or new ones."""
    kept = checkpoint.load(persistence.devices)
    if kept is not None:
        event = Event(EventKind.RESUMED, value=kept.age_s)
        _log.info("%s", event_text(event))
        persistence.announce(event)
    estimator = kept.estimator if kept else _new_estimator(config, priors, persistence)
    stamps = stamps or LiveStamps(kept.image_stamps_ns if kept else None)
    return EstimateRole(config, estimator, inspect=persistence.watch, stamps=stamps), stamps


def _new_estimator(
    config: Config, priors: dict[str, CameraPrior], persistence: CalibrationPersistence
) -> Estimator:
    """Return an estimator that starts from config and store."""
    for name in persistence.stored:
        _log.info("%s: starting from the calibration stored for these devices", name)
    return make_estimator(config, priors)


def _commands(commands: Subscription) -> set[str]:
    """Return the commands that have arrived: ``accept``, ``discard`` and ``reset`` mean something here."""
    words = set()
    while (sample := commands.recv(0.0)) is not None:
        with suppress(MessageError):  # not a command
            words.add(decode_string(sample.payload).strip())
    return words
