"""Stores calibrations by the serial numbers of the devices, and announces changes since the stored one.

Serial numbers come from the status of the acquiring roles, so the estimator needs no access to devices. An
estimate belongs to the devices that were present when the estimator started. After one of them is replaced,
nothing is saved until `begin_again`. Otherwise the calibration would be stored under the wrong device.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, Sample
from vical_daemon.bus.messages import MessageError, decode_diagnostics, encode_calibration
from vical_daemon.bus.outgoing import Message
from vical_daemon.config.model import Config
from vical_daemon.config.paths import state_directory
from vical_daemon.config.priors import camera_prior
from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.estimation.status.mounting_changes import differences
from vical_daemon.estimation.wording import event_text
from vical_daemon.results.store import CalibrationStore, StoredCalibration, StoreError
from vical_daemon.service import notify
from vical_daemon.service.device_serials import DeviceSerials
from vical_daemon.service.wall_clock import WallClock

_log = logging.getLogger(__name__)
SAVE_EVERY_S = 60.0
SERIALS_WITHIN_S = 3.0
_PATIENCE_S = 1.0
"""Data may wait so long for the disk, s: a sound one takes 20 ms, and a stalled one up to 20 s."""

_LOGGED = {EventKind.RESUMED, EventKind.DEVICE_REPLACED, EventKind.ESTIMATOR_RESTARTED}
"""Kinds that are in the log already, by whoever announces them."""
_JOURNAL_NAMES = {
    EventKind.DEVICE_REPLACED: "calibration_restarted",
    EventKind.ESTIMATOR_RESTARTED: "estimator_restarted",
    EventKind.STORED_HOLDS: "holds",
}


class CalibrationPersistence:
    """The store as one running estimator uses it.

    Args:
        config: The rig.
        bus: Source of the device status.
        clock: Date of the stored calibrations.
    """

    def __init__(self, config: Config, bus: Bus, clock: WallClock) -> None:
        folder = Path(config.store.directory) if config.store.directory else state_directory() / "calibration"
        self._config, self._bus, self._clock = config, bus, clock
        self._store = CalibrationStore(folder)
        self._serials = DeviceSerials()
        self._complete = threading.Event()
        self._before: dict[str, StoredCalibration] = {}
        self._compared: set[str] = set()
        self._looked_up: set[str] = set()  # cameras for which a stored calibration was looked for
        self._saved_s = -float("inf")
        self._saving: threading.Thread | None = None
        self.problem = ""  # why the last result could not be stored
        self._status: Status | None = None
        self._announced: list[Event] = []
        self._twins: set[str] = set()  # serial numbers that several cameras have, and that was said
        pattern = topics.STATUS.pattern
        self._keys = [pattern.format(rig=config.rig, name=role) for role in ("imu", "camera")]
        self._subscriptions = [bus.subscribe(key, self._listen) for key in self._keys]

    def priors(self, wait_s: float = SERIALS_WITHIN_S) -> dict[str, CameraPrior]:
        """Return the prior of each camera: the stored calibration of these devices, else the config.

        Fixed parameters keep the values of the config, and so does a lens whose images have another size now.

        Args:
            wait_s: How long to wait for the serial numbers.
        """
        for key in self._keys:
            for sample in self._bus.latest(key):
                self._listen(sample)
        self._complete.wait(wait_s)
        self._looked_up.clear()
        found = self.look_up()
        return {name: self._prior(name, known=name in found) for name in self._config.calibration_cameras}

    def look_up(self) -> list[str]:
        """Look once for a stored calibration of each camera whose serial numbers are known by now.

        A device may be opened long after the estimator started.

        Returns:
            Cameras for which one was found in this call; it is in `before` from now on.
        """
        found = []
        for name in self._config.calibration_cameras:
            if name in self._looked_up or not all(self._pair(name)):
                continue
            self._looked_up.add(name)
            stored = self._load(name)
            if stored is None:
                continue
            was, now = stored.known.distortion_model, camera_prior(self._config, name).distortion_model
            if was == now:
                self._before[name] = stored
                found.append(name)
            else:
                _log.warning("%s: the stored calibration is %s, the config says %s: not used", name, was, now)
        return found

    def _prior(self, name: str, *, known: bool) -> CameraPrior:
        given = camera_prior(self._config, name)
        if not known:
            return given
        stored = self._before[name]
        given_parts = set(self._config.calibration.fix)
        if stored.resized(given):
            given_parts.add("intrinsics")
            was, now = ("{} x {}".format(*size) for size in (stored.known.resolution, given.resolution))
            _log.warning("%s: the stored lens is for images of %s px, not %s: not used", name, was, now)
        return _merge(given, stored.prior(given.resolution), given_parts)

    @property
    def replaced(self) -> bool:
        """Whether a device of this calibration was replaced since the estimator started."""
        return bool(self._serials.replaced)

    def begin_again(self) -> dict[str, CameraPrior]:
        """Switch to the devices that are present now; return the prior of each camera."""
        for line in self._serials.adopt():
            said = f"{line}: the calibration starts over"
            _log.warning("%s", said)
            self.announce(Event(EventKind.DEVICE_REPLACED, said=said))
        self._before.clear()
        self._compared.clear()
        self._status, self._saved_s = None, -float("inf")
        return self.priors()

    @property
    def stored(self) -> list[str]:
        """Cameras with a stored calibration for these devices."""
        return list(self._before)

    @property
    def before(self) -> dict[str, StoredCalibration]:
        """What was stored for these devices at the last call of `priors`, by camera."""
        return dict(self._before)

    @property
    def devices(self) -> dict[str, str]:
        """Serial numbers of the devices by component; empty while one of them is uncertain."""
        names = self._components()
        known = {name: serial for name, serial in self._serials.known.items() if name in names}
        return known if len(known) == len(names) and not self._serials.in_doubt else {}

    def _components(self) -> list[str]:
        cameras = [f"camera/{name}" for name in self._config.calibration_cameras]
        return [f"imu/{self._config.calibration_imu}", *cameras]

    def announce(self, event: Event) -> None:
        """Write an event to the journal now, and add it to the next estimate."""
        self._journal(event)
        self._announced.append(event)

    def said(self, estimate: CalibrationEstimate, events: list[Event]) -> CalibrationEstimate:
        """Write events to the journal; return the estimate with them and those announced."""
        self._announce_twins()
        for event in events:
            self._journal(event)
        events = [*self._announced, *events]
        self._announced.clear()
        return replace(estimate, events=events)

    def watch(self, estimate: CalibrationEstimate) -> CalibrationEstimate:
        """Save an estimate that converged, and announce what changed since the stored calibration.

        Returns:
            The estimate, with the events added.
        """
        events = list(estimate.events)
        if estimate.status is Status.CONVERGED:
            self.look_up()  # before it is replaced
            events += self._changes(estimate)
            if self._status is not Status.CONVERGED:
                notify.event("converged", f"{self._config.rig}: calibration converged", rig=self._config.rig)
            idle = self._saving is None or not self._saving.is_alive()
            if idle and time.monotonic() - self._saved_s > SAVE_EVERY_S:
                self._begin_saving(estimate)
                self._wait(_PATIENCE_S)
        self._announce_twins()
        for event in events:
            self._journal(event)
        self._status = estimate.status
        events = [*self._announced, *events]
        self._announced.clear()
        return replace(estimate, events=events) if events != estimate.events else estimate

    def _journal(self, event: Event) -> None:
        fields: dict[str, str | float] = {"kind": str(event.kind)}
        fields |= {"camera": event.camera} if event.camera else {}
        fields |= {"value": event.value} if event.value is not None else {}
        fields |= {"sigma": event.sigma} if event.sigma is not None else {}
        name = "bumped" if event.changed else _JOURNAL_NAMES.get(event.kind, "calibration")
        level = "notice" if event.kind is EventKind.STORED_HOLDS else "warning"
        text = event_text(event)
        notify.event(name, text, level=level, rig=self._config.rig, **fields)
        if event.kind not in _LOGGED and "JOURNAL_STREAM" not in os.environ:
            number = logging.INFO if level == "notice" else logging.WARNING
            _log.log(number, "%s", text)  # a terminal does not show the journal

    def save(self, estimate: CalibrationEstimate | None) -> None:
        """Store an estimate if it has converged."""
        self._wait()
        if estimate is not None and estimate.status is Status.CONVERGED:
            self._begin_saving(estimate)
            self._wait()

    def _begin_saving(self, estimate: CalibrationEstimate) -> None:
        """Store an estimate in a thread, unless it belongs to other devices: a disk may take seconds."""
        if self._serials.in_doubt:
            return
        self._saved_s = time.monotonic()
        pairs = {name: self._pair(name) for name in estimate.cameras}
        args = (estimate, {name: pair for name, pair in pairs.items() if all(pair)}, self._clock.now_ns())
        self._saving = threading.Thread(target=self._write, args=args, name="store", daemon=True)
        self._saving.start()

    def _write(
        self, estimate: CalibrationEstimate, pairs: Mapping[str, tuple[str, str]], now_ns: int
    ) -> None:
        problem = ""
        for name, (imu, camera) in pairs.items():
            try:
                self._store.save(imu, camera, name, estimate, now_ns)
            except StoreError as error:
                problem = str(error)
        if problem and problem != self.problem:
            _log.warning("%s", problem)
        self.problem = problem

    def _wait(self, most_s: float | None = None) -> None:
        """Wait until nothing is being stored, or for some seconds."""
        if self._saving is not None:
            self._saving.join(most_s)

    def accept(self, estimate: CalibrationEstimate | None) -> bool:
        """Store an estimate because a person said so, even if it has not converged; announce the outcome.

        A result with withheld directions is refused: its numbers would be taken for known.

        Returns:
            Whether it was stored.
        """
        self._wait()
        why = self._unacceptable(estimate)
        if not why:
            assert estimate is not None
            try:
                for name in estimate.cameras:
                    self._store.save(*self._pair(name), name, estimate, self._clock.now_ns())
            except StoreError as error:
                why = str(error)
        if why:
            self.announce(Event(EventKind.OTHER, said=f"not accepted: {why}"))
            return False
        for name in self._config.calibration_cameras:
            stored = self._load(name)
            if stored is not None:
                self._before[name] = stored
        self._saved_s, self.problem = time.monotonic(), ""
        self.announce(Event(EventKind.OTHER, said="accepted: stored as the calibration of these devices"))
        return True

    def _unacceptable(self, estimate: CalibrationEstimate | None) -> str:
        if estimate is None or not estimate.cameras:
            return "there is no result yet"
        if estimate.status is Status.INCONSISTENT:
            return f"the data contradict each other: {estimate.reason}"
        withheld = [line for camera in estimate.cameras.values() for line in camera.unobservable]
        if withheld:
            return f"the motion did not show {'; '.join(withheld)}"
        if self._serials.in_doubt or not all(all(self._pair(name)) for name in estimate.cameras):
            return "the serial numbers of the devices are not known"
        return ""

    def discard(self, estimate: CalibrationEstimate | None) -> dict[str, CameraPrior] | None:
        """Put back what was stored when this calibration began, if anything was; announce the outcome.

        Args:
            estimate: The present result.

        Returns:
            The prior of each camera for a new start; None: nothing was discarded, go on.
        """
        why = "" if estimate is not None and estimate.cameras else "there is no result yet"
        try:
            for name in self._config.calibration_cameras:
                imu, camera = self._pair(name)
                before = self._before.get(name)
                if not (imu and camera) or self._serials.in_doubt or self._load(name) == before:
                    continue
                why = ""
                if before is not None:
                    self._store.save(imu, camera, name, before.estimate, before.saved_ns)
                else:
                    self._store.remove(imu, camera)
        except StoreError as error:
            why = str(error)
        if why:
            self.announce(Event(EventKind.OTHER, said=f"not discarded: {why}"))
            return None
        which = "with what was stored before" if self._before else "nothing was stored before"
        self.announce(Event(EventKind.OTHER, said=f"discarded: starting over, {which}"))
        self._compared.clear()
        self._status, self._saved_s = None, -float("inf")
        return self.priors(wait_s=0.0)

    def stored_messages(self) -> list[Message]:
        """Return the calibrations with which the current ones are to be compared, one message a camera."""
        rig = self._config.rig
        return [
            (topics.STORED.key(rig, name), encode_calibration(_of_camera(stored, name), name))
            for name, stored in self._before.items()
        ]

    def close(self, estimate: CalibrationEstimate | None) -> None:
        """Save a last time and stop listening."""
        self.save(estimate)
        for subscription in self._subscriptions:
            subscription.close()

    def _changes(self, estimate: CalibrationEstimate) -> list[Event]:
        found: list[Event] = []
        for name, stored in self._before.items():
            if name in estimate.cameras and name not in self._compared:
                self._compared.add(name)
                now, t_s = estimate.cameras[name], estimate.duration_s
                found += differences(name, stored.known, now, t_s, Cause.STORED_DIFFERS)
        return found

    def _listen(self, sample: Sample) -> None:
        try:
            statuses = decode_diagnostics(sample.payload).statuses
        except MessageError:
            return
        for status in statuses:
            if status.name in self._components():
                self._serials.note(status)
        if all(all(self._pair(name)) for name in self._config.calibration_cameras):
            self._complete.set()

    def _pair(self, camera: str) -> tuple[str, str]:
        """Return what the calibration of a camera is stored under; "" for what is not known yet."""
        known = self._serials.known
        serial = known.get(f"camera/{camera}", "")
        if serial and len(self._bearers(serial)) > 1:
            serial = f"{serial} {camera}"
        return known.get(f"imu/{self._config.calibration_imu}", ""), serial

    def _bearers(self, serial: str) -> list[str]:
        """Return the cameras of the rig with a serial number: cheap models have one for all."""
        known = self._serials.known
        names = self._config.calibration_cameras
        return [name for name in names if known.get(f"camera/{name}") == serial]

    def _announce_twins(self) -> None:
        """Say once which cameras only their names tell apart."""
        for serial in {*self._serials.known.copy().values()} - self._twins:
            names = self._bearers(serial)
            if len(names) > 1:
                self._twins.add(serial)
                said = (
                    f"{' and '.join(names)} have the same serial number {serial}: only their places in the "
                    "config tell them apart, name them by port (`vical devices`)"
                )
                self.announce(Event(EventKind.OTHER, said=said))

    def _load(self, camera: str) -> StoredCalibration | None:
        self._wait()
        imu_serial, camera_serial = self._pair(camera)
        return self._store.load(imu_serial, camera_serial) if imu_serial and camera_serial else None


def _of_camera(stored: StoredCalibration, name: str) -> CalibrationEstimate:
    """Return a stored estimate under the name that its camera has now."""
    return replace(stored.estimate, cameras={name: stored.known}, events=[])


def _merge(given: CameraPrior, stored: CameraPrior, fix: Collection[str]) -> CameraPrior:
    """Return the stored prior, with the fixed parameters of the config."""
    merged = replace(stored, readout_axis=given.readout_axis or stored.readout_axis)
    if given.readout_s:
        merged = replace(merged, readout_s=given.readout_s, readout_axis=given.readout_axis)
    if "intrinsics" in fix:
        merged = replace(
            merged,
            intrinsics=given.intrinsics,
            distortion=given.distortion,
            intrinsics_sigma=given.intrinsics_sigma,
            distortion_sigma=given.distortion_sigma,
        )
    if "extrinsics" in fix:
        merged = replace(merged, T_imu_cam=given.T_imu_cam)
    if "timeshift" in fix:
        merged = replace(merged, timeshift_cam_imu_s=given.timeshift_cam_imu_s)
    return merged
