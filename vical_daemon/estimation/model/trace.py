"""How a camera's calibration developed: one entry a second, thinned from the front when it grows long."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.result import CameraEstimate, ImuEstimate, Status, TracePoint
from vical_daemon.estimation.significance import EVERY_S

_MOST = 7200  # points kept: two hours at one a second, then half as many of the older half


class Trace:
    """Collects entries of one camera."""

    def __init__(self) -> None:
        self.points: list[TracePoint] = []

    def due(self, t_s: float) -> bool:
        """Whether a second has passed since the last entry."""
        return not self.points or t_s - self.points[-1].t_s >= EVERY_S

    def add(
        self,
        t_s: float,
        e: CameraEstimate,
        nis_per_dof: float,
        status: Status,
        imu: ImuEstimate,
    ) -> None:
        """Put an estimate down.

        Args:
            t_s: Since the first sample, s.
            e: What was known then.
            nis_per_dof: Consistency then.
            status: And where the calibration stood.
            imu: Biases then.
        """
        sigma = np.sqrt(np.diag(np.array(e.T_imu_cam.covariance)))
        pose = e.T_imu_cam
        self.points.append(
            TracePoint(
                t_s,
                pose.p_m,
                sigma[:3].tolist(),
                pose.q_wxyz,
                sigma[3:].tolist(),
                e.timeshift_cam_imu_s,
                e.timeshift_sigma_s,
                nis_per_dof,
                str(status),
                imu.gyro_bias_rps,
                imu.gyro_bias_sigma_rps,
                imu.accel_bias_mps2,
                imu.accel_bias_sigma_mps2,
            )
        )
        if len(self.points) > _MOST:
            del self.points[1 : _MOST // 2 : 2]
