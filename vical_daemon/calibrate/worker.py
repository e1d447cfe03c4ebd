"""The estimate role without I/O: messages in, reordered by stamp; messages out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import (
    DiagnosticsMessage,
    DiagnosticStatus,
    ImplausibleError,
    ImuMessage,
    Level,
    MessageError,
    admit_imu,
    admit_points,
    admit_stamp_sigma_s,
    decode_diagnostics,
)
from vical_daemon.bus.outgoing import Message
from vical_daemon.calibrate.arrival_stamps import LiveStamps
from vical_daemon.calibrate.estimators import Estimator, status_keys
from vical_daemon.calibrate.input_trouble import InputTrouble
from vical_daemon.calibrate.predictions import Predictions
from vical_daemon.calibrate.publications import (
    calibration_messages,
    calibration_status,
    companion_messages,
)
from vical_daemon.calibrate.reorder_buffer import ReorderBuffer
from vical_daemon.calibrate.stamp_gate import StampGate
from vical_daemon.config.model import Config
from vical_daemon.estimation.events import Event
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.result import CalibrationEstimate

Keep = Callable[[Sequence[Any]], None]
Inspect = Callable[[CalibrationEstimate], CalibrationEstimate]
PUBLISH_S = 0.2
COMPANION_S = 1.0
STUCK_S = 10.0
"""The estimator is stuck if images arrive and none is used or rejected for this long, s. Images wait at most
2 s for inertial data; a start on a slow card took 3 s."""
STEP_STUCK_S = 60.0
"""No step takes so long: a start takes 0.3 to 2.4 s of CPU time on a current core, and a small computer is
four to five times slower and does other things as well."""


class EstimateRole:
    """Feeds an estimator with decoded messages in the order of their stamps. No I/O, no clock.

    Args:
        config: The rig.
        estimator: The estimator.
        period_s: Time between two publications.
        keep: Gets the report on every frame; None: they are dropped.
        inspect: Gets every estimate before it is published and may add to it.
        stamps: Of live cameras; None: recorded images come with the stamps to use.
    """

    def __init__(
        self,
        config: Config,
        estimator: Estimator,
        period_s: float = PUBLISH_S,
        *,
        keep: Keep | None = None,
        inspect: Inspect | None = None,
        stamps: LiveStamps | None = None,
    ) -> None:
        self.config, self.estimator = config, estimator
        self._stamps, self._imu_sigma_s = stamps, 0.0
        self._period_s, self._keep, self._inspect = period_s, keep, inspect
        self._predictions = Predictions(config.rig)
        self._imu_key = topics.IMU.key(config.rig, config.calibration_imu)
        self._status_keys = status_keys(config.rig)
        rates_hz = {name: config.cameras[name].rate_hz for name in config.calibration_cameras}
        self._trouble = InputTrouble(config.calibration_imu, rates_hz)
        self._order: ReorderBuffer[ImuMessage | PointsFrame] = ReorderBuffer(config.calibration.lag_s)
        self._gates: dict[str, StampGate[ImuMessage | PointsFrame]] = {}
        self._span_ns: tuple[int, int] | None = None  # first and last of all stamps that passed
        self._next_s = self._next_companion_s = -float("inf")
        self._malformed = self._implausible = 0
        self._images_in_order = 0
        self.images = 0
        self.latest: CalibrationEstimate | None = None

    def take(self, sample: Sample) -> None:
        """Take one message from the bus. Counts malformed and implausible messages."""
        try:
            if sample.key == self._imu_key:
                imu = admit_imu(sample.payload)
                self._sort_in(sample.key, imu.stamp_ns, imu)
            elif sample.key in self._status_keys:
                message = decode_diagnostics(sample.payload)
                self._trouble.take(message)
                self._stamps_known(message)
            else:
                self.images += 1
                frame = admit_points(sample.payload).to_frame()
                self._sort_in(sample.key, frame.t_cam_ns, frame)
        except ImplausibleError as error:
            self._implausible += 1
            if sample.key == self._imu_key:
                self._trouble.imu_refused(str(error))
        except MessageError:
            self._malformed += 1

    def _sort_in(self, key: str, stamp_ns: int, item: ImuMessage | PointsFrame) -> None:
        """Queue an item by stamp, once the stamps of its stream are continuous."""
        gate = self._gates.get(key)
        if gate is None:
            gate = self._gates[key] = StampGate()
        among_others = self._span_ns is not None and self._span_ns[0] <= stamp_ns <= self._span_ns[1]
        self._pass(gate.push(stamp_ns, item, among_others=among_others))

    def _pass(self, items: list[tuple[int, ImuMessage | PointsFrame]]) -> None:
        for stamp_ns, item in items:
            if self._stamps is None or not isinstance(item, PointsFrame):
                self._put(stamp_ns, item)
            else:
                self._put_all(self._stamps.push(item))

    def _put_all(self, frames: list[PointsFrame]) -> None:
        for frame in frames:
            self._put(frame.t_cam_ns, frame)

    def _put(self, stamp_ns: int, item: ImuMessage | PointsFrame) -> None:
        self._order.push(stamp_ns, item)
        self._images_in_order += isinstance(item, PointsFrame)
        first_ns, newest_ns = self._span_ns or (stamp_ns, stamp_ns)
        self._span_ns = min(first_ns, stamp_ns), max(newest_ns, stamp_ns)

    @property
    def settled(self) -> int:
        """Images so far (of `images`) that were used or rejected."""
        return self.images - self._images_in_order - self.estimator.waiting

    def _stamps_known(self, message: DiagnosticsMessage) -> None:
        """Pass on the uncertainty of stamps: of the IMU's by its driver, of images taken on arrival."""
        for status in message.statuses:
            if status.name == f"imu/{self.config.calibration_imu}" and "stamp_sigma_us" in status.values:
                self._imu_sigma_s = admit_stamp_sigma_s(status.values["stamp_sigma_us"])
                self._tell_sigma()

    def _tell_sigma(self) -> None:
        images_s = self._stamps.sigma_s if self._stamps is not None else 0.0
        self.estimator.stamps_known_to(math.hypot(self._imu_sigma_s, images_s))

    def news(self) -> list[Event]:
        """Return what was found of the stamps: the estimate up to now rests on others."""
        return [] if self._stamps is None else self._stamps.news()

    def step(self, now_s: float | None = None) -> list[Message]:
        """Process what was taken and return the messages to publish.

        Args:
            now_s: Any steady clock, for the 5 Hz; None: the time of the data (offline, repeatable).
        """
        self._feed(self._order.pop_due())
        if now_s is None:
            now_s = (self._order.newest_ns or 0) * 1e-9
        else:
            self._trouble.look(now_s)
            self.estimator.do_without(self._trouble.cameras)
        return self._publications(now_s)

    def finish(self) -> list[Message]:
        """Process the rest at the end of the data and return the last messages."""
        for gate in self._gates.values():
            self._pass(gate.flush())
        self._put_all(self._stamps.flush() if self._stamps is not None else [])
        self._feed(self._order.pop_all())
        self._report(self.estimator.finish())
        self._next_s = self._next_companion_s = -float("inf")
        return self._publications(0.0)

    def next_recording(self, *, common_clock: bool = True) -> None:
        """After `finish`: what comes now is another recording of the same rig; see `Calibrator`."""
        self._gates.clear()
        self.estimator.next_recording(common_clock=common_clock)

    def reset(self, estimator: Estimator) -> None:
        """Start again with a new estimator."""
        self._order.pop_all()
        self._images_in_order = 0
        self.estimator, self.latest = estimator, None
        self._tell_sigma()
        self._next_s = self._next_companion_s = -float("inf")

    def _feed(self, items: list[ImuMessage | PointsFrame]) -> None:
        readings, repeated = 0, self._repeated("imu")
        for item in items:
            if isinstance(item, ImuMessage):
                readings += 1
                self.estimator.add_imu(item.stamp_ns, item.gyro_rps, item.specific_force_mps2)
            else:
                self._images_in_order -= 1
                images_repeated = self._repeated("images")
                self.estimator.add_points(item)
                self._trouble.image_came(item.camera, new=self._repeated("images") == images_repeated)
                self._report(self.estimator.process())
        if readings:
            self._trouble.imu_came(readings, new=self._repeated("imu") < repeated + readings)

    def _repeated(self, what: str) -> int:
        """Readings (``imu``) or ``images`` so far that were the one before once more."""
        return self.estimator.left_out.get(f"{what}_repeated", 0)

    def _report(self, frames: Sequence[Any]) -> None:
        self._predictions.take(frames if self._stamps is None else self._stamps.as_they_came(frames))
        if self._keep is not None:
            self._keep(frames)

    def _publications(self, now_s: float) -> list[Message]:
        if now_s < self._next_s:
            return []
        self._next_s = now_s + self._period_s
        estimate = self.estimator.estimate()
        estimate = replace(estimate, events=self._trouble.causes(estimate.events))
        self.latest = estimate = self._inspect(estimate) if self._inspect else estimate
        told = {name: self._trouble.told(estimate, name) for name in self.config.calibration_cameras}
        messages = calibration_messages(self.config, told) + self._predictions.messages()
        if now_s >= self._next_companion_s:
            self._next_companion_s = now_s + COMPANION_S
            messages += companion_messages(self.config, estimate)
        return messages

    def statuses(self, dropped: int = 0, stuck_s: float = 0.0) -> list[DiagnosticStatus]:
        """Return the health of the estimator.

        Args:
            dropped: Samples lost before this role.
            stuck_s: How long images have arrived without one being used or rejected (see `Progress`).
        """
        counters = {
            "queue_depth": str(len(self._order)),
            "dropped": str(dropped),
            "late": str(self._order.late),
            "images_received": str(self.images),
            "images_waiting": str(self.images - self.settled),
            "malformed": str(self._malformed),
            "implausible": str(self._implausible),
            "stamps_refused": str(sum(gate.refused for gate in self._gates.values())),
            "stamp_jumps": str(sum(gate.jumps for gate in self._gates.values())),
            **{name: str(count) for name, count in self.estimator.left_out.items()},
        }
        status = calibration_status(self.latest, counters | {"silent": ", ".join(self._trouble.silent)})
        if self._trouble.silent:
            text = f"{status.message}; {self._trouble.words()}"
            status = replace(status, level=max(status.level, Level.WARN), message=text)
        if stuck_s > STUCK_S:
            text = f"stuck: images arrive, none used or refused for {stuck_s:.0f} s"
            status = replace(status, level=Level.STALE, message=text)
        return [status]
