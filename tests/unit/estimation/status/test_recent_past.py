"""What is remembered of the last seconds."""

from types import SimpleNamespace

import numpy as np
from vical_mocks.rig import reference_rig

from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.status import recent_past
from vical_daemon.estimation.status.recent_past import RecentPast

RIG = reference_rig(4)
FRAMES_S = np.arange(4.0, 8.0, 0.05).tolist()


def remembered(monkeypatch, state_s, gyro_bias, late_s=lambda t: 0.0):
    """Images of four seconds, late by some time; a filter of an instant; readings; what was looked at."""
    asked = []

    def poses_of(frames, lens, target):
        asked.extend(t for t, _ in frames)
        R = RIG.trajectory.R_world_imu(np.array([t + late_s(t) for t, _ in frames])) @ RIG.R_imu_cam
        return [
            SimpleNamespace(t_cam_s=t, R_target_cam=r, sigma_rad=2e-3)
            for (t, _), r in zip(frames, R, strict=True)
        ]

    monkeypatch.setattr(recent_past, "poses_of", poses_of)
    buffer, t_s = ImuBuffer(0), np.arange(0.0, 10.0, 0.01)
    for t, gyro, force in zip(t_s, *RIG.imu_reading(t_s), strict=True):
        buffer.append(t, gyro, force)
    lens = SimpleNamespace(R_imu_cam=RIG.R_imu_cam, timeshift_s=0.0, intrinsics=np.full(4, 500.0))
    state = SimpleNamespace(t_s=state_s, cameras={"cam0": lens}, gyro_bias=gyro_bias)
    past = RecentPast()
    past._frames["cam0"] = [
        (t, PointsFrame("cam0", round(t * 1e9), np.zeros(0, int), np.zeros((0, 2))), True) for t in FRAMES_S
    ]
    return past, SimpleNamespace(state=state), buffer, asked


def test_a_search_for_a_step_looks_at_each_image_once(monkeypatch):
    """Stretches of 10, 15 and 30 images, and those from before, have most of them in common."""
    past, f, buffer, asked = remembered(monkeypatch, 6.0, np.zeros(3))
    assert past.find_shift(f, "cam0", buffer, np.zeros((0, 3))) is None
    assert len(asked) == len(set(asked)) == 28 + 30


def test_images_that_were_used_after_the_step_do_not_say_how_well_images_usually_fit(monkeypatch):
    """They miss by a whole step: nothing was sure beside that, and a clock set by 0.5 s was `bumped`."""
    past, f, buffer, _ = remembered(
        monkeypatch, 7.9, RIG.gyro_bias.value(5.0), late_s=lambda t: 0.5 * (t > 7.41)
    )
    found = past.find_shift(f, "cam0", buffer, np.zeros((0, 3)))
    assert found is not None
    assert found.stepped
    assert abs(found.timeshift_s - 0.5) < 4.0 * found.sigma_s + 1e-3
