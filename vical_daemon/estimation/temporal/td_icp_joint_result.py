"""What joint temporal calibration answers: each sensor against the reference, and every pair."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray


@dataclass(frozen=True)
class SensorDelay:
    """One sensor against the reference.

    Attributes:
        timeshift_s: t_reference = t_sensor + timeshift_s, s.
        timeshift_sigma_s: Its standard deviation, s.
        R_ref_sensor: Rotation of the sensor in the reference sensor's frame, shape (3, 3).
        rotation_sigma_rad: Standard deviations of its local error, rad, shape (3,).
        noise_rad: Measured noise of one orientation, rms per axis, rad.
        pairs: Orientations that took part.
        rejected: Orientations that did not.
        widened: By how much stretches of the data disagree beyond what their noise explains; the sigmas are
            widened by it.
    """

    timeshift_s: float
    timeshift_sigma_s: float
    R_ref_sensor: FloatArray
    rotation_sigma_rad: FloatArray
    noise_rad: float
    pairs: int
    rejected: int
    widened: float = 1.0


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
        sensors: By name.
        pairs: Every pair of sensors, the reference among them.
        names: Order of `covariance`.
        covariance: Of [R_ref_sensor (3, local, rad), timeshift (s)] for each of `names`; (4 S, 4 S).
        gyro_bias_rps: Bias of the reference gyro, shape (3,); zeros without one.
    """

    status: str
    reason: str
    reference: str
    sensors: dict[str, SensorDelay] = field(default_factory=dict)
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
                    "timeshift_s": s.timeshift_s,
                    "timeshift_sigma_s": s.timeshift_sigma_s,
                    "R_ref_sensor_q_wxyz": so3.quat_from_matrix(s.R_ref_sensor).tolist(),
                    "rotation_sigma_rad": s.rotation_sigma_rad.tolist(),
                    "noise_rad": s.noise_rad,
                    "pairs": s.pairs,
                    "rejected": s.rejected,
                    "widened": s.widened,
                }
                for name, s in self.sensors.items()
            },
            "pairs": [
                {
                    "a": p.a,
                    "b": p.b,
                    "timeshift_s": p.timeshift_s,
                    "timeshift_sigma_s": p.timeshift_sigma_s,
                }
                for p in self.pairs
            ],
            "order": self.names,
            "covariance": self.covariance.tolist(),
            "gyro_bias_rps": self.gyro_bias_rps.tolist(),
        }
