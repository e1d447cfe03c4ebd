"""How the calibration of each camera developed: one entry for each estimate, thinned when there are many."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from vical_daemon.estimation.result import CalibrationEstimate

_MOST = 7200  # points kept: two hours at one a second, then half as many of the older half


class Trace:
    """Collects entries from estimates.

    Attributes:
        points: By camera, oldest first: `t_s`, s since the first sample, values and sigmas of mounting, time
            shift and biases as in `CalibrationEstimate`, and its status.
    """

    def __init__(self, cameras: Iterable[str]) -> None:
        self.points: dict[str, list[dict[str, Any]]] = {name: [] for name in cameras}

    def take(self, estimate: CalibrationEstimate) -> None:
        """Put an estimate down; one without newer data is left out."""
        imu, t_s = estimate.imu, estimate.duration_s
        for name, points in self.points.items():
            camera = estimate.cameras.get(name)
            if camera is None or (points and t_s <= points[-1]["t_s"]):
                continue
            pose = camera.T_imu_cam
            sigma = np.sqrt(np.diag(np.array(pose.covariance))).tolist()
            points.append(
                {
                    "t_s": t_s,
                    "p_m": pose.p_m,
                    "p_sigma_m": sigma[:3],
                    "q_wxyz": pose.q_wxyz,
                    "r_sigma_rad": sigma[3:],
                    "timeshift_s": camera.timeshift_cam_imu_s,
                    "timeshift_sigma_s": camera.timeshift_sigma_s,
                    "nis_per_dof": estimate.nis_per_dof,
                    "status": str(estimate.status),
                    "gyro_bias_rps": imu.gyro_bias_rps if imu else [],
                    "gyro_bias_sigma_rps": imu.gyro_bias_sigma_rps if imu else [],
                    "accel_bias_mps2": imu.accel_bias_mps2 if imu else [],
                    "accel_bias_sigma_mps2": imu.accel_bias_sigma_mps2 if imu else [],
                }
            )
            if len(points) > _MOST:
                del points[1 : _MOST // 2 : 2]
