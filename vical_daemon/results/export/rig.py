"""A rig's calibration as plain data, independent of any file format."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, ImuNoise
from vical_daemon.estimation.result import Status


class ExportError(ValueError):
    """The calibration cannot be written in that form; the message says what is missing."""


@dataclass(frozen=True, slots=True)
class RigCamera:
    """One calibrated camera.

    Attributes:
        name: As in the config.
        R_imu_cam: Maps cam vectors into imu, shape (3, 3).
        p_imu_cam: Camera origin in the imu frame, m, shape (3,).
        timeshift_cam_imu_s: t_imu = t_cam + timeshift_cam_imu_s, s.
        intrinsics: fx fy cx cy, px.
        distortion_model: radtan, plumb_bob or equidistant.
        distortion: k1 k2 p1 p2 [k3] or k1 k2 k3 k4.
        resolution: width, height, px; None: not known.
        covariance: Of [px py pz rx ry rz], m and rad, rotation error local, shape (6, 6); None: not known.
        timeshift_sigma_s: Its standard deviation, s; None: not known.
        readout_s: First to last row of a rolling shutter, s; 0: global shutter.
        readout_axis: What it reads one after the other, `rows` or `columns`; empty: rows, or not known.
        topic: ROS topic of the images.
        rate_hz: Frames per second; None: not known.
        unobservable: Directions that the motion did not reveal: do not use their values.
        lens_sigma: Standard deviations of fx fy cx cy and the distortion; (): not known.
        calibration_covariance: See `CameraEstimate`, shape (7 + n, 7 + n); None: not known.
        model_fits: See `CameraEstimate`.

    Raises:
        ExportError: A number that is not finite, or a focal length of 0 or less: no file that holds such
            values is a calibration.
    """

    name: str
    R_imu_cam: FloatArray
    p_imu_cam: FloatArray
    timeshift_cam_imu_s: float
    intrinsics: tuple[float, float, float, float]
    distortion_model: str
    distortion: tuple[float, ...]
    resolution: tuple[int, int] | None = None
    covariance: FloatArray | None = None
    timeshift_sigma_s: float | None = None
    readout_s: float = 0.0
    topic: str = ""
    rate_hz: float | None = None
    unobservable: tuple[str, ...] = ()
    readout_axis: str = ""
    lens_sigma: tuple[float, ...] = ()
    calibration_covariance: FloatArray | None = None
    model_fits: bool | None = None

    def __post_init__(self) -> None:
        numbers = {
            "rotation": self.R_imu_cam,
            "position": self.p_imu_cam,
            "time shift": self.timeshift_cam_imu_s,
            "intrinsics": self.intrinsics,
            "distortion": self.distortion,
            "covariance": () if self.covariance is None else self.covariance,
            "calibration_covariance": ()
            if self.calibration_covariance is None
            else self.calibration_covariance,
        }
        for what, values in numbers.items():
            if not np.isfinite(np.asarray(values, dtype=np.float64)).all():
                raise ExportError(f"{self.name}: a number of its {what} is not finite")
        if min(self.intrinsics[:2]) <= 0.0:
            raise ExportError(f"{self.name}: its focal length must be above 0")

    @property
    def T_imu_cam(self) -> FloatArray:
        """Pose of the camera in the imu frame, shape (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = self.R_imu_cam
        T[:3, 3] = self.p_imu_cam
        return T

    @property
    def T_cam_imu(self) -> FloatArray:
        """Pose of the imu in the camera frame (Kalibr's direction), shape (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = self.R_imu_cam.T
        T[:3, 3] = -self.R_imu_cam.T @ self.p_imu_cam
        return T

    @property
    def sigmas(self) -> str:
        """Standard deviations as text: lever arm along the axes of the imu, rotation about the camera's."""
        parts = []
        if self.covariance is not None:
            sigma = np.sqrt(np.diag(self.covariance))
            parts.append("lever arm " + " ".join(f"{1e3 * v:.2g}" for v in sigma[:3]) + " mm")
            parts.append("rotation " + " ".join(f"{np.rad2deg(v):.2g}" for v in sigma[3:]) + " deg")
        if self.timeshift_sigma_s is not None:
            parts.append(f"time shift {1e3 * self.timeshift_sigma_s:.2g} ms")
        return ", ".join(parts)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px.

        Raises:
            ExportError: Not known.
        """
        if self.resolution is None:
            raise ExportError(
                f"{self.name}: the image size is not in the source; give it with --resolution WIDTHxHEIGHT"
            )
        return self.resolution


@dataclass(frozen=True, slots=True)
class Rig:
    """A calibrated rig.

    Attributes:
        cameras: By name, in the order in which they are exported.
        noise: Densities of the imu.
        gyro_bias_rps: Last known bias, rad/s.
        accel_bias_mps2: Last known bias, m/s^2.
        gyro_matrix: M_g of omega = M_g (omega_m - b_g), shape (3, 3).
        accel_matrix: M_a of f = M_a (f_m - b_a), lower triangular, shape (3, 3).
        gravity_mps2: Magnitude of gravity.
        imu_topic: ROS topic of the imu.
        imu_frame: Name of the imu frame for ROS, as it is on the bus.
        note: One line on where the numbers come from.
        status: Status of the calibration (`Status`); "": unknown.
        reason: Reason of the status, as text.
        t_ns: Stamp of the newest data used, UNIX ns; 0: not known.
        devices: Serial numbers by device, e.g. ``camera/cam0``.
        duration_s: Seconds of data used; 0: not known.
        reading_hashes: See `CalibrationEstimate`; (): not known.
        fixed: What was held at given values (as `--fix`).
        bias_sigmas: Of gyro (rad/s) and accelerometer (m/s^2) biases, shape (6,); None: not known.
    """

    cameras: dict[str, RigCamera]
    noise: ImuNoise = field(default_factory=ImuNoise)
    gyro_bias_rps: FloatArray = field(default_factory=lambda: np.zeros(3))
    accel_bias_mps2: FloatArray = field(default_factory=lambda: np.zeros(3))
    gyro_matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    accel_matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    gravity_mps2: float = 9.80665
    imu_topic: str = "/imu0"
    imu_frame: str = "imu"
    note: str = ""
    status: str = ""
    reason: str = ""
    t_ns: int = 0
    devices: dict[str, str] = field(default_factory=dict)
    duration_s: float = 0.0
    reading_hashes: tuple[int, ...] = ()
    fixed: tuple[str, ...] = ()
    bias_sigmas: FloatArray | None = None

    @property
    def header(self) -> str:
        """The header of every file: source, status, date, devices and sigmas."""
        lines = [self.note] if self.note else []
        if self.status:
            not_yet = "" if self.status == Status.CONVERGED else "NOT CONVERGED: "
            why = f" ({self.reason})" if self.reason and not_yet else ""
            lines.append(f"status: {not_yet}{self.status}{why}")
        if self.t_ns:
            lines.append(f"data until {datetime.fromtimestamp(self.t_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC")
        if self.devices:
            lines.append("devices: " + ", ".join(f"{name} {serial}" for name, serial in self.devices.items()))
        for camera in self.cameras.values():
            if sigmas := camera.sigmas:
                lines.append(f"{camera.name}, one sigma: {sigmas}")
            lines += [f"{camera.name}, NOT DETERMINED by the motion: {what}" for what in camera.unobservable]
        return "\n".join(" ".join(line.split()) for line in lines)

    def only_camera(self, format_name: str) -> RigCamera:
        """Return the camera of a format that holds one.

        Raises:
            ExportError: There are several (choose with --camera).
        """
        if len(self.cameras) != 1:
            names = ", ".join(self.cameras)
            raise ExportError(
                f"a file for {format_name} holds one camera; choose one of {names} with --camera"
            )
        return next(iter(self.cameras.values()))
