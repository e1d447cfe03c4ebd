"""Cameras that number the points of one target differently are named; all others pass."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.init.numbering import numbered_differently
from vical_daemon.estimation.init.velocity_gravity_init import RotationsKnown
from vical_daemon.estimation.model.state import CameraState

MOUNTINGS = {"cam0": Rotation.from_euler("xyz", [0.3, -1.2, 2.0]), "cam1": Rotation.from_euler("z", 1.5)}


def known(name, turn, *, shift_s=0.0, begin_s=0.0, count=30):
    """What a camera of a rig in motion sees of a target whose points it numbers as if it were turned."""
    mounting = MOUNTINGS[name]
    t_imu_s = begin_s + 0.1 * np.arange(count)
    attitudes = Rotation.from_rotvec(
        np.stack([np.sin(t_imu_s), np.cos(2.0 * t_imu_s), 0.3 * t_imu_s], axis=1)
    )  # of the imu in the target's frame
    noise = Rotation.from_rotvec(0.02 * np.random.default_rng(0).normal(size=(count, 3)))
    R = (turn * attitudes * mounting * noise).as_matrix()
    poses = [SimpleNamespace(t_cam_s=t - shift_s, R_target_cam=x) for t, x in zip(t_imu_s, R, strict=True)]
    camera = CameraState(
        p_imu_cam=np.zeros(3),
        R_imu_cam=mounting.as_matrix(),
        timeshift_s=shift_s,
        intrinsics=np.array([500.0, 500.0, 320.0, 240.0]),
        distortion=np.zeros(4),
        distortion_model="radtan",
        resolution=(640, 480),
    )
    return RotationsKnown(camera, poses, np.zeros(3))


@pytest.mark.parametrize("angle_deg", [0.0, 5.0])
def test_cameras_that_number_alike_pass(angle_deg):
    turn = Rotation.from_euler("z", angle_deg, degrees=True)
    rig = {
        "cam0": known("cam0", Rotation.identity()),
        "cam1": known("cam1", turn, shift_s=0.2, begin_s=0.03),
    }
    assert numbered_differently(rig) is None


@pytest.mark.parametrize("angle_deg", [90.0, -90.0, 180.0])
def test_a_camera_that_numbers_differently_is_named(angle_deg):
    turn = Rotation.from_euler("z", angle_deg, degrees=True)
    rig = {"cam0": known("cam0", Rotation.identity()), "cam1": known("cam1", turn, shift_s=-0.1)}
    turned = numbered_differently(rig)
    assert turned.other == "cam1"
    assert turned.half == (abs(angle_deg) == 180.0)
    text = str(turned)
    assert "cam0 and cam1 number the points of the target differently" in text
    assert int(text.split("turned by ")[1].split()[0]) == pytest.approx(abs(angle_deg), abs=3)


def test_cameras_that_never_see_the_target_together_cannot_be_compared():
    turn = Rotation.from_euler("z", 180.0, degrees=True)
    rig = {"cam0": known("cam0", Rotation.identity()), "cam1": known("cam1", turn, begin_s=60.0)}
    assert numbered_differently(rig) is None


def test_one_camera_alone_passes():
    assert numbered_differently({"cam0": known("cam0", Rotation.identity())}) is None
