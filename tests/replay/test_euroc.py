"""The real recording through the command: Kalibr's result on the same corners, at the promised distance."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from benchmarks import euroc_halves, recordings
from vical_daemon.cli import main
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.vision.target import load_target

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "euroc_imu_april"

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason="the EuRoC recording lies in ../shared, whose licence does not let us ship it"
)


def test_reaches_kalibrs_result_from_rough_intrinsics_alone(capsys):
    arguments = ["--target", str(FOLDER / "target.yaml"), "--initial", str(FOLDER / "initial.yaml")]
    code = main(["calibrate", str(FOLDER), *arguments, "--fix", "intrinsics", "--json", "--quiet"])
    result = json.loads(capsys.readouterr().out)
    camera = result["cameras"]["cam0"]
    kalibr = yaml.safe_load((FOLDER / "reference_kalibr.yaml").read_text())["cam0"]
    T_cam_imu = np.array(kalibr["T_cam_imu"])
    R, p = T_cam_imu[:3, :3].T, -T_cam_imu[:3, :3].T @ T_cam_imu[:3, 3]
    found = Rotation.from_quat(np.roll(camera["T_imu_cam"]["q_wxyz"], -1)).as_matrix()
    assert code == 0
    assert result["status"] == "converged"
    assert np.linalg.norm(np.array(camera["T_imu_cam"]["p_m"]) - p) < 1.5e-3
    assert np.rad2deg(Rotation.from_matrix(R.T @ found).magnitude()) < 0.06
    assert camera["timeshift_cam_imu_s"] == pytest.approx(kalibr["timeshift_cam_imu"], abs=5e-5)
    assert result["frames"] > 1400
    assert len(result["trace"]) == pytest.approx(70, abs=3)
    sigma = np.sqrt(np.diag(camera["T_imu_cam"]["covariance"]))
    assert np.all(sigma[:3] > 2e-4)  # honest: a plain filter claims 0.08 mm here
    assert np.all(sigma[:3] < 2e-3)


def test_a_lens_that_radtan_does_not_quite_fit_is_no_knock(capsys):
    """After the hole at 59 s half a board at the image's edge had been told as `bumped`."""
    arguments = ["--target", str(FOLDER / "target.yaml"), "--initial", str(FOLDER / "initial.yaml")]
    code = main(["calibrate", str(FOLDER), *arguments, "--json", "--quiet"])
    result = json.loads(capsys.readouterr().out)
    assert code == 0
    assert result["status"] == "converged"
    assert not any(event["kind"] in ("bumped", "rolling_shutter") for event in result["events"])


def test_its_halves_as_two_recordings_are_the_whole():
    """Biases and gravity are found once more, which costs half a sigma of the whole."""
    items, points = euroc_halves.read(FOLDER), load_target(FOLDER / "target.yaml").points_m
    split = items[0][0] + int(euroc_halves.SPLIT_S * 1e9)
    halves = [[i for i in items if (i[0] < split) == first] for first in (True, False)]
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=euroc_halves.NOISE)
    whole, parts = (recordings.as_one(x, options, points) for x in ([items], halves))
    assert np.abs(recordings.in_sigmas(whole, parts)[1]).max() < 0.75
