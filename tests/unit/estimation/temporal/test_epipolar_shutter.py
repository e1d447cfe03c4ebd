"""epipolar_shutter.py: a rolling shutter shows in tracks and a gyro alone, whichever way it reads."""

import numpy as np
import pytest
from vical_mocks.rig import reference_rig
from vical_mocks.rotations import log_so3
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.temporal.epipolar_shutter import rolling_axis
from vical_daemon.estimation.temporal.track_registration import track_registration


@pytest.mark.parametrize(("axis", "readout_s"), [("rows", 0.02), ("columns", -0.025)])
def test_a_shutter_that_rolls_is_found_and_the_mounting_with_it(axis, readout_s):
    rig = reference_rig(3, timeshift_cam_imu_s=0.03, readout_s=readout_s, readout_axis=axis)
    run = simulate_tracks(3, 12.0, rig=rig, camera_rate_hz=15.0, corner_sigma_px=0.3)
    base, lens = int(run.t_imu_ns[0]), run.rig.lens
    frames = [
        ((f.t_cam_ns - base) * 1e-9, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px)) for f in run.frames
    ]
    known = (np.array(lens.intrinsics), np.array(lens.distortion), lens.model)
    t_imu = (run.t_imu_ns - base) * 1e-9
    result = track_registration(t_imu, run.gyro_rps, frames, known, resolution=lens.resolution)
    assert result.status == "ok" and result.readout_axis == axis
    assert abs(result.readout_s - readout_s) < 4.0 * result.readout_sigma_s < 0.1 * abs(readout_s)
    assert abs(result.timeshift_cam_imu_s - 0.03) < 4.0 * result.timeshift_sigma_s < 1e-3
    assert np.all(np.abs(log_so3(result.R_imu_cam.T @ rig.R_imu_cam)) < 4.0 * result.rotation_sigma_rad)
    assert result.to_json()["readout_axis"] == axis


def test_only_a_readout_beyond_its_sigmas_is_one():
    sure, wide = np.diag([1e-3, 1e-3]) ** 2, np.diag([1e-2, 1e-2]) ** 2
    assert rolling_axis([(np.array([1e-3, -8e-3]), sure), (np.array([0.0, 0.04]), wide)]) == "rows"
    assert rolling_axis([(np.array([4e-3, 0.0]), sure)]) == ""
    assert rolling_axis([(np.array([5e-4, 0.0]), sure * 1e-4)]) == ""  # surely there, and not worth a word
    assert rolling_axis([(np.zeros(2), np.full((2, 2), np.inf))]) == rolling_axis([]) == ""
