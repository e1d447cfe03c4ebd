"""What temporal calibration answers: the result of `td_icp`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.temporal.orientation_problem import OrientationSensor

OK = "ok"
DEGENERATE = "degenerate"
REFUSED = "refused"


@dataclass(frozen=True)
class TdIcpResult:
    """What registration found.

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
