"""Role estimate with `mode: verify`: checks the calibration in use, and rests in between.

A check listens to the IMU first, and asks for images only if the rig moves. Pauses keep the process below its
share of a core. The detector works while `VerifyResult.image_rate_hz` asks it to.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Container
from contextlib import suppress

import numpy as np

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, Sample
from vical_daemon.bus.messages import (
    CheckState,
    DiagnosticStatus,
    Level,
    MessageError,
    VerifyResult,
    decode_diagnostics,
    decode_string,
    encode_verification,
)
from vical_daemon.bus.outgoing import publish
from vical_daemon.bus.subscriber_queue import SubscriberQueue
from vical_daemon.calibrate.arrival_stamps import LiveStamps
from vical_daemon.calibrate.estimators import input_keys, status_keys
from vical_daemon.calibrate.in_use import DevicesUnknownError, InUse, NothingInUseError, calibration_in_use
from vical_daemon.calibrate.input_trouble import InputTrouble
from vical_daemon.calibrate.motion import LISTEN_S, Motion
from vical_daemon.calibrate.pause import Pause
from vical_daemon.calibrate.persistence import CalibrationPersistence
from vical_daemon.calibrate.publications import calibration_messages, companion_messages
from vical_daemon.calibrate.stretch import Stretch
from vical_daemon.calibrate.verification import Verification
from vical_daemon.calibrate.verify_words import age, line, status
from vical_daemon.calibrate.worker import STEP_STUCK_S
from vical_daemon.config.model import Config
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.results.change_odds import VISIBLE
from vical_daemon.results.verifier import Answer
from vical_daemon.service.health import StatusSender
from vical_daemon.service.wall_clock import WallClock

_log = logging.getLogger(__name__)
_TICK_S = 0.2
_PUBLISH_S = 1.0
_QUEUE_LIMIT = 20_000  # samples, as for calibrating
_FINE_S = 60.0
"""Calibrating goes on for this long after convergence at most, s, to get a result that can be verified."""


def run_verify(config: Config, bus: Bus, stop: threading.Event, clock: WallClock) -> None:
    """Verify until `stop`; see `role.run`."""
    service = _VerifyService(config, bus, stop, clock)
    try:
        service.loop()
    finally:
        service.close()


class _VerifyService:
    """The role as long as it runs."""

    def __init__(self, config: Config, bus: Bus, stop: threading.Event, clock: WallClock) -> None:
        self._config, self._bus, self._stop, self._clock = config, bus, stop, clock
        self._imu = f"imu/{config.calibration_imu}"
        self._cameras = [f"camera/{name}" for name in config.calibration_cameras]
        self._imu_key = topics.IMU.key(config.rig, config.calibration_imu)
        self._persistence = CalibrationPersistence(config, bus, clock)
        self._commands = bus.subscribe(topics.COMMAND.key(config.rig, "estimate"), depth=8)
        self._status = StatusSender(config.rig, "estimate", bus, clock)
        rates_hz = {name: config.cameras[name].rate_hz for name in config.calibration_cameras}
        self._trouble = InputTrouble(config.calibration_imu, rates_hz, always=False)
        self._devices = [bus.subscribe(key, depth=8) for key in status_keys(config.rig)]
        self._pause = Pause(config.verify.cpu_percent / 100.0)
        self._state, self._image_rate_hz = CheckState.RESTING, 0.0
        self._words: set[str] = set()
        self._stamps = LiveStamps()
        self._published_s = -np.inf
        self._unable = ""
        self._early = False  # devices are not there yet
        self._in_use: InUse | None = None
        self._verification: Verification | None = None
        self._persistence.priors()
        self._read_in_use()
        self._status.repeat_while_busy(STEP_STUCK_S)

    def loop(self) -> None:
        """Check, rest, calibrate when asked to, until the role is stopped."""
        while not self._stop.is_set():
            if self._calibration_wanted():
                self._calibrate()
            self._pause.begin()
            if self._verification is not None:
                self._stretch(self._verification)
            self._rest()

    def close(self) -> None:
        """Stop listening."""
        for subscription in (self._commands, *self._devices):
            subscription.close()
        self._persistence.close(None)
        self._set(CheckState.RESTING)
        self._status.finish(self._statuses)

    # -------------------------------------------------------------------------------------- what is checked
    def _read_in_use(self) -> None:
        try:
            self._in_use = calibration_in_use(self._config, self._persistence, self._clock.now_ns())
        except NothingInUseError as error:
            self._in_use, self._verification = None, None
            self._unable, self._early = str(error), isinstance(error, DevicesUnknownError)
            _log.warning("cannot verify: %s", error)
            return
        self._unable, self._early = "", False
        self._verification = Verification(self._config, self._in_use, self._stamps)
        self._state = CheckState.RESTING

    def _calibration_wanted(self) -> bool:
        asked = "calibrate" in self._words
        self._words.discard("calibrate")
        if self._persistence.replaced:
            self._persistence.begin_again()
            self._read_in_use()
        if self._early and self._persistence.devices:
            self._persistence.priors(wait_s=0.0)
            self._read_in_use()
        if self._early:
            return asked
        lost = self._verification is None or self._verification.verdict is Answer.CHANGED
        return asked or (self._config.verify.recalibrate and lost)

    # ------------------------------------------------------------------------------------------- one stretch
    def _stretch(self, verification: Verification) -> None:
        """Take data until there is an answer, the rig stands still, there are no points, or time is up."""
        motion = Motion(self._config.imus[self._config.calibration_imu].rate_hz)
        if not self._moves(motion):
            return
        free = self._config.calibration.mode == "target_free"
        rate_hz = self._config.calibration.detect_rate_hz
        self._set(CheckState.CHECKING, rate_hz if free else min(rate_hz, self._config.verify.image_rate_hz))
        queue = SubscriberQueue(self._bus, input_keys(self._config), _QUEUE_LIMIT)
        try:
            self._take(queue, verification, motion)
            self._set(CheckState.RESTING)
            verification.end_stretch()
        except Exception as error:  # an estimator should never raise on data; the next check may be fine
            text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            _log.exception("the check failed and starts over: %s", text)
            self._persistence.announce(
                Event(EventKind.ESTIMATOR_RESTARTED, said=f"the check failed and starts over: {text}")
            )
            verification.begin_check()
        finally:
            queue.close()
            self._set(CheckState.RESTING)

    def _moves(self, motion: Motion) -> bool:
        """Listen to the IMU for a second."""
        queue = SubscriberQueue(self._bus, [self._imu_key], _QUEUE_LIMIT)
        try:
            end_s = time.monotonic() + 2.0 * LISTEN_S
            while time.monotonic() < end_s and not motion.looked and not self._stop.is_set():
                self._tick(queue.wait(_TICK_S), listening=(self._imu,))
                for sample in queue.take(_QUEUE_LIMIT):
                    self._came(sample)
                    motion.take(sample, time.monotonic())
        finally:
            queue.close()
        return bool(np.isfinite(motion.moved_s))

    def _take(self, queue: SubscriberQueue, verification: Verification, motion: Motion) -> None:
        stretch = Stretch(self._imu_key, motion, time.monotonic(), verification.used_s)
        while not self._stop.is_set() and not self._interrupted:
            self._tick(queue.wait(_TICK_S), listening=(self._imu, *self._cameras))
            now_s = time.monotonic()
            for sample in queue.take(_QUEUE_LIMIT):
                self._came(sample)
                verification.take(sample)
                stretch.take(sample, now_s)
            if verification.step() or stretch.over(now_s, verification.used_s):
                return

    def _came(self, sample: Sample) -> None:
        """Note that a device delivers."""
        parsed = topics.parse_key(sample.key)
        if sample.key == self._imu_key:
            self._trouble.imu_came(new=True)
        elif parsed is not None and parsed.topic in (topics.POINTS, topics.TRACKS):
            self._trouble.image_came(parsed.name, new=True)

    @property
    def _interrupted(self) -> bool:
        return "calibrate" in self._words or self._persistence.replaced

    def _rest(self) -> None:
        self._set(CheckState.RESTING if self._verification is not None else CheckState.UNABLE)
        while not self._stop.wait(_TICK_S):
            self._tick()
            checks = self._verification
            hurry = "check" in self._words or (checks is not None and checks.suspected)
            self._words.discard("check")
            if self._interrupted:
                return
            if self._can_begin():
                return
            if checks is not None and (hurry or self._pause.over):
                return

    def _can_begin(self) -> bool:
        """Whether what nothing could be done without has come: devices, or leave to calibrate."""
        if self._early:
            return bool(self._persistence.devices)
        return self._verification is None and self._config.verify.recalibrate

    # ------------------------------------------------------------------------------------------ calibrating
    def _calibrate(self) -> None:
        """Calibrate until the result is good enough to be verified, and store it."""
        from vical_daemon.calibrate.role import calibrate

        _log.info("calibrating")
        self._status.pause()
        self._set(CheckState.CALIBRATING, self._config.calibration.detect_rate_hz)
        converged_s = np.inf

        def until(estimate: CalibrationEstimate | None, words: set[str]) -> bool:
            nonlocal converged_s
            self._publish(say=estimate)
            now_s = time.monotonic()
            if estimate is None or estimate.status is not Status.CONVERGED:
                converged_s = np.inf
                return "verify" in words
            converged_s = min(converged_s, now_s)
            return "verify" in words or _verifiable(self._config, estimate) or now_s - converged_s > _FINE_S

        calibrate(self._config, self._bus, self._stop, self._clock, until, stamps=self._stamps)
        self._pause.excuse()
        self._words.clear()
        self._persistence.priors(wait_s=0.0)
        self._read_in_use()

    # ------------------------------------------------------------------------------------------ what is said
    def _set(self, state: CheckState, image_rate_hz: float = 0.0) -> None:
        """Change what is done, and say so at once: the detector waits for it."""
        changed = (state, image_rate_hz) != (self._state, self._image_rate_hz)
        self._state, self._image_rate_hz = state, image_rate_hz
        if changed:
            self._publish(force=True)

    def _tick(self, _woken: bool = True, *, listening: Container[str] = ()) -> None:
        """Read commands and how devices are, and publish, once a second; `listening`: see `InputTrouble`."""
        for subscription in self._devices:
            while (sample := subscription.recv(0.0)) is not None:
                with suppress(MessageError):
                    self._trouble.take(decode_diagnostics(sample.payload))
        self._trouble.look(time.monotonic(), listening)
        while (sample := self._commands.recv(0.0)) is not None:
            with suppress(MessageError):  # not a command
                self._words.add(decode_string(sample.payload).strip())
        self._words &= {"calibrate", "check"}
        self._publish()
        self._status.tick(self._statuses)

    def _publish(self, say: CalibrationEstimate | None = None, *, force: bool = False) -> None:
        now_s = time.monotonic()
        if now_s - self._published_s < _PUBLISH_S and not force:
            return
        self._published_s = now_s
        for name in self._config.calibration_cameras:
            payload = encode_verification(self._result(name, say))
            self._bus.publish(topics.VERIFY.key(self._config.rig, name), payload)
        if self._in_use is not None and self._state is not CheckState.CALIBRATING:
            events = [] if self._verification is None else self._verification.events()
            estimate = self._persistence.said(self._in_use.estimate, events)
            each = {n: self._trouble.told(estimate, n) for n in self._config.calibration_cameras}
            publish(self._bus, calibration_messages(self._config, each))
            publish(self._bus, companion_messages(self._config, estimate))

    def _result(self, camera: str, say: CalibrationEstimate | None = None) -> VerifyResult:
        checks, now_ns = self._verification, self._clock.now_ns()
        source = self._in_use.source if self._in_use is not None else self._config.verify.against
        if self._state is CheckState.CALIBRATING:
            text = "calibrating" if say is None else f"calibrating: {say.status}, {say.progress:.0%}"
            return VerifyResult(
                now_ns, camera, self._state, against=source, text=text, image_rate_hz=self._image_rate_hz
            )
        lacking = self._trouble.of_camera(camera)
        if checks is None:
            text = "; ".join(filter(None, (lacking, self._unable)))
            return VerifyResult(now_ns, camera, CheckState.UNABLE, against=source, text=text)
        answer, text = checks.answers[camera], line(checks, camera, source, age(now_ns, checks.answered_ns))
        return VerifyResult(
            now_ns,
            camera,
            self._state,
            answer.verdict.replace(" ", "_"),
            checks.answered_ns,
            source,
            f"{lacking}; {text}" if lacking else text,
            checks.probability(camera),
            checks.used_s,
            checks.checks,
            answer.changes,
            () if lacking else checks.missing(camera),
            self._image_rate_hz,
        )

    def _statuses(self) -> list[DiagnosticStatus]:
        results = {name: self._result(name) for name in self._config.calibration_cameras}
        silent = self._trouble.silent
        counters = {"mode": "verify", "state": str(self._state)}
        if self._verification is not None:
            counters |= self._verification.role.statuses()[0].values
        counters["silent"] = ", ".join(silent)
        text = "; ".join(filter(None, (f"verify: {self._state}", self._trouble.words())))
        mine = DiagnosticStatus(Level.WARN if silent else Level.OK, "estimate", text, "", counters)
        lacks = {name: bool(self._trouble.of_camera(name)) for name in results}
        return [mine, *(status(name, result, lacks=lacks[name]) for name, result in results.items())]


def _verifiable(config: Config, estimate: CalibrationEstimate) -> bool:
    """Whether sigmas are so small that the smallest change that counts could be seen against them."""
    counts = config.verify.counts
    for camera in estimate.cameras.values():
        sigma = np.sqrt(np.maximum(np.diag(np.asarray(camera.T_imu_cam.covariance)), 0.0))
        of_counts = (
            sigma[:3].max() / counts.position_m,
            sigma[3:].max() / np.deg2rad(counts.rotation_deg),
            camera.timeshift_sigma_s / counts.timeshift_s,
            max(camera.intrinsics_sigma, default=0.0) / (counts.focal_share * camera.intrinsics[0]),
        )
        if max(of_counts) > 1.0 / VISIBLE:
            return False
    return True
