"""The frame of the gyro: against the polar decomposition of the gyro's matrix."""

import numpy as np

from tests.unit.estimation.some_filter import NAME, some_filter
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.model.retract import retract
from vical_daemon.estimation.model.snapshot import in_gyro_frame


def test_the_gyros_frame_is_that_in_which_its_matrix_is_symmetric():
    f, *_ = some_filter(20.0)  # off by 2 %
    where = f.layout.cameras[NAME]

    def by_polar_decomposition(state):
        """By the polar decomposition: M_g = Q A, A symmetric; what the imu frame is called is turned by Q."""
        U, _, Vt = np.linalg.svd(state.gyro_matrix)
        Q, camera = U @ Vt, state.cameras[NAME]
        return Q.T @ camera.R_imu_cam, Q.T @ camera.p_imu_cam

    cameras, S = in_gyro_frame(f.layout, f.state.gyro_matrix, f.state.cameras, f.S)
    R, p = by_polar_decomposition(f.state)
    np.testing.assert_allclose(cameras[NAME].R_imu_cam, R, atol=1e-12)
    np.testing.assert_allclose(cameras[NAME].p_imu_cam, p, atol=1e-12)
    J = np.zeros((6, f.layout.size))
    for k in range(f.layout.size):
        step = np.zeros(f.layout.size)
        step[k] = 1e-6
        (R1, p1), (R0, p0) = (by_polar_decomposition(retract(f.state, f.layout, s)) for s in (step, -step))
        J[:, k] = np.concatenate([p1 - p0, so3.log(R0.T @ R1)]) / 2e-6
    rows = [
        *range(where.position.start, where.position.stop),
        *range(where.rotation.start, where.rotation.stop),
    ]
    expected = J @ f.S @ f.S.T @ J.T
    np.testing.assert_allclose(S[rows] @ S[rows].T, expected, atol=1e-6 * np.abs(expected).max())
