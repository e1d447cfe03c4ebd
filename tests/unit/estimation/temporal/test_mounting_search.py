"""mounting_search.py: mountings found in the tracks of a flat scene."""

from functools import cached_property

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks
from vical_mocks.trajectory import hand_motion

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.temporal.epipolar_fit import epipolar_fit
from vical_daemon.estimation.temporal.mounting_search import even_rotations, likely_mountings


class Wall:
    """Six seconds before a flat wall, turning at some 25 deg/s."""

    def __init__(self, seed):
        plain = reference_rig(seed)
        motion = hand_motion(seed, 25.0, T_imu_cam=(plain.R_imu_cam, plain.p_imu_cam))
        rig = reference_rig(seed, trajectory=motion)
        rng = np.random.default_rng(seed)
        marks = np.column_stack([rng.uniform(-1.5, 1.9, 200), rng.uniform(-1.5, 1.7, 200), np.full(200, 0.9)])
        run = simulate_tracks(seed, 6.0, rig=rig, landmarks_m=marks, camera_rate_hz=10.0, corner_sigma_px=0.3)
        self.rig, self.t, self.gyro = rig, run.t_imu_ns * 1e-9, run.gyro_rps
        self.frames = [
            (f.t_cam_ns * 1e-9, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px)) for f in run.frames
        ]
        self.lens = (np.array(rig.lens.intrinsics), np.array(rig.lens.distortion), rig.lens.model)

    @cached_property
    def found(self):
        """Likely mountings with nothing known."""
        return likely_mountings(self.t, self.gyro, self.frames, self.lens, np.linspace(-0.2, 0.2, 5))

    @cached_property
    def best(self):
        """The best of the fits from all of them."""
        return self.best_fit()

    def fit(self, *seed, **how):
        return epipolar_fit(self.t, self.gyro, self.frames, self.lens, *seed, **how)

    def best_fit(self, **how):
        fits = [self.fit(*seed, **how) for seed in self.found]
        return min((f for f in fits if f), key=lambda f: f.error / f.inliers)

    def off_deg(self, R):
        return float(np.rad2deg(np.linalg.norm(so3.log(self.rig.R_imu_cam.T @ R))))


@pytest.fixture(scope="module", params=range(1, 6))
def wall(request):
    return Wall(request.param)


def test_the_mounting_is_among_the_likely_ones_with_nothing_known(wall):
    assert min(wall.off_deg(R) for R, _ in wall.found[:2]) < 27.0
    assert wall.off_deg(wall.best.R_imu_cam) < 8.0
    assert abs(wall.best.timeshift_s) < 5e-3


def test_looking_around_roughly_finds_the_same_place(wall):
    """Fits that are only compared took all their steps, up to 70 % of the CPU time of an attempt."""
    rough = wall.best_fit(roughly=True)
    here, there = (wall.fit(best.R_imu_cam, best.timeshift_s) for best in (rough, wall.best))
    assert np.rad2deg(np.linalg.norm(so3.log(here.R_imu_cam.T @ there.R_imu_cam))) < 0.4
    assert abs(here.timeshift_s - there.timeshift_s) < 4e-4
    assert here.error / here.inliers < 1.01 * there.error / there.inliers


def test_only_mountings_near_what_is_known_are_returned(wall):
    near = wall.rig.R_imu_cam @ so3.exp(np.deg2rad([0.0, 30.0, 0.0]))
    found = likely_mountings(wall.t, wall.gyro, wall.frames, wall.lens, np.zeros(1), near)
    assert len(found) == 5
    assert all(np.linalg.norm(so3.log(near.T @ R)) < np.deg2rad(60.0) for R, _ in found)
    assert min(wall.off_deg(R) for R, _ in found) < 27.0


def test_any_rotation_is_near_one_that_is_tried():
    tried, any_ = Rotation.from_matrix(even_rotations(600)), Rotation.random(20000, rng=1)
    half = np.clip(np.abs(any_.as_quat() @ tried.as_quat().T).max(axis=1), 0.0, 1.0)
    assert np.rad2deg(2.0 * np.arccos(half.min())) < 28.0
