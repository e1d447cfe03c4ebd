"""How a calibration differs from another of the same camera, component by component, in joint sigmas."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.result import CameraEstimate

_PARTS = (
    *((f"lever arm {axis}", "mm", 1e3) for axis in "xyz"),
    *((f"rotation about cam {axis}", "°", 180.0 / math.pi) for axis in "xyz"),
)


@dataclass(frozen=True, slots=True)
class Difference:
    """One component.

    Attributes:
        name: Of the component.
        unit: Of `value` and `sigma`.
        value: New minus old.
        sigma: Root of the sum of both variances: the two are taken as independent.
    """

    name: str
    unit: str
    value: float
    sigma: float

    @property
    def sigmas(self) -> float:
        """The difference in joint sigmas; infinite where neither has a sigma and they differ."""
        if self.sigma > 0.0:
            return abs(self.value) / self.sigma
        return 0.0 if self.value == 0.0 else math.inf


def differences(old: CameraEstimate, new: CameraEstimate) -> list[Difference]:
    """Return lever arm (imu frame), rotation (about the camera's axes) and time shift, new minus old."""
    a, b = old.T_imu_cam, new.T_imu_cam
    variance = np.diag(np.asarray(a.covariance)) + np.diag(np.asarray(b.covariance))
    R_old, R_new = (so3.matrix_from_quat(np.asarray(pose.q_wxyz)) for pose in (a, b))
    change = np.concatenate([np.subtract(b.p_m, a.p_m), so3.log(R_old.T @ R_new)])
    sigma = np.sqrt(np.maximum(variance, 0.0))
    found = [
        Difference(name, unit, scale * float(v), scale * float(s))
        for (name, unit, scale), v, s in zip(_PARTS, change, sigma, strict=True)
    ]
    shift = new.timeshift_cam_imu_s - old.timeshift_cam_imu_s
    joint = math.hypot(old.timeshift_sigma_s, new.timeshift_sigma_s)
    return [*found, Difference("time shift", "ms", 1e3 * shift, 1e3 * joint)]
