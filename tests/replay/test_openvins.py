"""Tracks of another project's simulator: ten seconds, mounting unknown, next to that project's figures."""

from pathlib import Path

import numpy as np
import pytest
from vical_mocks.harness.recordings import OPENVINS, camera_of, feed, read

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.target_free import TargetFreeCalibrator

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "openvins_sim_tum"

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(),
    reason="OpenVINS's recording lies in ../shared, whose licence does not let us ship it",
)


def test_ten_seconds_are_better_than_openvins_after_ten_seconds():
    start, truth = camera_of(FOLDER / "initial.yaml"), camera_of(FOLDER / "reference.yaml")
    prior = CameraPrior(
        tuple(start["resolution"]), tuple(start["intrinsics"]), "radtan", tuple(start["distortion_coeffs"])
    )
    calibrator = TargetFreeCalibrator(
        CalibrationOptions(target_free=True, imu_noise=start["noise"]), {"cam0": prior}
    )
    feed(calibrator, read(FOLDER), 0.0, 10.1)
    camera = calibrator.estimate().cameras["cam0"]
    turn = so3.log(truth["R"].T @ so3.matrix_from_quat(np.array(camera.T_imu_cam.q_wxyz)))
    error = np.concatenate([np.array(camera.T_imu_cam.p_m) - truth["p"], turn])
    P = np.array(camera.T_imu_cam.covariance)
    rotation_deg, arm_mm, shift_ms = OPENVINS[10.0]
    assert np.rad2deg(np.linalg.norm(turn)) < 1.5 * rotation_deg
    assert 1e3 * np.linalg.norm(error[:3]) < 1.5 * arm_mm
    assert abs(camera.timeshift_cam_imu_s) < 2.0 * 1e-3 * shift_ms
    assert error @ np.linalg.solve(P, error) < 22.5  # chi-square, 6 degrees of freedom, 99.9 %
    assert np.abs(np.array(camera.intrinsics) - truth["intrinsics"]).max() < 2.0
