"""Differences of two calibrations in joint sigmas, against scipy's rotations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.harness import web_feed

from vical_daemon.results.differences import differences


def test_differences_are_component_by_component_in_joint_sigmas():
    old = web_feed.estimate(30.0, np.random.default_rng(0)).cameras["cam0"]
    q = Rotation.from_quat(old.T_imu_cam.q_wxyz, scalar_first=True)
    turned = (q * Rotation.from_rotvec([1e-3, -2e-3, 3e-3])).as_quat(scalar_first=True).tolist()
    pose = replace(old.T_imu_cam, p_m=[old.T_imu_cam.p_m[0] + 3e-3, *old.T_imu_cam.p_m[1:]], q_wxyz=turned)
    new = replace(old, T_imu_cam=pose, timeshift_cam_imu_s=old.timeshift_cam_imu_s - 1e-4)
    found = {d.name: d for d in differences(old, new)}
    sigma_p, sigma_t = 4e-3 / np.sqrt(30.0), 2e-4 / np.sqrt(30.0)
    assert found["lever arm x"].value == pytest.approx(3.0)
    assert found["lever arm x"].sigmas == pytest.approx(3e-3 / (np.sqrt(2) * sigma_p))
    assert found["lever arm y"].value == pytest.approx(0.0, abs=1e-9)
    assert [found[f"rotation about cam {a}"].value for a in "xyz"] == pytest.approx(
        np.degrees([1e-3, -2e-3, 3e-3]), rel=1e-6
    )
    assert found["time shift"].value == pytest.approx(-0.1)
    assert found["time shift"].sigmas == pytest.approx(1e-4 / (np.sqrt(2) * sigma_t))
    fixed = replace(old, timeshift_sigma_s=0.0)
    assert differences(fixed, fixed)[-1].sigmas == 0.0
