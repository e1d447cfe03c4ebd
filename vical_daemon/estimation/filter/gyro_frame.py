"""The frame of whoever integrates a gyro's readings as they are.

Where scale and alignment of an IMU are not true, its gyro's matrix is symmetric in one frame and its
accelerometer's lower triangular in another; the mounting is known twice as well in the first.
[docs/math/filter.md, after eq. (18)]
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry.so3 import exp_one, hat
from vical_daemon.estimation.measurements import FloatArray


def in_gyro_frame(f: CalibrationFilter) -> CalibrationFilter:
    """Mounting and lever arm in the frame in which M_g is symmetric, to first order in its entries."""
    if f.layout.gyro_matrix is None:
        return f
    turned = turn(f.S[f.layout.gyro_matrix].reshape(3, 3, -1))
    back = exp_one(-turn(f.state.gyro_matrix))
    S, cameras = f.S.copy(), dict(f.state.cameras)
    for name, slices in f.layout.cameras.items():
        if slices.position is None or slices.rotation is None:
            continue
        cam = cameras[name]
        S[slices.rotation] -= cam.R_imu_cam.T @ turned
        S[slices.position] += hat(cam.p_imu_cam) @ turned
        cameras[name] = replace(cam, R_imu_cam=back @ cam.R_imu_cam, p_imu_cam=back @ cam.p_imu_cam)
    state = copy(f.state)
    state.cameras = cameras
    return replace(f, state=state, S=S)


def turn(M: FloatArray) -> FloatArray:
    """The rotation vector whose matrix the antisymmetric part of M is, shape (3, ...)."""
    return np.asarray(0.5 * (M[[2, 0, 1], [1, 2, 0]] - M[[1, 2, 0], [2, 0, 1]]))
