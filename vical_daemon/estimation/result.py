"""The answer: one calibration estimate, as the filter gives it and as `vical calibrate --json` prints it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

from vical_daemon.estimation.events import Event
from vical_daemon.estimation.guidance import Guidance, WeakDirection
from vical_daemon.estimation.wording import direction_document, event_document, guidance_document

NEARLY = 0.95
"""Progress of what has not converged, at most."""


class Status(StrEnum):
    """Where a calibration stands."""

    WAITING = "waiting"
    INITIALISING = "initialising"
    CONVERGING = "converging"
    CONVERGED = "converged"
    DEGENERATE = "degenerate"
    INCONSISTENT = "inconsistent"


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """`T_imu_cam`: pose of the camera in the imu frame.

    Attributes:
        p_m: Lever arm: camera origin in the imu frame, m, 3 numbers.
        q_wxyz: Hamilton unit quaternion, w >= 0, maps cam vectors into imu.
        covariance: 6x6, order [px py pz rx ry rz], m and rad, rotation error local (right).
    """

    p_m: list[float]
    q_wxyz: list[float]
    covariance: list[list[float]]


@dataclass(frozen=True, slots=True)
class CameraEstimate:
    """What is known about one camera; lists that are empty were not estimated and not given.

    Attributes:
        T_imu_cam: Extrinsics.
        timeshift_cam_imu_s: t_imu = t_cam + timeshift_cam_imu_s, s.
        timeshift_sigma_s: Its standard deviation, s.
        intrinsics: fx fy cx cy, px.
        intrinsics_sigma: Standard deviations, px (where held fixed: 0 unless images contradict the values).
        distortion_model: radtan, plumb_bob or equidistant.
        distortion: Its coefficients.
        distortion_sigma: Standard deviations.
        reprojection_rms_px: RMS of the residuals of accepted corners, px.
        corner_sigma_px: Measured corner noise per axis, px.
        unobservable: Names of withheld directions, each with the motion that would reveal it (text).
        readout_s: Rolling-shutter readout first to last row, s (0: global shutter).
        readout_sigma_s: Its standard deviation, s.
        resolution: width, height of the images, px; []: not known (it does not travel in the message).
        readout_axis: What a rolling shutter reads one after the other, `rows` or `columns`; empty: rows, or
            not known (it does not travel in the message, but the announcement that found it does).
        withheld: The same as `unobservable`, as data; [] in logs of older versions.
        calibration_covariance: Of [px py pz rx ry rz, time shift, fx fy cx cy, distortion] together, m, rad,
            s, px, rotation error local (right); zero rows where not estimated; lens model errors
            are not correlated with the pose, unlike above; []: not known (it does not travel in the message).
        stamp_jitter_s: Measured jitter of the image stamps, one standard deviation, s; 0: none found.
        model_fits: Images show no errors that last or exceed their noise; None: not known (too few images, or
            read from a message).
    """

    T_imu_cam: PoseEstimate
    timeshift_cam_imu_s: float
    timeshift_sigma_s: float
    intrinsics: list[float]
    intrinsics_sigma: list[float]
    distortion_model: str
    distortion: list[float]
    distortion_sigma: list[float]
    reprojection_rms_px: float
    corner_sigma_px: float = 0.0
    unobservable: list[str] = field(default_factory=list)
    readout_s: float = 0.0
    readout_sigma_s: float = 0.0
    resolution: list[int] = field(default_factory=list)
    readout_axis: str = ""
    withheld: list[WeakDirection] = field(default_factory=list)
    stamp_jitter_s: float = 0.0
    calibration_covariance: list[list[float]] = field(default_factory=list)
    model_fits: bool | None = None


@dataclass(frozen=True, slots=True)
class ImuEstimate:
    """Inertial biases and, where estimated, scale and misalignment, in the imu frame.

    `accel_positions_m`: of the accelerometer's axes x, y, z, if known to be apart or asked for; not on a bus.
    """

    gyro_bias_rps: list[float]
    accel_bias_mps2: list[float]
    gyro_bias_sigma_rps: list[float] = field(default_factory=list)
    accel_bias_sigma_mps2: list[float] = field(default_factory=list)
    gyro_matrix: list[list[float]] = field(default_factory=list)
    accel_matrix: list[list[float]] = field(default_factory=list)
    accel_positions_m: list[list[float]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class HeldOutCheck:
    """One image that the IMU alone predicted, some tenths of a second ahead, before it was used.

    Attributes:
        t_s: Time since the first sample, s.
        ratio: Mean squared error of the prediction over its predicted variance; 1 on average if the stated
            noise of IMU and corners is right.
    """

    t_s: float
    ratio: float


@dataclass(frozen=True, slots=True)
class CalibrationEstimate:
    """Everything the estimator says at one moment.

    Attributes:
        t_ns: Stamp of the newest data used (the imu's clock), ns.
        status: Where the calibration stands.
        reason: Why, in words for a person; empty when converged, unless nothing new arrives.
        progress: 0 to 1.
        guidance: What to do next, as text; empty: nothing missing.
        duration_s: Seconds of data used.
        frames: Camera frames used.
        imu_samples: Inertial samples used.
        cameras: By camera name; empty before the first solution.
        imu: Biases; None before the first solution.
        gravity_world_mps2: Acceleration of free fall in the world (target) frame, m/s^2, of the size that was
            stated; [] before.
        nis_per_dof: Mean normalised innovation squared per degree of freedom; 1 when consistent.
        rejected_fraction: Share of measurements that the gates refused.
        events: Announcements since the last estimate.
        next_motion: The same as `guidance`, as data; says nothing in logs of older versions.
        reading_hashes: By which data are recognised that two calibrations have used, see `ReadingSample`; []:
            not known (it does not travel in the message).
    """

    t_ns: int
    status: Status
    reason: str
    progress: float
    guidance: str
    duration_s: float
    frames: int
    imu_samples: int
    cameras: dict[str, CameraEstimate]
    imu: ImuEstimate | None
    gravity_world_mps2: list[float]
    nis_per_dof: float
    rejected_fraction: float
    events: list[Event] = field(default_factory=list)
    next_motion: Guidance = field(default_factory=Guidance)
    reading_hashes: list[int] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the dictionary that COMMANDS promises (without trace, cpu_s and truth)."""
        document = asdict(self)
        document["events"] = [event_document(event) for event in self.events]
        document["next_motion"] = guidance_document(self.next_motion)
        for name, camera in self.cameras.items():
            document["cameras"][name]["withheld"] = [direction_document(weak) for weak in camera.withheld]
        return document
