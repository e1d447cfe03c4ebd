"""Random rigs: recordings of other days are of the same rig, and share nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from vical_mocks.random_rigs import draw


@pytest.mark.parametrize("target_free", [False, True])
def test_another_day_is_the_same_rig_with_its_own_motion_biases_and_noise(target_free):
    first, again, later = (draw(3, 0.5, target_free=target_free, day=day)[0] for day in (0, 0, 1))
    assert np.array_equal(first.gyro_rps, again.gyro_rps)
    for name in ("R_imu_cam", "p_imu_cam", "gravity_world_mps2", "timeshift_cam_imu_s", "lens", "densities"):
        assert np.array_equal(getattr(first.rig, name), getattr(later.rig, name)), name
    assert first.options == later.options
    assert np.array_equal(first.points_m, later.points_m)
    for name in ("gyro_bias", "accel_bias"):
        assert not np.allclose(*(getattr(run.rig, name).value(0.0) for run in (first, later)))
    t_s = np.array([0.0, 0.3])
    rates = [run.rig.trajectory.omega_imu_rps(t_s) for run in (first, later)]
    assert not np.allclose(*rates, atol=0.01)


def test_a_change_is_in_the_recording():
    moved = np.array([0.0, 0.0, 0.01])
    before, _ = draw(3, 0.5, target_free=False, day=1)
    after, _ = draw(
        3, 0.5, target_free=False, day=1, change=lambda rig: replace(rig, p_imu_cam=rig.p_imu_cam + moved)
    )
    assert after.rig.p_imu_cam == pytest.approx(before.rig.p_imu_cam + moved)
    assert np.array_equal(before.gyro_rps, after.gyro_rps)
    shared = [(a, b) for a, b in zip(before.frames, after.frames, strict=False) if len(a.ids) == len(b.ids)]
    assert shared and not any(np.allclose(a.uv_px, b.uv_px, atol=1e-3) for a, b in shared)
