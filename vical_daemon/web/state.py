"""What the page shows, kept from the bus. No I/O: messages go in, one JSON document a tick comes out."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from vical_daemon import topics
from vical_daemon.bus import Sample
from vical_daemon.messages import (
    CalibrationMessage,
    DiagnosticStatus,
    MessageError,
    admit_calibration,
    decode_diagnostics,
)
from vical_daemon.web import words

NAMES = 64  # devices and roles that a page can show
HISTORY = 1500
# One row of the history; lists of three are flattened in this order.
COLUMNS = (
    "t_s", "px_mm", "py_mm", "pz_mm", "spx_mm", "spy_mm", "spz_mm", "qw", "qx", "qy", "qz",
    "srx_deg", "sry_deg", "srz_deg", "shift_ms", "sshift_ms", "nis",
    "gx_mrad", "gy_mrad", "gz_mrad", "sgx_mrad", "sgy_mrad", "sgz_mrad",
    "ax_mm", "ay_mm", "az_mm", "sax_mm", "say_mm", "saz_mm",
)  # fmt: skip
Row = list[float | None]


@dataclass(slots=True)
class CameraState:
    """The development of one camera.

    Attributes:
        latest: The last message.
        rows: History, oldest first, thinned towards the past.
        fresh: Rows since the last tick.
        restarted: The estimator began anew since the last tick.
    """

    latest: CalibrationMessage
    rows: list[Row] = field(default_factory=list)
    fresh: list[Row] = field(default_factory=list)
    restarted: bool = False


class WebState:
    """Collects calibrations and statuses; `take` may be called from any thread.

    Args:
        rig: Name of the rig.
    """

    def __init__(self, rig: str) -> None:
        self.rig = rig
        self._lock = threading.Lock()
        self._arrived: deque[Sample] = deque(maxlen=4096)
        self._cameras: dict[str, CameraState] = {}
        self._statuses: dict[str, tuple[DiagnosticStatus, ...]] = {}
        self._stamps_ns: dict[str, int] = {}
        self._names: set[str] = set()
        self.malformed = 0

    def take(self, sample: Sample) -> None:
        """Keep a message for the next tick; does next to nothing, so that the bus is not held up."""
        with self._lock:
            self._arrived.append(sample)

    def tick(self, *, wanted: bool = True) -> dict[str, Any] | None:
        """Digest what has arrived; return the update for everybody who is up to date, if it is `wanted`."""
        with self._lock:
            arrived, self._arrived = self._arrived, deque(maxlen=4096)
        for sample in arrived:
            try:
                self._digest(sample)
            except MessageError:
                self.malformed += 1
        document = self._document(full=False) if wanted else None
        for camera in self._cameras.values():
            camera.fresh, camera.restarted = [], False
        return document

    def full(self) -> dict[str, Any]:
        """Return everything, for somebody who has just come."""
        return self._document(full=True)

    @property
    def statuses(self) -> dict[str, tuple[DiagnosticStatus, ...]]:
        """Last status of every role."""
        return dict(self._statuses)

    @property
    def calibrations(self) -> dict[str, CalibrationMessage]:
        """Last calibration of every camera."""
        return {name: camera.latest for name, camera in self._cameras.items()}

    def _digest(self, sample: Sample) -> None:
        parsed = topics.parse_key(sample.key)
        if parsed is None or not self._room(parsed.name):
            return
        if parsed.topic is topics.CALIBRATION:
            message = admit_calibration(sample.payload)
            if message.camera == parsed.name:
                self._calibration(message)
        elif parsed.topic is topics.STATUS:
            status = decode_diagnostics(sample.payload)
            self._statuses[parsed.name] = status.statuses
            self._stamps_ns[parsed.name] = status.stamp_ns

    def _room(self, name: str) -> bool:
        """Whether to listen to this device or role: whoever invents names must not fill memory and page."""
        if len(self._names) < NAMES:
            self._names.add(name)
        return name in self._names

    def _calibration(self, message: CalibrationMessage) -> None:
        camera = self._cameras.setdefault(message.camera, CameraState(message))
        if message.estimate.duration_s < camera.latest.estimate.duration_s:
            camera.rows, camera.fresh, camera.restarted = [], [], True
        camera.latest = message
        row = history_row(message)
        if row is None or (camera.rows and camera.rows[-1][0] == row[0]):
            return
        camera.rows.append(row)
        camera.fresh.append(row)
        if len(camera.rows) > HISTORY:
            half = HISTORY // 2
            camera.rows = camera.rows[:half:2] + camera.rows[half:]

    def _document(self, *, full: bool) -> dict[str, Any]:
        cameras = {}
        for name, camera in sorted(self._cameras.items()):
            whole = full or camera.restarted
            entry = summary(camera.latest)
            entry["rows" if whole else "fresh"] = camera.rows if whole else camera.fresh
            cameras[name] = entry
        devices = [
            {
                "role": role,
                "name": status.name,
                "level": int(status.level),
                "message": status.message,
                "serial": status.hardware_id,
                "values": status.values,
            }
            for role, statuses in sorted(self._statuses.items())
            for status in statuses
            if status.name != "clock"
        ]
        document: dict[str, Any] = {"rig": self.rig, "cameras": cameras, "devices": devices}
        if full:
            document["columns"] = COLUMNS
        return document


def summary(message: CalibrationMessage) -> dict[str, Any]:
    """Return what the page says about one camera at this moment."""
    estimate, camera = message.estimate, message.camera_estimate
    withheld = list(camera.unobservable) if camera else []
    return {
        "status": str(estimate.status),
        "sentence": words.sentence(estimate),
        "guidance": estimate.guidance,
        "progress": finite(estimate.progress),
        "duration_s": finite(estimate.duration_s),
        "frames": estimate.frames,
        "imu_samples": estimate.imu_samples,
        "nis": finite(estimate.nis_per_dof),
        "rejected": finite(estimate.rejected_fraction),
        "events": list(estimate.events),
        "withheld": withheld,
        "motion": words.motion([estimate.guidance, *withheld]),
        "gravity": [finite(v) for v in estimate.gravity_world_mps2],
        "lens": None
        if camera is None
        else {
            "intrinsics": [finite(v) for v in camera.intrinsics],
            "intrinsics_sigma": [finite(v) for v in camera.intrinsics_sigma],
            "distortion_model": camera.distortion_model,
            "distortion": [finite(v) for v in camera.distortion],
            "rms_px": finite(camera.reprojection_rms_px),
            "corner_sigma_px": finite(camera.corner_sigma_px),
            "readout_ms": finite(1e3 * camera.readout_s),
        },
    }


def history_row(message: CalibrationMessage) -> Row | None:
    """Return one row of the history (see `COLUMNS`); None before the first solution."""
    camera, imu = message.camera_estimate, message.estimate.imu
    if camera is None:
        return None
    pose = camera.T_imu_cam
    sigma = [math.sqrt(max(pose.covariance[i][i], 0.0)) for i in range(6)]
    gyro = imu.gyro_bias_rps if imu else []
    accel = imu.accel_bias_mps2 if imu else []
    row = [
        message.estimate.duration_s,
        *(1e3 * p for p in pose.p_m),
        *(1e3 * s for s in sigma[:3]),
        *pose.q_wxyz,
        *(math.degrees(s) for s in sigma[3:]),
        1e3 * camera.timeshift_cam_imu_s,
        1e3 * camera.timeshift_sigma_s,
        message.estimate.nis_per_dof,
        *_three(gyro),
        *_three(imu.gyro_bias_sigma_rps if imu else []),
        *_three(accel),
        *_three(imu.accel_bias_sigma_mps2 if imu else []),
    ]
    return [finite(v) for v in row]


def _three(values: list[float]) -> list[float]:
    """Return three values times 1000 (m/s^2 to mm/s^2, rad/s to mrad/s); nan where unknown."""
    return [1e3 * v for v in values] if len(values) == 3 else [math.nan] * 3


def finite(value: float) -> float | None:
    """Return a number as JSON can hold it, rounded to what a page can show; None for nan and infinity."""
    return float(f"{value:.7g}") if math.isfinite(value) else None
