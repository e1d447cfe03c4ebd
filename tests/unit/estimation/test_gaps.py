"""Words: the right direction and the right motion."""

import numpy as np
import pytest

from vical_daemon.estimation.gaps import gaps
from vical_daemon.estimation.measurements import ConvergenceTargets

TARGETS = ConvergenceTargets(0.005, 0.002, 5e-4)
R_IMU_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along imu x


def covariance(p=(1e-3, 1e-3, 1e-3), r=(1e-3, 1e-3, 1e-3)):
    return np.diag(np.square([*p, *r]))


def test_nothing_missing():
    assert gaps(covariance(), R_IMU_CAM, 1e-4, TARGETS) == []


def test_lever_arm_is_named_in_the_cameras_axes():
    (gap,) = gaps(covariance(p=(0.2, 1e-3, 1e-3)), R_IMU_CAM, 1e-4, TARGETS)
    assert gap.name == "lever arm along the optical axis"
    assert gap.excess == pytest.approx(40.0)
    assert "200.0 mm" in gap.said
    assert "nod" in gap.motion
    assert "shake" in gap.motion
    assert "roll" not in gap.motion


def test_rotation_is_already_local_to_the_camera():
    (gap,) = gaps(covariance(r=(1e-3, 1e-3, 0.1)), R_IMU_CAM, 1e-4, TARGETS)
    assert "roll" in gap.name


def test_worst_comes_first_and_the_delay_counts():
    found = gaps(covariance(p=(0.01, 1e-3, 1e-3)), R_IMU_CAM, 0.05, TARGETS)
    assert [g.name for g in found] == ["time shift", "lever arm along the optical axis"]
