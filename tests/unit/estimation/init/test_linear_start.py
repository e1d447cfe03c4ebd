"""The size of a target by the linear equations of a start, before anything else of the motion is known."""

import numpy as np
import pytest
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.linear_start import LinearMotion, linear_start

SIGMA_M = 2e-3


@pytest.mark.parametrize("size", [1.0, 0.25])
def test_noise_of_positions_does_not_make_a_target_small(size):
    """In slow motion a target as stated had come out at 0.68 of its size, 11 of its sigmas off."""
    run = simulate(2, 8.0, rig=reference_rig(2, mean_rate_dps=14.0))
    buffer = ImuBuffer(0)
    for k, (gyro, force) in enumerate(zip(run.gyro_rps, run.specific_force_mps2, strict=True)):
        buffer.append(k / run.options.imu_rate_hz, gyro, force)
    t_s = np.arange(0.2, 7.8, 0.05)
    R_world_imu, gyro_bias = run.rig.trajectory.R_world_imu(t_s), run.rig.gyro_bias.value(0.0)
    motion = LinearMotion.between(buffer, t_s, R_world_imu, gyro_bias)
    p_m = run.rig.camera_pose_target(t_s)[1]
    p_m = (p_m + SIGMA_M * np.random.default_rng(4).standard_normal(p_m.shape)) / size
    sigma_m = np.full(len(t_s), SIGMA_M / size)
    found = linear_start(motion, p_m, sigma_m, free_size=True, force_sigma=0.01)
    assert abs(found.size - size) < 3.0 * found.sigma_size < 0.3 * size
    np.testing.assert_allclose(found.p_imu_cam, run.rig.p_imu_cam, atol=0.05)
    assert np.linalg.norm(found.gravity) == pytest.approx(9.81, rel=0.05)
