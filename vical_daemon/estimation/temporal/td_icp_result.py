"""What temporal calibration answers: of one camera and an imu, and of several sensors."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.temporal.orientation_problem import OrientationSensor

OK = "ok"
DEGENERATE = "degenerate"
REFUSED = "refused"


@dataclass(frozen=True)
class TdIcpResult:
    """What registration of one sensor with a reference found.

    The attributes name a camera and an imu, which the sensor and the reference usually are.

    Attributes:
        status: "ok"; "degenerate": part of the answer is not determined, `reason` says which; "refused":
            there is no answer, and all numbers are not-a-number.
        reason: Why, in words; empty when ok.
        timeshift_cam_imu_s: t_imu = t_cam + shift, s.
        timeshift_sigma_s: Its standard deviation, s.
        R_imu_cam: Rotation of the camera in the imu frame, shape (3, 3).
        rotation_sigma_rad: Standard deviations of its local (right) error, rad, shape (3,).
        covariance: Of [R_imu_cam (3, local, rad), gyro bias (3, rad/s), shift (s)], shape (7, 7).
        gyro_bias_rps: Bias in the middle of the data, rad/s, shape (3,).
        pairs: Orientations that took part.
        rejected: Orientations refused as outliers or without imu data at their time.
        at_rest: Of the rejected, those left out because the rig rested for most of the recording.
        iterations: Rounds of both iterative phases.
        camera_noise_rad: Measured noise of one orientation, rms per axis, rad (from tracks: of one feature).
        used: Which of the given orientations took part, shape (n,).
        stamp_rate: By how much the delay grows with time in these data, s/s (1e-6: one microsecond a second);
            near zero where both clocks are sound. The shift above is that in the middle of the data.
        stamp_rate_sigma: Its standard deviation, s/s.
        still: Refused because the rig stands still.
        widened: By how much stretches of the data disagree beyond what their noise explains (1: they agree);
            the sigmas are widened by it.
        sensor: The orientations as registered, with stamps from the first gyro sample on; None: from tracks.
    """

    status: str
    reason: str
    timeshift_cam_imu_s: float = float("nan")
    timeshift_sigma_s: float = float("nan")
    R_imu_cam: FloatArray = field(default_factory=lambda: np.full((3, 3), np.nan))
    rotation_sigma_rad: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    covariance: FloatArray = field(default_factory=lambda: np.full((7, 7), np.nan))
    gyro_bias_rps: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    pairs: int = 0
    rejected: int = 0
    at_rest: int = 0
    iterations: int = 0
    camera_noise_rad: float = float("nan")
    used: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    stamp_rate: float = float("nan")
    stamp_rate_sigma: float = float("nan")
    still: bool = False
    widened: float = 1.0
    sensor: OrientationSensor | None = None

    def to_json(self) -> dict[str, object]:
        """Return what `vical td-icp --json` prints."""
        q = so3.quat_from_matrix(self.R_imu_cam) if self.status != REFUSED else np.full(4, np.nan)
        return {
            "status": self.status,
            "reason": self.reason,
            "timeshift_cam_imu_s": _number(self.timeshift_cam_imu_s),
            "timeshift_sigma_s": _number(self.timeshift_sigma_s),
            "R_imu_cam_q_wxyz": [_number(v) for v in q],
            "rotation_sigma_rad": [_number(v) for v in self.rotation_sigma_rad],
            "gyro_bias_rps": [_number(v) for v in self.gyro_bias_rps],
            "pairs": self.pairs,
            "rejected": self.rejected,
            "at_rest": self.at_rest,
            "iterations": self.iterations,
            "camera_noise_rad": _number(self.camera_noise_rad),
            "stamp_rate_ppm": _number(1e6 * self.stamp_rate),
            "stamp_rate_sigma_ppm": _number(1e6 * self.stamp_rate_sigma),
            "widened": self.widened,
        }


def _number(value: float) -> float | None:
    """JSON knows no not-a-number."""
    return float(value) if np.isfinite(value) else None


@dataclass(frozen=True)
class PairDelay:
    """The delay between two sensors: t_b = t_a + timeshift_s."""

    a: str
    b: str
    timeshift_s: float
    timeshift_sigma_s: float


@dataclass(frozen=True)
class JointResult:
    """All sensors together.

    Attributes:
        status: "ok" if every sensor took part, "degenerate" if some did not, "refused" if none did.
        reason: Which did not take part and why, in words.
        reference: Name of the reference.
        sensors: By name; of those that took part.
        pairs: Every pair of sensors, the reference among them.
        names: Order of `covariance`.
        covariance: Of [R_ref_sensor (3, local, rad), timeshift (s)] for each of `names`; (4 S, 4 S).
        gyro_bias_rps: Bias of the reference gyro, shape (3,); zeros without one.
    """

    status: str
    reason: str
    reference: str
    sensors: dict[str, TdIcpResult] = field(default_factory=dict)
    pairs: list[PairDelay] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    gyro_bias_rps: FloatArray = field(default_factory=lambda: np.zeros(3))

    def to_json(self) -> dict[str, object]:
        """Return what `vical td-icp --sensors ... --json` prints."""
        return {
            "status": self.status,
            "reason": self.reason,
            "reference": self.reference,
            "sensors": {
                name: {
                    "timeshift_s": s.timeshift_cam_imu_s,
                    "timeshift_sigma_s": s.timeshift_sigma_s,
                    "R_ref_sensor_q_wxyz": so3.quat_from_matrix(s.R_imu_cam).tolist(),
                    "rotation_sigma_rad": s.rotation_sigma_rad.tolist(),
                    "noise_rad": s.camera_noise_rad,
                    "pairs": s.pairs,
                    "rejected": s.rejected,
                    "widened": s.widened,
                }
                for name, s in self.sensors.items()
            },
            "pairs": [asdict(p) for p in self.pairs],
            "order": self.names,
            "covariance": self.covariance.tolist(),
            "gyro_bias_rps": self.gyro_bias_rps.tolist(),
        }


def pair_delays(names: list[str], timeshifts_s: list[float], covariance: FloatArray) -> list[PairDelay]:
    """All pairs: t_b = t_a + (shift_a - shift_b).

    Args:
        names: Of the reference, whose shift is exactly zero, and of the S sensors.
        timeshifts_s: Of the sensors, s.
        covariance: Of these, s^2, (S, S).
    """
    shift, P = np.array([0.0, *timeshifts_s]), np.zeros((len(names), len(names)))
    P[1:, 1:] = covariance
    variance = np.diagonal(P)[:, None] + np.diagonal(P) - 2.0 * P
    sigma = np.sqrt(np.maximum(variance, 0.0))
    return [
        PairDelay(a, b, float(shift[i] - shift[j]), float(sigma[i, j]))
        for i, a in enumerate(names)
        for j, b in enumerate(names)
        if i < j
    ]
