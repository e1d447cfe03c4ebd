"""A drive along a corridor: heading along the path, calm, with features ahead all the way."""

from __future__ import annotations

import numpy as np
import pytest
from vical_mocks.driving import DOWN, driving, simulate_drive
from vical_mocks.rig import reference_rig
from vical_mocks.rotations import exp_so3

T_S = np.linspace(0.0, 30.0, 601)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_robot_looks_where_it_goes(seed):
    motion = driving(seed, speed_mps=0.8)
    ahead, v = motion.R_world_imu(T_S)[..., 2], motion.v_world_imu(T_S)
    level = v[:, [0, 2]] / np.linalg.norm(v[:, [0, 2]], axis=1)[:, None]
    off = np.arccos(np.clip((ahead[:, [0, 2]] * level).sum(axis=1), -1.0, 1.0))
    assert np.rad2deg(np.median(off)) < 5.0  # of steering angles up to 30 deg
    assert np.ptp(motion.p_world_imu(T_S)[:, 1]) < 0.01
    assert 2.0 < motion.mean_rate_dps(30.0) < 25.0


def test_features_are_in_view_until_the_end_whatever_the_mounting():
    R = exp_so3(np.array([0.3, -1.2, 2.0]))
    rig = reference_rig(3, R_imu_cam=R, p_imu_cam=np.array([0.1, 0.0, 0.05]))
    run = simulate_drive(3, 12.0, rig=rig, camera_rate_hz=5.0)
    assert min(len(frame.ids) for frame in run.frames) >= 20
    still = run.specific_force_mps2.mean(axis=0) @ (R @ -DOWN)
    assert still == pytest.approx(9.8, abs=0.3)  # on average the floor pushes up
