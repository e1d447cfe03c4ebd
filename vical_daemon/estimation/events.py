"""Events: what the estimators and the daemon announce, as data. `wording` turns them into text.

`REFERENCE` is the one table of all kinds; docs/reference/events.md is made from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple


class EventKind(StrEnum):
    """What happened; see `REFERENCE` for meaning, unit of the value, and when it is announced."""

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
    IMAGE_GAP = "image_gap"
    IMAGE_REPEATED = "image_repeated"
    IMAGES_WANDER = "images_wander"
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
    IMAGES_SHIFTED = "images_shifted"


@dataclass(frozen=True, slots=True)
class Event:
    """One announcement.

    Attributes:
        kind: What happened.
        camera: Name of the camera that it concerns; empty: the rig, its IMU or its target.
        value: Its figure, in the SI unit that `REFERENCE` gives; None: it has none.
        sigma: Standard deviation of the value, same unit; None: not known.
        t_s: When, in seconds since the first inertial reading; None: not known.
        cause: Why; for `BUMPED`, `STARTED_OVER` and `WENT_ON`. Of `STAMP_JITTER`: what else it may be.
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


SAID = frozenset({EventKind.OTHER, EventKind.DEVICE_REPLACED, EventKind.ESTIMATOR_RESTARTED})
"""Kinds whose details (serial numbers, a line of code) are text only."""
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


class About(NamedTuple):
    """One row of the reference.

    Attributes:
        meaning: What it says.
        unit: Of value and sigma; empty: it has none.
        when: When it is announced.
    """

    meaning: str
    unit: str
    when: str


REFERENCE: dict[EventKind, About] = {
    EventKind.BUMPED: About(
        "The rig has changed since it was calibrated; the mounting is found again.",
        "",
        "After the first convergence, when images stop fitting the motion and only another mounting explains "
        "them, or nothing does. Target-free: when 2 s of images show another mounting.",
    ),
    EventKind.STARTED_OVER: About(
        "As `bumped`, but there was no converged calibration yet.", "", "Before the first convergence."
    ),
    EventKind.STARTED_ANEW: About(
        "There is a calibration again.",
        "",
        "At the first solution after `bumped` or `started_over`, if calibration had to start over.",
    ),
    EventKind.NOT_BUMPED: About(
        "Images disagreed, but mounting, time shift and lens have not changed. The target was moved, or "
        "images were wrong. Value: the least move of the camera that would show.",
        "m",
        "With a target: at the latest 10 s after `bumped`, or after images that a moved camera and a moved "
        "target explain about equally well, once converged, if nothing differs as for `camera_moved`.",
    ),
    EventKind.WENT_ON: About(
        "Target-free: images are used again; the calibration was kept.", "", "When a pause ends."
    ),
    EventKind.RESUMED: About(
        "The estimator went on from its saved state. Value: age of that state.", "s", "After a crash."
    ),
    EventKind.CAMERA_MOVED: About(
        "The lever arm differs. Value: distance.",
        "m",
        "Once per start, at convergence, if a component differs from the stored calibration by more than 4 "
        "joint sigma and 2 mm; after `bumped` also from the calibration before. With `mode: verify`, when a "
        "second check confirms that the stored calibration no longer holds.",
    ),
    EventKind.CAMERA_TURNED: About(
        "The mounting rotation differs. Value: angle.",
        "rad",
        "As `camera_moved`: 4 joint sigma and 0.1 deg.",
    ),
    EventKind.TIMESHIFT_CHANGED: About(
        "The time shift differs. Value: new minus stored.",
        "s",
        "As `camera_moved`: 4 joint sigma and 0.2 ms.",
    ),
    EventKind.LENS_CHANGED: About(
        "The lens differs. Value: how far it projects points from where the stored one does, RMS over the "
        "image.",
        "px",
        "With `mode: verify`, as `camera_moved`.",
    ),
    EventKind.STORED_HOLDS: About(
        "The stored calibration holds. Value: seconds of data that showed it.",
        "s",
        "With `mode: verify`, at the first such answer, and at the first one after another answer.",
    ),
    EventKind.TIMESHIFT_STEPPED: About(
        "The time shift jumped; everything else is kept. Value: new minus old.",
        "s",
        "When images have agreed with the new time shift for 3 s; target-free for 2 s. Not within 4 of the "
        "sigmas that the IMU's driver states of its stamps.",
    ),
    EventKind.LENS_STEPPED: About(
        "The lens changed at once: focus or zoom was turned, or focuses by itself. A lens that is not "
        "fixed is estimated again; everything else is kept. Value: focal length fx, new minus old.",
        "px",
        "With a board: when images no longer fit, only another lens explains them, and images agree with it "
        "for 3 s; or, of a lens that is not fixed, when fx differs by 4 joint sigma and 1 px afterwards.",
    ),
    EventKind.POSE_LOST: About(
        "The target was moved, or the pose was lost. It is found again; the calibration is kept.",
        "",
        "When images no longer fit and a moved target explains them, or after 10 images in a row that "
        "nothing explains.",
    ),
    EventKind.CLOCK_DRIFT: About(
        "The clocks of camera and IMU run at different rates; the drift is estimated from now "
        "on. Value: drift.",
        "s/s",
        "Once per camera, at a probability above 99 %.",
    ),
    EventKind.CLOCK_WANDER: About(
        "The time shift is not constant: it stepped by a few milliseconds at most, or the rate between "
        "the clocks of camera and IMU changed. Which of both is not known. Value: present drift.",
        "s/s",
        "Once per camera, when the drift leaves where earlier estimates put it, by 6 sigma.",
    ),
    EventKind.STAMP_JITTER: About(
        "The stamps of the images jitter; allowed for. Value: standard deviation.",
        "s",
        "Once per camera, from 0.3 ms; with a board, once neighbours are known to be late independently. "
        "Without one, images that are shifted as a whole are not distinguished: cause `images_shifted`.",
    ),
    EventKind.STAMPED_ON_ARRIVAL: About(
        "A live camera samples evenly, but stamps on arrival. From now on its images are put on an even "
        "grid, and the calibration starts over. Value: standard deviation of the delays.",
        "s",
        "Once per camera, when points are found to move more smoothly over the even grid, by 5 sigma.",
    ),
    EventKind.IMAGES_WANDER: About(
        "Whole images move against the motion of the IMU, for seconds: image stabilisation, a loose lens or "
        "camera, or a board that moves. Meanwhile the result is not `converged`. Value: standard deviation.",
        "px",
        "Once per camera, with a board, from 1 px.",
    ),
    EventKind.STAMPS_STEPPED: About(
        "A camera's clock was set. Value: step against the IMU's stamps.",
        "s",
        "When 5 images in a row show a step of more than 1.5 s.",
    ),
    EventKind.IMU_CLOCK_SET_BACK: About("The IMU's clock was set back. Value: by how much.", "s", "At once."),
    EventKind.IMU_CLOCK_REMAPPED: About(
        "The driver mapped the IMU's clock again; the time shift follows. Value: step.",
        "s",
        "When 4 even readings have followed the step, if it exceeds 6 of the driver's stated sigmas.",
    ),
    EventKind.IMU_GAP: About(
        "Inertial readings were missing. Value: for how long.",
        "s",
        "With the next image, at most 0.5 s later.",
    ),
    EventKind.IMU_REPEATED: About(
        "The IMU repeated one reading bit by bit. Value: for how long.", "s", "When new readings come."
    ),
    EventKind.IMU_CLIPPED: About(
        "Motion exceeds the range of the IMU; what exceeds it is bridged. Value: share of such readings.",
        "1",
        "Once, 5 s after the first of them.",
    ),
    EventKind.IMAGE_GAP: About(
        "Images were missing. Value: for how long.",
        "s",
        "When they resume, from 0.5 s and 4 image intervals.",
    ),
    EventKind.IMAGE_REPEATED: About(
        "A camera repeated one image. Value: for how long.", "s", "As `image_gap`."
    ),
    EventKind.IMU_NOISE: About(
        "The IMU's noise densities in the config are wrong. Value: error of predictions over the expected "
        "one.",
        "1",
        "Once, after 20 predicted images, outside of 0.74 to 1.22; not where the readings show their white "
        "noise and errors of the images last.",
    ),
    EventKind.IMU_INTRINSICS: About(
        "Scale or alignment of the IMU is off; allowed for. Value: the most certain entry.",
        "1",
        "Once, at a probability above 99 %.",
    ),
    EventKind.ACCEL_LAG: About(
        "The accelerometer lags (+) or leads (-) the gyro; allowed for. Value: by how much.",
        "s",
        "Once, at a probability above 99 %.",
    ),
    EventKind.ACCEL_POSITIONS: About(
        "The axes of the accelerometer are not in one place (size effect); allowed for. Value: how far apart "
        "they are, the most certain component.",
        "m",
        "Once, at a probability above 99 %.",
    ),
    EventKind.TARGET_SIZE: About(
        "The target is larger (+) or smaller (-) than its file says; its size is estimated. Value: relative.",
        "1",
        "Once: during initialisation if it is far off, else at a probability above 99 %.",
    ),
    EventKind.TARGET_RATIO: About(
        "The columns of the target are further apart (+) or closer together (-), compared with its rows, "
        "than its file says; allowed for. Value: relative.",
        "1",
        "During initialisation, where they are by 2.4 % or more.",
    ),
    EventKind.TARGET_SHAPE: About(
        "The target is bent, or its print is distorted; its shape is estimated. Value: the most certain "
        "mode, at the edges.",
        "m",
        "Once, at a probability above 99 %.",
    ),
    EventKind.FIXED_LENS: About(
        "The fixed lens is not this camera's; its values are kept and the sigmas allow for their errors. "
        "Value: how far it projects points from where they appear, RMS over the image.",
        "px",
        "Once per camera, at a probability above 99 %.",
    ),
    EventKind.ROLLING_SHUTTER: About(
        "A rolling shutter that the config does not mention; its readout is estimated. Value: readout, where "
        "already known.",
        "s",
        "Once per camera.",
    ),
    EventKind.ROLLING_COLUMNS: About(
        "The same, read by columns: a phone held upright.",
        "s",
        "Once per camera.",
    ),
    EventKind.LENS_TERM_MISSING: About(
        "The lens needs one more distortion term than radtan has: use `plumb_bob`.", "", "Once per camera."
    ),
    EventKind.DEVICE_REPLACED: About(
        "A device was replaced by another one; calibration starts over. The text has the serial numbers.",
        "",
        "When its status has named another serial number three times in a row.",
    ),
    EventKind.ESTIMATOR_RESTARTED: About(
        "The estimator failed and was restarted. The text says why.",
        "",
        "When it raises an error, or uses no images for 15 s.",
    ),
    EventKind.OTHER: About("Text from a log or program of another version.", "", "Never by this version."),
}
