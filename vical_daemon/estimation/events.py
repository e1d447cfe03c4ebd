"""Events: what the estimators and the daemon announce, as data. `wording` turns them into text.

Meaning, unit and occasion of each kind: docs/reference/events.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum


class EventKind(StrEnum):
    """What happened; docs/reference/events.md says what it means, in which unit, and when it is announced."""

    BUMPED = "bumped"
    STARTED_OVER = "started_over"
    STARTED_ANEW = "started_anew"
    NOT_BUMPED = "not_bumped"
    WENT_ON = "went_on"
    RESUMED = "resumed"
    CAMERA_MOVED = "camera_moved"
    CAMERA_TURNED = "camera_turned"
    TIMESHIFT_CHANGED = "timeshift_changed"
    LENS_CHANGED = "lens_changed"
    STORED_HOLDS = "stored_holds"
    TIMESHIFT_STEPPED = "timeshift_stepped"
    LENS_STEPPED = "lens_stepped"
    BIASES_STEPPED = "biases_stepped"
    POSE_LOST = "pose_lost"
    CLOCK_DRIFT = "clock_drift"
    CLOCK_WANDER = "clock_wander"
    STAMP_JITTER = "stamp_jitter"
    STAMPED_ON_ARRIVAL = "stamped_on_arrival"
    STAMPS_STEPPED = "stamps_stepped"
    IMU_CLOCK_SET_BACK = "imu_clock_set_back"
    IMU_CLOCK_REMAPPED = "imu_clock_remapped"
    IMU_GAP = "imu_gap"
    IMU_REPEATED = "imu_repeated"
    IMU_CLIPPED = "imu_clipped"
    IMU_UNITS = "imu_units"
    IMAGE_GAP = "image_gap"
    IMAGE_REPEATED = "image_repeated"
    IMAGES_WANDER = "images_wander"
    TIMESHIFT_VARIES = "timeshift_varies"
    IMU_NOISE = "imu_noise"
    IMU_INTRINSICS = "imu_intrinsics"
    ACCEL_LAG = "accel_lag"
    ACCEL_POSITIONS = "accel_positions"
    TARGET_SIZE = "target_size"
    TARGET_RATIO = "target_ratio"
    TARGET_SHAPE = "target_shape"
    FIXED_LENS = "fixed_lens"
    ROLLING_SHUTTER = "rolling_shutter"
    ROLLING_COLUMNS = "rolling_shutter_columns"
    LENS_TERM_MISSING = "lens_term_missing"
    DEVICE_REPLACED = "device_replaced"
    ESTIMATOR_RESTARTED = "estimator_restarted"
    OTHER = "other"


class Cause(StrEnum):
    """Why a calibration or a window was given up, or what it was compared with; see `wording.cause_text`.

    Figures (`Event.cause_value`): of `NO_IMAGES` s, of `FEATURES_MISS` px, of `INERTIAL_MISFIT` times the
    noise, of `SCENE_MOVES` the share of the features.
    """

    NONE = ""
    STORED_DIFFERS = "stored_differs"
    BUMPED = "bumped"
    IMAGES_REFUSED = "images_refused"
    IMAGES_DISAGREE = "images_disagree"
    ESTIMATE_IMPLAUSIBLE = "estimate_implausible"
    CALIBRATION_CONTRADICTED = "calibration_contradicted"
    WINDOW_CONTRADICTED = "window_contradicted"
    NO_IMAGES = "no_images"
    CLOCK_SET = "clock_set"
    INERTIAL_GAP = "inertial_gap"
    TOO_FEW_FEATURES = "too_few_features"
    FEATURES_CONTRADICT = "features_contradict"
    FEATURES_MISS = "features_miss"
    INERTIAL_MISFIT = "inertial_misfit"
    SCENE_MOVES = "scene_moves"
    NO_PARALLAX = "no_parallax"
    SECOND_AXIS = "second_axis"
    COLUMNS_READ = "columns_read"


@dataclass(frozen=True, slots=True)
class Event:
    """One announcement.

    Attributes:
        kind: What happened.
        camera: Name of the camera that it concerns; empty: the rig, its IMU or its target.
        value: Its figure, in the SI unit of docs/reference/events.md; None: it has none.
        sigma: Standard deviation of the value, same unit; None: not known.
        t_s: When, in seconds since the first inertial reading; None: not known.
        cause: Why; for `BUMPED`, `STARTED_OVER` and `WENT_ON`.
        cause_value: Figure of the cause, see `Cause`; None: it has none.
        said: Text of the kinds in `SAID`. Those of kind `OTHER` come from a log written before events were
            typed, or after a kind was added that is not known here.
    """

    kind: EventKind
    camera: str = ""
    value: float | None = None
    sigma: float | None = None
    t_s: float | None = None
    cause: Cause = Cause.NONE
    cause_value: float | None = None
    said: str = ""

    @property
    def changed(self) -> bool:
        """Whether it says that the rig is not what it was."""
        return self.kind in _CHANGES


SAID = frozenset(
    {EventKind.OTHER, EventKind.DEVICE_REPLACED, EventKind.ESTIMATOR_RESTARTED, EventKind.IMU_UNITS}
)
"""Kinds whose details (serial numbers, a line of code, a unit) are text only."""
ROLLING = {"rows": EventKind.ROLLING_SHUTTER, "columns": EventKind.ROLLING_COLUMNS}
"""What is announced of a rolling shutter, by `CameraPrior.readout_axis`."""
_CHANGES = frozenset(
    {
        EventKind.BUMPED,
        EventKind.CAMERA_MOVED,
        EventKind.CAMERA_TURNED,
        EventKind.TIMESHIFT_CHANGED,
        EventKind.LENS_CHANGED,
        EventKind.LENS_STEPPED,
    }
)


class EventLog:
    """Collects the events of one estimator until they are asked for.

    Attributes:
        now_s: Time of events that come now, s since the first inertial reading.
    """

    def __init__(self) -> None:
        self.now_s = 0.0
        self._waiting: list[Event] = []
        self._announced: set[str] = set()

    def add(self, event: Event, once: str = "") -> None:
        """Take an event; of those with the same `once` only the first."""
        if once in self._announced:
            return
        self._waiting.append(replace(event, t_s=self.now_s) if event.t_s is None else event)
        if once:
            self._announced.add(once)

    def take(self) -> list[Event]:
        """Return the events since the last call."""
        waiting, self._waiting = self._waiting, []
        return waiting
