"""The IMU frame in which the gyro's matrix is symmetric: that of a plain integration of its readings.

With errors of scale and alignment, the gyro's matrix is symmetric in one frame, and the accelerometer's is
lower triangular in another. The mounting is known twice as well in the first.
[docs/math/filter.md, after eq. (18)]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.geometry.so3 import exp_one, hat
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import CameraState, Layout


def in_gyro_frame(
    layout: Layout, gyro_matrix: FloatArray, cameras: Mapping[str, CameraState], S: FloatArray
) -> tuple[dict[str, CameraState], FloatArray]:
    """Mounting and lever arm in the frame in which M_g is symmetric, to first order in its entries.

    Args:
        layout: Where the errors live.
        gyro_matrix: M_g.
        cameras: By name.
        S: Square root of the covariance, shape (n, m).

    Returns:
        Cameras and square root in that frame.
    """
    found = dict(cameras)
    if layout.gyro_matrix is None:
        return found, S
    turned = turn(S[layout.gyro_matrix].reshape(3, 3, -1))
    back, S = exp_one(-turn(gyro_matrix)), S.copy()
    for name, where in layout.cameras.items():
        if where.position is None or where.rotation is None:
            continue
        cam = found[name]
        S[where.rotation] -= cam.R_imu_cam.T @ turned
        S[where.position] += hat(cam.p_imu_cam) @ turned
        found[name] = replace(cam, R_imu_cam=back @ cam.R_imu_cam, p_imu_cam=back @ cam.p_imu_cam)
    return found, S


def turn(M: FloatArray) -> FloatArray:
    """The rotation vector whose matrix the antisymmetric part of M is, shape (3, ...)."""
    return np.asarray(0.5 * (M[[2, 0, 1], [1, 2, 0]] - M[[1, 2, 0], [2, 0, 1]]))
