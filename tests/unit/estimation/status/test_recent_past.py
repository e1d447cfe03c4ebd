"""What is remembered of the last seconds."""

from types import SimpleNamespace

import numpy as np
from vical_mocks.rig import reference_rig

from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.status import recent_past
from vical_daemon.estimation.status.recent_past import RecentPast


def test_a_search_for_a_step_looks_at_each_image_once(monkeypatch):
    """Stretches of 10, 15 and 30 images, and those from before, have most of them in common."""
    rig, asked = reference_rig(4), []

    def poses_of(frames, lens, target):
        asked.extend(t for t, _ in frames)
        R = rig.trajectory.R_world_imu(np.array([t for t, _ in frames])) @ rig.R_imu_cam
        return [
            SimpleNamespace(t_cam_s=t, R_target_cam=r, sigma_rad=2e-3)
            for (t, _), r in zip(frames, R, strict=True)
        ]

    monkeypatch.setattr(recent_past, "poses_of", poses_of)
    buffer, t_s = ImuBuffer(0), np.arange(0.0, 10.0, 0.01)
    for t, gyro, force in zip(t_s, *rig.imu_reading(t_s), strict=True):
        buffer.append(t, gyro, force)
    lens = SimpleNamespace(R_imu_cam=rig.R_imu_cam, timeshift_s=0.0, intrinsics=np.full(4, 500.0))
    state = SimpleNamespace(t_s=6.0, cameras={"cam0": lens}, gyro_bias=np.zeros(3))
    past = RecentPast()
    past._frames["cam0"] = [
        (t, PointsFrame("cam0", round(t * 1e9), np.zeros(0, int), np.zeros((0, 2))), True)
        for t in np.arange(4.0, 8.0, 0.05).tolist()
    ]
    assert past.find_shift(SimpleNamespace(state=state), "cam0", buffer, np.zeros((0, 3))) is None
    assert len(asked) == len(set(asked)) == 28 + 30
