"""Two boards, and a hand-held rig and a camera in front of them."""

from __future__ import annotations

from typing import Any

from vical_daemon.vision.target import AprilGrid, Checkerboard, Target
from vical_mocks.camera import CameraSettings, SimulatedCamera
from vical_mocks.lens import Lens
from vical_mocks.rig import Rig, reference_rig
from vical_mocks.trajectory import hand_motion

DISTORTION = (-0.28, 0.07, 2e-4, 2e-5)
APRILGRID, CHECKERBOARD = AprilGrid(6, 6, 0.088, 0.3), Checkerboard(8, 7, 0.05, 0.05)


def rig_before(target: Target, distance_m: float, seed: int = 1, **changes: Any) -> Rig:
    """A hand-held rig before a board; reference lens with EuRoC-like distortion."""
    side = 1 if isinstance(target, AprilGrid) else -1
    size = target.points_m[:, :2].max(axis=0)
    rig = reference_rig(seed)
    motion = hand_motion(
        seed,
        T_imu_cam=(rig.R_imu_cam, rig.p_imu_cam),
        side=side,
        distance_m=distance_m,
        board_size_m=(float(size[0]), float(size[1])),
    )
    return reference_rig(seed, trajectory=motion, lens=Lens(distortion=DISTORTION), side=side, **changes)


def film(target: Target, distance_m: float, seed: int = 1, **settings: Any) -> SimulatedCamera:
    """The camera of that rig."""
    rig = rig_before(target, distance_m, seed)
    return SimulatedCamera(target, rig.lens, rig.camera_pose_target, CameraSettings(**settings), seed)
