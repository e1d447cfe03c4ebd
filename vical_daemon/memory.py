"""Remembers calibrations over restarts, by the serial numbers of the devices, and tells when one has changed.

Serial numbers come from the status of the acquiring roles, so the estimator needs no access to devices.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from vical_daemon import notify, topics
from vical_daemon.bus import Bus, Sample
from vical_daemon.config import Config
from vical_daemon.estimation import so3
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, Status
from vical_daemon.messages import MessageError, decode_diagnostics
from vical_daemon.places import state_directory
from vical_daemon.priors import camera_prior
from vical_daemon.store import CalibrationStore, StoredCalibration, StoreError
from vical_daemon.wall_clock import WallClock

_log = logging.getLogger(__name__)
SAVE_EVERY_S = 60.0
SERIALS_WITHIN_S = 3.0
SIGMAS = 4.0
# What nobody needs to be told of, however significant: thermal play of a mount.
IRRELEVANT_M, IRRELEVANT_RAD, IRRELEVANT_S = 2e-3, math.radians(0.1), 2e-4


class Memory:
    """The store as one running estimator uses it.

    Args:
        config: The rig.
        bus: Where the status of the devices is heard.
        clock: For the date of what is saved.
    """

    def __init__(self, config: Config, bus: Bus, clock: WallClock) -> None:
        folder = Path(config.store.directory) if config.store.directory else state_directory() / "calibration"
        self._config, self._bus, self._clock = config, bus, clock
        self._store = CalibrationStore(folder)
        self._serials: dict[str, str] = {}
        self._complete = threading.Event()
        self._before: dict[str, StoredCalibration] = {}
        self._compared: set[str] = set()
        self._saved_s = -float("inf")
        self._status: Status | None = None
        self._announced: list[str] = []
        pattern = topics.STATUS.pattern
        self._keys = [pattern.format(rig=config.rig, name=role) for role in ("imu", "camera")]
        self._subscriptions = [bus.subscribe(key, self._listen) for key in self._keys]

    def priors(self) -> dict[str, CameraPrior]:
        """Return what is known about each camera: what was stored for these devices, else the config.

        Waits a moment for the serial numbers. What the config gives for a held parameter stays.
        """
        for key in self._keys:
            for sample in self._bus.latest(key):
                self._listen(sample)
        self._complete.wait(SERIALS_WITHIN_S)
        known: dict[str, CameraPrior] = {}
        for name in self._config.calibration_cameras:
            known[name] = given = camera_prior(self._config, name)
            stored = self._load(name)
            if stored is not None and stored.known.distortion_model == given.distortion_model:
                self._before[name] = stored
                known[name] = _merge(given, stored.prior(given.resolution), self._config.calibration.fix)
        return known

    @property
    def stored(self) -> list[str]:
        """Cameras for which a calibration of these devices is stored."""
        return list(self._before)

    @property
    def devices(self) -> dict[str, str]:
        """Serial numbers of the devices of this calibration by component; empty while one is unknown."""
        names = [f"imu/{self._config.calibration_imu}"]
        names += [f"camera/{name}" for name in self._config.calibration_cameras]
        known = {name: self._serials[name] for name in names if name in self._serials}
        return known if len(known) == len(names) else {}

    def announce(self, text: str) -> None:
        """Add an event to the next estimate."""
        self._announced.append(text)

    def watch(self, estimate: CalibrationEstimate) -> CalibrationEstimate:
        """Look at an estimate before it is published: save it when it is good, announce what changed.

        Returns:
            The estimate, with an event added where the calibration differs from the stored one.
        """
        events = [*self._announced, *estimate.events]
        self._announced.clear()
        if estimate.status is Status.CONVERGED:
            events += self._changes(estimate)
            if self._status is not Status.CONVERGED:
                notify.event("converged", f"{self._config.rig}: calibration converged", rig=self._config.rig)
            if time.monotonic() - self._saved_s > SAVE_EVERY_S:
                self.save(estimate)
        for text in events:
            name = "bumped" if text.startswith(("bumped", "changed")) else "calibration"
            notify.event(name, text, level="warning", rig=self._config.rig)
        self._status = estimate.status
        return replace(estimate, events=events) if events != estimate.events else estimate

    def save(self, estimate: CalibrationEstimate | None) -> None:
        """Store a converged estimate now (once a minute, and at the end)."""
        if estimate is None or estimate.status is not Status.CONVERGED:
            return
        self._saved_s = time.monotonic()
        for name in estimate.cameras:
            imu, camera = self._pair(name)
            if imu and camera:
                try:
                    self._store.save(imu, camera, name, estimate, self._clock.now_ns())
                except StoreError as error:
                    _log.warning("%s", error)

    def close(self, estimate: CalibrationEstimate | None) -> None:
        """Save a last time and stop listening."""
        self.save(estimate)
        for subscription in self._subscriptions:
            subscription.close()

    def _changes(self, estimate: CalibrationEstimate) -> list[str]:
        texts = []
        for name, stored in self._before.items():
            if name in estimate.cameras and name not in self._compared:
                self._compared.add(name)
                text = difference(stored.known, estimate.cameras[name])
                if text:
                    texts.append(f"changed: {name} since the stored calibration: {text}")
        return texts

    def _listen(self, sample: Sample) -> None:
        try:
            statuses = decode_diagnostics(sample.payload).statuses
        except MessageError:
            return
        self._serials.update({s.name: s.hardware_id for s in statuses if s.hardware_id})
        if all(all(self._pair(name)) for name in self._config.calibration_cameras):
            self._complete.set()

    def _pair(self, camera: str) -> tuple[str, str]:
        imu = self._serials.get(f"imu/{self._config.calibration_imu}", "")
        return imu, self._serials.get(f"camera/{camera}", "")

    def _load(self, camera: str) -> StoredCalibration | None:
        imu_serial, camera_serial = self._pair(camera)
        return self._store.load(imu_serial, camera_serial) if imu_serial and camera_serial else None


def difference(before: CameraEstimate, now: CameraEstimate) -> str:
    """Say by how much a mounting differs from an earlier one, beyond both sigmas and what matters; or "".

    Each component is compared with the sum of both variances; rotations as the angle about each axis.
    """
    old, new = before.T_imu_cam, now.T_imu_cam
    variance = np.diag(np.asarray(old.covariance)) + np.diag(np.asarray(new.covariance))
    limit = SIGMAS * np.sqrt(np.maximum(variance, 0.0))
    move_m = np.subtract(new.p_m, old.p_m)
    R_old, R_new = (so3.matrix_from_quat(np.asarray(pose.q_wxyz)) for pose in (old, new))
    turn_rad = so3.log(R_old.T @ R_new)
    shift_s = now.timeshift_cam_imu_s - before.timeshift_cam_imu_s
    texts = []
    if np.any(np.abs(move_m) > np.maximum(limit[:3], IRRELEVANT_M)):
        texts.append(f"moved by {1e3 * float(np.linalg.norm(move_m)):.1f} mm")
    if np.any(np.abs(turn_rad) > np.maximum(limit[3:], IRRELEVANT_RAD)):
        texts.append(f"turned by {math.degrees(float(np.linalg.norm(turn_rad))):.2f} deg")
    sigma_s = math.hypot(before.timeshift_sigma_s, now.timeshift_sigma_s)
    if abs(shift_s) > max(SIGMAS * sigma_s, IRRELEVANT_S):
        texts.append(f"time shift by {1e3 * shift_s:+.2f} ms")
    return ", ".join(texts)


def _merge(given: CameraPrior, stored: CameraPrior, fix: tuple[str, ...]) -> CameraPrior:
    """Take what was stored, but for what the config holds fixed."""
    merged = replace(stored, readout_s=given.readout_s or stored.readout_s)
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
