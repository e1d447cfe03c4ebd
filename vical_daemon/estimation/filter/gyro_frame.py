"""The IMU frame in which the gyro's matrix is symmetric: that of a plain integration of its readings.

With errors of scale and alignment, the gyro's matrix is symmetric in one frame, and the accelerometer's is
lower triangular in another. The mounting is known twice as well in the first.
[docs/math/filter.md, after eq. (18)]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.geometry.so3 import hat
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import CameraState, Layout


def in_gyro_frame(
    layout: Layout, gyro_matrix: FloatArray, cameras: Mapping[str, CameraState], S: FloatArray
) -> tuple[dict[str, CameraState], FloatArray]:
    """Mounting and lever arm in the frame in which M_g is symmetric.

    With the polar decomposition M_g = Q A, A symmetric, that frame is turned by Q. A change dM of M_g turns
    it by w, (tr(A) I - A) w = 2 k, hat(k) the antisymmetric part of Q^T dM. (tested against differences)

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
    U, scales, Vt = np.linalg.svd(gyro_matrix)
    back, A, S = (U @ Vt).T, (Vt.T * scales) @ Vt, S.copy()
    changes = np.einsum("ij,jkn->ikn", back, S[layout.gyro_matrix].reshape(3, 3, -1))
    turned = np.linalg.solve(np.trace(A) * np.eye(3) - A, 2.0 * _antisymmetric(changes))
    for name, where in layout.cameras.items():
        if where.position is None or where.rotation is None:
            continue
        cam = found[name]
        R, p = back @ cam.R_imu_cam, back @ cam.p_imu_cam
        S[where.rotation] -= R.T @ turned
        S[where.position] = back @ S[where.position] + hat(p) @ turned
        found[name] = replace(cam, R_imu_cam=R, p_imu_cam=p)
    return found, S


def _antisymmetric(M: FloatArray) -> FloatArray:
    """The vector whose cross-product matrix the antisymmetric part of M is, shape (3, ...)."""
    return np.asarray(0.5 * (M[[2, 0, 1], [1, 2, 0]] - M[[1, 2, 0], [2, 0, 1]]))
