"""`vical calibrate` without a board: several cameras, optional blocks, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.points import SimulatedRun
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks

from vical_daemon.cli import main

READOUT_S = 0.018


def _write(folder: Path, runs: dict[str, SimulatedRun]) -> Path:
    """An ASL folder with the tracks of each camera, and what is known of the rig."""
    first = next(iter(runs.values()))
    (folder / "mav0/imu0").mkdir(parents=True)
    rows = np.column_stack([first.gyro_rps, first.specific_force_mps2]).tolist()
    table = [f"{t}," + ",".join(map(repr, row)) for t, row in zip(first.t_imu_ns.tolist(), rows, strict=True)]
    (folder / "mav0/imu0/data.csv").write_text("#timestamp [ns],w,w,w,a,a,a\n" + "\n".join(table) + "\n")
    initial = []
    for name, run in runs.items():
        (folder / "mav0" / name).mkdir()
        table = [
            f"{f.t_cam_ns},{i},{u!r},{v!r}"
            for f in run.frames
            for i, (u, v) in zip(f.ids.tolist(), f.uv_px.tolist(), strict=True)
        ]
        path = folder / "mav0" / name / "tracks.csv"
        path.write_text("#timestamp [ns],feature_id,u [px],v [px]\n" + "\n".join(table) + "\n")
        lens = run.rig.lens
        initial.append(
            f"{name}:\n  resolution: {list(lens.resolution)}\n  camera_model: pinhole\n"
            f"  distortion_model: {lens.model}\n  intrinsics: {list(lens.intrinsics)}\n"
            f"  distortion_coeffs: {list(lens.distortion)}\n"
        )
    (folder / "initial.yaml").write_text("".join(initial))
    return folder


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, SimulatedRun]]:
    """Two cameras with rolling shutters, whose readout is not given."""
    left = reference_rig(12, timeshift_cam_imu_s=0.015, readout_s=READOUT_S)
    right = replace(
        left,
        R_imu_cam=left.R_imu_cam @ Rotation.from_rotvec([0.05, -0.3, 0.0]).as_matrix(),
        p_imu_cam=left.p_imu_cam + np.array([0.0, -0.12, 0.0]),
    )
    runs = {
        name: simulate_tracks(12, 13.0, rig=rig, camera_rate_hz=10.0)
        for name, rig in (("cam0", left), ("cam1", right))
    }
    return _write(tmp_path_factory.mktemp("stereo"), runs), runs


def _calibrate(folder: Path, *more: str) -> int:
    return main(["calibrate", str(folder), "--initial", str(folder / "initial.yaml"), "--quiet", *more])


def test_two_cameras_and_their_readout_are_found(stereo, capsys: pytest.CaptureFixture[str]) -> None:
    folder, runs = stereo
    assert _calibrate(folder, "--fix", "intrinsics", "--estimate", "readout", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["cameras"]) == set(result["traces"]) == {"cam0", "cam1"}
    for name, run in runs.items():
        camera = result["cameras"][name]
        error = np.array(camera["T_imu_cam"]["p_m"]) - run.rig.p_imu_cam
        P = np.array(camera["T_imu_cam"]["covariance"])[:3, :3]
        assert error @ np.linalg.solve(P, error) < 21.1  # chi-square, 3 degrees of freedom, 1 in 10000
        assert abs(camera["readout_s"] - READOUT_S) < 4.0 * camera["readout_sigma_s"] < 2e-3


def test_the_text_names_what_was_found(stereo, capsys: pytest.CaptureFixture[str]) -> None:
    folder, _ = stereo
    assert (
        _calibrate(folder, "--camera", "cam1", "--fix", "intrinsics", "--estimate", "readout,imu_intrinsics")
        == 0
    )
    text = capsys.readouterr().out
    assert "(without a target, " in text.splitlines()[0]
    assert "stretches of the data differ by" in text and "NIS" not in text
    assert "cam1 in the imu frame" in text and "cam0" not in text
    assert "(first row to last)" in text
    assert "gyro matrix x" in text and "accel. matrix z" in text


def test_the_size_of_no_target_is_refused(stereo, capsys: pytest.CaptureFixture[str]) -> None:
    folder, _ = stereo
    assert _calibrate(folder, "--estimate", "target_scale") == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1] == "vical: error: without a target there is no target_scale to estimate"


def test_a_camera_too_slow_to_follow_features_is_told_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = simulate_tracks(12, 8.0, rig=reference_rig(12), camera_rate_hz=1.0)
    assert _calibrate(_write(tmp_path, {"cam0": run})) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert "cam0: its images come at 1 Hz" in said and "5 Hz are needed" in said and "--target" in said
