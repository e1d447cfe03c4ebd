"""The state that the page shows. No I/O: messages in, one JSON document per tick out."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import (
    CalibrationMessage,
    DiagnosticStatus,
    Level,
    MessageError,
    VerifyResult,
    admit_calibration,
    admit_verification,
    decode_diagnostics,
)
from vical_daemon.estimation.events import Event
from vical_daemon.estimation.guidance import Guidance, Verb
from vical_daemon.estimation.measurements import ConvergenceTargets
from vical_daemon.estimation.result import Status
from vical_daemon.estimation.wording import (
    at_rest,
    direction_warning,
    event_document,
    fault_headline,
    headline,
    motion_caption,
    silence,
    silent_headline,
)
from vical_daemon.results.differences import differences
from vical_daemon.results.report.scene import rig as rig_document
from vical_daemon.service.liveness import FRESH_S
from vical_daemon.web.camera_watch import CameraWatch
from vical_daemon.web.meters import known_of_needed
from vical_daemon.web.verification import verification_words

HISTORY = 1500
"""Rows kept of each camera: 1.6 MB, five minutes of estimates at 5 Hz."""
SOURCES = 32
"""Cameras and roles shown, so that invented names do not fill memory."""
STALE = "stale"
"""Status of a camera whose estimates have stopped."""
EVENTS = 8  # announcements that the page shows
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
    """The history of one camera.

    Attributes:
        latest: The last message.
        arrived_s: Its arrival, by the clock of the state.
        rows: History, oldest first, thinned towards the past.
        fresh: Rows since the last tick.
        restarted: The estimator was restarted since the last tick.
        events: The last events, oldest first.
    """

    latest: CalibrationMessage
    arrived_s: float
    rows: list[Row] = field(default_factory=list)
    fresh: list[Row] = field(default_factory=list)
    restarted: bool = False
    events: deque[Event] = field(default_factory=lambda: deque(maxlen=EVENTS))


class WebState:
    """Collects calibrations and statuses; `take` may be called from any thread.

    A source that has been silent for longer than `FRESH_S` is stale: the page shows its last values with
    their age, and does not repeat its status as current.

    Args:
        rig: Name of the rig.
        clock: Monotonic seconds.
        watches: What is followed of each camera besides its estimate.
        targets: Sigmas that count as converged.
    """

    def __init__(
        self,
        rig: str,
        clock: Callable[[], float] = time.monotonic,
        watches: Mapping[str, CameraWatch] | None = None,
        targets: ConvergenceTargets | None = None,
    ) -> None:
        self.rig = rig
        self._watches = dict(watches or {})
        self._targets = targets or ConvergenceTargets()
        self._stored: dict[str, CalibrationMessage] = {}
        self._verified: dict[str, tuple[float, VerifyResult]] = {}
        self._clock = clock
        self._lock = threading.Lock()
        self._arrived: deque[tuple[float, Sample]] = deque(maxlen=4096)
        self._cameras: dict[str, CameraState] = {}
        self._statuses: dict[str, tuple[float, tuple[DiagnosticStatus, ...]]] = {}
        self.malformed = 0

    def take(self, sample: Sample) -> None:
        """Queue a message for the next tick; fast, so that the bus is not blocked."""
        with self._lock:
            self._arrived.append((self._clock(), sample))

    def tick(self, *, wanted: bool = True) -> dict[str, Any] | None:
        """Process the queued messages; return the update since the last tick, if `wanted`."""
        with self._lock:
            arrived, self._arrived = self._arrived, deque(maxlen=4096)
        for arrived_s, sample in arrived:
            try:
                self._process(sample, arrived_s)
            except MessageError:
                self.malformed += 1
        document = self._document(full=False) if wanted else None
        for camera in self._cameras.values():
            camera.fresh, camera.restarted = [], False
        return document

    def full(self) -> dict[str, Any]:
        """Return the full state, for a new client."""
        return self._document(full=True)

    @property
    def statuses(self) -> dict[str, tuple[DiagnosticStatus, ...]]:
        """Last status of every role; of a silent role, marked as stale."""
        now_s = self._clock()
        return {
            role: statuses if not is_stale(now_s - arrived_s) else _silent(statuses, now_s - arrived_s)
            for role, (arrived_s, statuses) in self._statuses.items()
        }

    @property
    def calibrations(self) -> dict[str, tuple[CalibrationMessage, float]]:
        """Last calibration of every camera, and its age, s."""
        now_s = self._clock()
        return {name: (camera.latest, now_s - camera.arrived_s) for name, camera in self._cameras.items()}

    @property
    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """Size of the images of every camera that is followed, where it is known, px."""
        return {name: watch.size for name, watch in self._watches.items() if all(watch.size)}

    def _process(self, sample: Sample, arrived_s: float) -> None:
        """Process one message.

        Raises:
            MessageError: It does not match its key, or there are too many sources.
        """
        parsed = topics.parse_key(sample.key)
        if parsed is None:
            return
        if parsed.topic is topics.CALIBRATION:
            message = admit_calibration(sample.payload)
            if message.camera != parsed.name:
                raise MessageError(f"{sample.key} speaks of {message.camera[:80]}")
            _admit(parsed.name, self._cameras)
            self._calibration(message, arrived_s)
        elif parsed.topic in (topics.POINTS, topics.TRACKS, topics.PREDICTED):
            watch = self._watches.get(parsed.name)
            if watch is not None:
                watch.take(sample, parsed.topic)
        elif parsed.topic is topics.STORED:
            _admit(parsed.name, self._stored)
            self._stored[parsed.name] = admit_calibration(sample.payload)
        elif parsed.topic is topics.VERIFY:
            _admit(parsed.name, self._verified)
            self._verified[parsed.name] = arrived_s, admit_verification(sample.payload)
        elif parsed.topic is topics.STATUS:
            _admit(parsed.name, self._statuses)
            self._statuses[parsed.name] = arrived_s, decode_diagnostics(sample.payload).statuses

    def _calibration(self, message: CalibrationMessage, arrived_s: float) -> None:
        camera = self._cameras.setdefault(message.camera, CameraState(message, arrived_s))
        if message.estimate.duration_s < camera.latest.estimate.duration_s:
            camera.rows, camera.fresh, camera.restarted = [], [], True
            camera.events.clear()
            if message.camera in self._watches:
                self._watches[message.camera].begin_again()
        camera.latest, camera.arrived_s = message, arrived_s
        camera.events.extend(message.estimate.events)
        row = history_row(message)
        if row is None or (camera.rows and camera.rows[-1][0] == row[0]):
            return
        camera.rows.append(row)
        camera.fresh.append(row)
        if len(camera.rows) > HISTORY:
            camera.rows = _thinned(camera.rows)

    def _document(self, *, full: bool) -> dict[str, Any]:
        cameras, now_s = {}, self._clock()
        for name, camera in sorted(self._cameras.items()):
            whole = full or camera.restarted
            fault = self._fault(name)
            entry = summary(camera.latest, now_s - camera.arrived_s, fault is not None)
            entry["fault"] = fault
            if self._silent(name) and not entry["stale"]:
                entry["headline"] = at_rest(entry["status"])
            entry["events"] = [event_document(event) for event in camera.events]
            entry |= self._result(name, camera.latest)
            if fault is None and not entry["stale"]:
                entry |= self._verification(name, now_s)
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
            for role, statuses in sorted(self.statuses.items())
            for status in statuses
            if status.name != "clock"
        ]
        document: dict[str, Any] = {
            "rig": self.rig,
            "cameras": cameras,
            "devices": devices,
            "fault": self._fault(),
            "sights": self._sights(full=full),
        }
        if full:
            document["columns"] = COLUMNS
        return document

    def _result(self, name: str, message: CalibrationMessage) -> dict[str, Any]:
        """Return meters, rig and comparison with the stored calibration of one camera."""
        known = message.camera_estimate
        if known is None:
            return {"meters": [], "rig": None, "stored": None}
        pose = known.T_imu_cam
        place = {"p_m": pose.p_m, "q_wxyz": pose.q_wxyz, "covariance": pose.covariance}
        stored = self._stored.get(name)
        before = None if stored is None else stored.camera_estimate
        return {
            "meters": known_of_needed(
                known, self._targets, enough=message.estimate.status is Status.CONVERGED
            ),
            "rig": rig_document(place),
            "stored": None
            if stored is None or before is None
            else {
                "t_ns": str(stored.estimate.t_ns),
                "rows": [
                    [d.name, finite(d.value), finite(d.sigma), finite(d.sigmas), d.unit]
                    for d in differences(before, known)
                ],
            },
        }

    def _verification(self, name: str, now_s: float) -> dict[str, Any]:
        """Return what takes the place of the estimator's words while a stored calibration is verified."""
        arrived_s, result = self._verified.get(name, (-math.inf, None))
        if result is None or is_stale(now_s - arrived_s):
            return {}
        return verification_words(result)

    def _sights(self, *, full: bool) -> dict[str, Any]:
        """Return what the page shows of the images of each camera."""
        exposures = {
            status.name.removeprefix("camera/"): status.values["exposure_ms"]
            for _, statuses in self._statuses.values()
            for status in statuses
            if "exposure_ms" in status.values
        }
        sights = {}
        for name, watch in self._watches.items():
            with suppress(KeyError, ValueError):
                watch.exposure_s = 1e-3 * float(exposures[name])
            camera = self._cameras.get(name)
            known = None if camera is None else camera.latest.camera_estimate
            sights[name] = watch.document(known, full=full)
        return sights

    def _fault(self, camera: str = "") -> dict[str, str] | None:
        """Return the first component that does not work; until it does, the page gives no advice.

        Args:
            camera: Only what the calibration of this camera depends on; empty: all of the rig.
        """
        statuses = [s for _, (_, said) in sorted(self._statuses.items()) for s in said]
        for status in statuses:
            if status.level >= Level.ERROR and _concerns(status.name, camera):
                return fault_document(status)
        for name in self._silent(camera):
            shown = self._cameras.get(camera)
            message = "" if shown is None else shown.latest.estimate.reason
            return {"name": name, "headline": silent_headline(name), "message": message}
        return None

    def _silent(self, camera: str) -> list[str]:
        """Components from which the estimator gets nothing new, of those on which a camera depends."""
        values = [status.values for _, said in self._statuses.values() for status in said]
        names = [name for v in values for name in v.get("silent", "").split(", ") if name]
        return [name for name in names if _concerns(name, camera)]


def _thinned(rows: list[Row]) -> list[Row]:
    """Leave out a quarter of the older half, where rows are closest together: `thinned` in app.js.

    To halve all of it each time would leave a hole of hours between the first row and the last minutes.
    """
    t_s = [row[0] or 0.0 for row in rows]
    gaps = [(t_s[i + 1] - t_s[i - 1], i) for i in range(1, len(rows) // 2, 2)]
    gone = {i for _, i in sorted(gaps)[: len(gaps) // 2]}
    return [row for i, row in enumerate(rows) if i not in gone]


def _concerns(component: str, camera: str) -> bool:
    """Whether the calibration of a camera depends on a component; empty: that of any camera."""
    kind, _, name = component.partition("/")
    return not camera or kind not in ("camera", "detect", "verify") or name == camera


def fault_document(status: DiagnosticStatus) -> dict[str, str]:
    """Return what the page says of a component that reports an error."""
    with suppress(KeyError, ValueError):
        age_s = float(status.values["data_age_s"])
        headline = fault_headline(status.name, age_s if math.isfinite(age_s) else None)
        return {"name": status.name, "headline": headline, "message": status.message}
    return {"name": status.name, "headline": fault_headline(status.name), "message": status.message}


def is_stale(age_s: float) -> bool:
    """Whether a source whose last message has this age is silent."""
    return age_s > FRESH_S


def _silent(statuses: tuple[DiagnosticStatus, ...], age_s: float) -> tuple[DiagnosticStatus, ...]:
    return tuple(
        replace(status, level=Level.STALE, message=f"silent for {age_s:.0f} s; last: {status.message}")
        for status in statuses
    )


def _admit(name: str, known: dict[str, Any]) -> None:
    """Check that a source is known or that there is room for it.

    Raises:
        MessageError: There is no room.
    """
    if name not in known and len(known) >= SOURCES:
        raise MessageError(f"{name}: more than {SOURCES} sources")


def summary(message: CalibrationMessage, age_s: float = 0.0, fault: bool = False) -> dict[str, Any]:
    """Return what the page shows about one camera now.

    Args:
        message: The last message of the camera.
        age_s: Its age, s.
        fault: A component reports an error: then the page gives no advice.
    """
    estimate, camera = message.estimate, message.camera_estimate
    # the guidance alone gives advice: a second one could name other axes
    withheld = [direction_warning(weak) for weak in camera.withheld] if camera else []
    if camera and not withheld:
        withheld = list(camera.unobservable)  # of version 0.1.0
    stale = is_stale(age_s)
    status, last_status = STALE if stale else str(estimate.status), str(estimate.status)
    quiet = fault or stale
    asked = Guidance() if quiet else estimate.next_motion
    # of the edges of another camera's picture, and of its axes, only the text speaks
    elsewhere = estimate.next_motion.camera not in ("", message.camera)
    own = Guidance() if elsewhere else estimate.next_motion
    shown = Guidance() if quiet else own
    moves = shown.verb is Verb.TURN_AND_MOVE
    turns = shown.verb not in (Verb.NONE, Verb.SHOW)
    return {
        "status": status,
        "last_status": last_status,
        "stale": stale,
        "age_s": round(age_s, 1),
        "headline": silence(age_s) if stale else headline(status, own),
        "reason": f"The values are old; the last status was {last_status}." if stale else estimate.reason,
        "guidance": "" if quiet else estimate.guidance,
        "progress": finite(estimate.progress),
        "duration_s": finite(estimate.duration_s),
        "frames": estimate.frames,
        "imu_samples": estimate.imu_samples,
        "nis": finite(estimate.nis_per_dof),
        "rejected": finite(estimate.rejected_fraction),
        "withheld": withheld,
        "motion": {
            "rotate": list(shown.axes) if turns else [],
            "translate": list(shown.axes) if moves else [],
            "edges": list(shown.edges),
            "caption": "" if quiet else motion_caption(status, asked, estimate.guidance),
        },
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
    """Return a number for JSON, rounded for display; None for nan and infinity."""
    return float(f"{value:.7g}") if math.isfinite(value) else None
