"""Delay and mounting from tracks of unknown points, with the mounting and the delay not known beforehand."""

import numpy as np
from vical_mocks.rotations import log_so3
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.temporal.track_registration import track_registration


def test_tracks_and_a_gyro_give_delay_and_mounting():
    run = simulate_tracks(3, 8.0, timeshift_cam_imu_s=0.03, camera_rate_hz=10.0, corner_sigma_px=0.5)
    base, lens = int(run.t_imu_ns[0]), run.rig.lens
    frames = [
        ((f.t_cam_ns - base) * 1e-9, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px)) for f in run.frames
    ]
    known = (np.array(lens.intrinsics), np.array(lens.distortion), lens.model)
    t_imu = (run.t_imu_ns - base) * 1e-9
    result = track_registration(t_imu, run.gyro_rps, frames, known)
    assert result.status == "ok", result.reason
    assert abs(result.timeshift_cam_imu_s - 0.03) < 4 * result.timeshift_sigma_s < 8e-3
    error = log_so3(result.R_imu_cam.T @ run.rig.R_imu_cam)
    assert np.all(np.abs(error) < 4 * result.rotation_sigma_rad) and np.linalg.norm(error) < 0.02
    assert result.pairs + result.rejected == len(frames)
    short = track_registration(t_imu, run.gyro_rps, frames[:20], known)
    assert short.status == "refused" and "less than 5 s" in short.reason
    wrong = track_registration(t_imu, run.gyro_rps * 180 / np.pi, frames, known)
    assert wrong.status == "refused" and "degrees per second" in wrong.reason
