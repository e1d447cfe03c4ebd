"""Stores the last converged calibration of each pair of devices, by their serial numbers.

A file is replaced in one step: whatever happens in between, the next start finds the old or the new
calibration, never half of one. What is read is checked: a file that cannot be right is set aside.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from vical_drivers.user_files import read_file

from vical_daemon.bus.messages.poses import rotation_matrix
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate
from vical_daemon.service.atomic_file import atomic_write, why_refused

_log = logging.getLogger(__name__)
_FORMAT = 1
_SIZE_LIMIT = 2**20


class StoreError(Exception):
    """The store cannot be written; the message is one line for the user."""


@dataclass(frozen=True, slots=True)
class StoredCalibration:
    """A stored calibration.

    Attributes:
        format: Of the file.
        imu_serial: Serial number of the imu.
        camera_serial: Serial number of the camera.
        camera: Name of the camera in `estimate`.
        saved_ns: Time of saving, UNIX ns.
        estimate: The estimate with this camera.
        order: Higher than that of all files that were saved before: the computer's date may have been wrong.
    """

    format: int
    imu_serial: str
    camera_serial: str
    camera: str
    saved_ns: int
    estimate: CalibrationEstimate
    order: int = 0

    @property
    def known(self) -> CameraEstimate:
        """The estimate of the camera."""
        return self.estimate.cameras[self.camera]

    def resized(self, now: CameraPrior) -> bool:
        """Whether images have another size now: then the lens of the calibration is of no use."""
        return bool(self.known.resolution) and tuple(self.known.resolution) != now.resolution

    def prior(self, resolution: tuple[int, int]) -> CameraPrior:
        """Return it as the prior of a new calibration.

        Args:
            resolution: width, height of the images, px.
        """
        known = self.known
        pose = rotation_matrix(known.T_imu_cam.q_wxyz), np.array(known.T_imu_cam.p_m, dtype=np.float64)
        fx, fy, cx, cy = known.intrinsics
        return CameraPrior(
            resolution=resolution,
            intrinsics=(fx, fy, cx, cy),
            distortion_model=known.distortion_model,
            distortion=tuple(known.distortion),
            T_imu_cam=pose,
            timeshift_cam_imu_s=known.timeshift_cam_imu_s,
            readout_s=known.readout_s,
            readout_axis=known.readout_axis,
        )


class CalibrationStore:
    """A folder with one JSON file for each pair of imu and camera."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, imu_serial: str, camera_serial: str) -> Path:
        """Return the file of a pair; a hash distinguishes serial numbers that give the same file name."""
        digest = hashlib.sha256(f"{imu_serial}\0{camera_serial}".encode()).hexdigest()[:8]
        words = [
            re.sub(r"[^A-Za-z0-9.-]+", "-", serial).strip(".-")[:40] for serial in (imu_serial, camera_serial)
        ]
        return self.folder / f"{words[0] or 'imu'}_{words[1] or 'cam'}_{digest}.json"

    def save(
        self, imu_serial: str, camera_serial: str, camera: str, estimate: CalibrationEstimate, now_ns: int
    ) -> Path:
        """Replace the stored calibration of a pair, atomically and synced to disk.

        Args:
            imu_serial: Serial number of the imu.
            camera_serial: Serial number of the camera.
            camera: Name of the camera in the estimate.
            estimate: The estimate to store.
            now_ns: UNIX time, ns.

        Raises:
            StoreError: The estimate is invalid, or the disk refuses; the old calibration is kept.
        """
        path = self.path(imu_serial, camera_serial)
        order = 1 + max((_order(other) for other in self.folder.glob("*.json") if other != path), default=-1)
        stored = StoredCalibration(_FORMAT, imu_serial, camera_serial, camera, now_ns, estimate, order)
        problem = _problem(stored)
        if problem:
            raise StoreError(f"calibration of {camera} is not stored: {problem}")
        _set_aside(path)
        try:
            atomic_write(path, msgspec.json.format(msgspec.json.encode(stored, enc_hook=_plain), indent=1))
        except OSError as error:
            raise StoreError(f"{path} cannot be written: {why_refused(error)}") from None
        return path

    def load(self, imu_serial: str, camera_serial: str) -> StoredCalibration | None:
        """Return the stored calibration of a pair; None if there is none, or an invalid one."""
        path = self.path(imu_serial, camera_serial)
        stored = read_stored(path)
        if stored is not None and (stored.imu_serial, stored.camera_serial) != (imu_serial, camera_serial):
            _log.warning("%s belongs to other devices and is not used", path)
            return None
        return stored

    def remove(self, imu_serial: str, camera_serial: str) -> None:
        """Forget the stored calibration of a pair, if there is one.

        Raises:
            StoreError: The disk refuses.
        """
        path = self.path(imu_serial, camera_serial)
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise StoreError(f"{path} cannot be removed: {error.strerror or error}") from None

    def all(self) -> list[StoredCalibration]:
        """Return all valid stored calibrations, newest first."""
        found = [
            stored for path in sorted(self.folder.glob("*.json")) if (stored := read_stored(path)) is not None
        ]
        return sorted(found, key=lambda stored: (-stored.order, -stored.saved_ns))


def read_stored(path: Path) -> StoredCalibration | None:
    """Read one file of a store; None (with a warning) if it is invalid."""
    try:
        text = read_file(path, _SIZE_LIMIT)
    except FileNotFoundError:
        return None
    except OSError as error:
        _log.warning("%s cannot be read: %s", path, error.strerror)
        return None
    return _parsed(text, path)


def _parsed(text: bytes, path: Path) -> StoredCalibration | None:
    """Parse what a file holds; None (with a warning) if it is invalid."""
    try:
        stored = msgspec.convert(_without_news(msgspec.json.decode(text)), StoredCalibration)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        _log.warning("%s is no stored calibration and is not used: %s", path, error)
        return None
    problem = _problem(stored)
    if problem:
        _log.warning("%s is not used: %s", path, problem)
        return None
    return stored


def _set_aside(path: Path) -> None:
    """Keep a file that this version cannot read, as one of a later version, under another name."""
    with suppress(OSError):  # one that cannot be read now may be a good one
        if _parsed(read_file(path, _SIZE_LIMIT), path) is None:
            kept = path.with_name(f"{path.name}.unused")
            path.replace(kept)
            _log.warning("it is kept as %s", kept)


class _Place(msgspec.Struct):
    order: int = 0


def _order(path: Path) -> int:
    """Return `StoredCalibration.order` of a file; 0 if it has none."""
    try:
        return msgspec.json.decode(read_file(path, _SIZE_LIMIT), type=_Place).order
    except (OSError, ValueError, RecursionError):
        return 0


def _without_news(document: Any) -> Any:
    """Drop events and guidance, which files of version 0.1.0 have as text only."""
    estimate = document.get("estimate") if isinstance(document, dict) else None
    if not isinstance(estimate, dict):
        return document
    return document | {"estimate": {k: v for k, v in estimate.items() if k not in ("events", "next_motion")}}


def _problem(stored: StoredCalibration) -> str:
    """Return the problem with a stored calibration, "" if none."""
    if stored.format != _FORMAT:
        return f"format {stored.format} is not known"
    known = stored.estimate.cameras.get(stored.camera)
    if known is None:
        return f"no camera {stored.camera}"
    pose = known.T_imu_cam
    if (
        len(pose.p_m) != 3
        or len(pose.q_wxyz) != 4
        or len(known.intrinsics) != 4
        or len(known.distortion) != len(COEFFICIENTS.get(known.distortion_model, ()))
    ):
        return "wrong number of values"
    numbers = [*pose.p_m, *pose.q_wxyz, *known.intrinsics, *known.distortion, known.timeshift_cam_imu_s]
    if not all(math.isfinite(number) for number in numbers):
        return "a value is not finite"
    if abs(math.hypot(*pose.q_wxyz) - 1) > 1e-6:
        return "the quaternion has not length 1"
    if math.hypot(*pose.p_m) > 10 or abs(known.timeshift_cam_imu_s) > 10 or min(known.intrinsics[:2]) <= 0:
        return "lever arm, time shift or focal length are impossible"
    if [len(row) for row in pose.covariance] != [6] * 6:
        return "the covariance is not 6 x 6"
    return ""


def _plain(value: Any) -> Any:
    """Return a number of an array library as a plain one.

    Raises:
        TypeError: Anything else.
    """
    if hasattr(value, "item"):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be stored")
