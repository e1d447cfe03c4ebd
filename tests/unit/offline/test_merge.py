"""`vical merge`: three short recordings of one rig, one of them after a bump."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vical_mocks.harness.asl import write_asl
from vical_mocks.points import simulate
from vical_mocks.rig import BiasWalk, nominal_gravity, reference_rig
from vical_mocks.rotations import exp_so3

from vical_daemon.cli import main
from vical_daemon.cli import merge as merge_command
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.estimation.tools.agreement import Agreement
from vical_daemon.offline import merge as merge_module
from vical_daemon.offline.calibrate import Outcome

SHIFT_S, LATE_S = 0.01, 0.05


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Monday and Tuesday agree; on Wednesday the camera has moved, on Thursday the clock was another."""
    root, found = tmp_path_factory.mktemp("week"), {}
    for k, day in enumerate(("monday", "tuesday", "wednesday", "thursday")):
        rng = np.random.default_rng(k)
        rig = reference_rig(
            20 + k,
            timeshift_cam_imu_s=SHIFT_S + (LATE_S if day == "thursday" else 0.0),
            gravity_world_mps2=exp_so3(0.2 * rng.standard_normal(3)) @ nominal_gravity(),
            gyro_bias=BiasWalk(0.02 * rng.standard_normal(3), 2e-5, k),
        )
        if day == "wednesday":
            moved = np.asarray(rig.p_imu_cam) + np.array([0.0, 0.01, 0.0])
            rig = replace(rig, p_imu_cam=moved, R_imu_cam=rig.R_imu_cam @ exp_so3(np.array([0.03, 0.0, 0.0])))
        run = simulate(20 + k, 6.0, rig=rig, camera_rate_hz=10.0, corner_sigma_px=0.3)
        found[day] = write_asl(root / day, run, 86_400.0 * k)
    return found


def _merge(capsys, folders: dict[str, Path], *days: str, more: tuple[str, ...] = ()) -> tuple[int, dict, str]:
    chosen = [folders[day] for day in days]
    files = ["--target", str(chosen[0] / "target.yaml"), "--initial", str(chosen[0] / "initial.yaml")]
    words = ["merge", *map(str, chosen), *files, "--fix", "intrinsics", "--json", *more]
    code = main(words)
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else {}, err


def test_those_that_disagree_are_named_and_left_out(folders, capsys) -> None:
    code, result, err = _merge(capsys, folders, "monday", "wednesday", "tuesday", "thursday")
    assert code == 3
    assert [entry["verdict"] for entry in result["inputs"]] == ["agrees", "disagrees", "agrees", "disagrees"]
    assert [entry["used"] for entry in result["inputs"]] == [True, False, True, False]
    assert result["disagreeing"] == [str(folders[day]) for day in ("wednesday", "thursday")]
    assert f"{folders['wednesday']} disagrees" in err and "has the rig changed" in err
    wednesday, thursday = ({d["what"]: d for d in result["inputs"][k]["differences"]} for k in (1, 3))
    assert np.linalg.norm(wednesday["rotation"]["value"]) == pytest.approx(0.03, abs=0.006)
    assert wednesday["rotation"]["probability"] < 1e-6
    assert thursday["time shift"]["value"] == pytest.approx([LATE_S], abs=2e-3)
    assert thursday["rotation"]["probability"] > 1e-4 < thursday["lever arm"]["probability"]
    camera = result["cameras"]["cam0"]
    sigma = np.sqrt(np.diag(camera["T_imu_cam"]["covariance"]))[:3]
    error = np.array(camera["T_imu_cam"]["p_m"]) - reference_rig(20).p_imu_cam
    assert (np.abs(error) < 4.0 * sigma).all() and result["frames"] > 80
    text = merge_command.describe_inputs(result)
    assert "wednesday     6.0 s  disagrees    lever arm" in text


def test_clocks_apart_are_found_in_each(folders, capsys) -> None:
    more = ("--clock", "apart", "--accept", "converging")
    code, result, _ = _merge(capsys, folders, "monday", "thursday", more=more)
    assert code == 0
    assert [entry["verdict"] for entry in result["inputs"]] == ["agrees", "agrees"]
    shifts = [entry["timeshift_cam_imu_s"]["cam0"] for entry in result["inputs"]]
    assert shifts == pytest.approx([SHIFT_S, SHIFT_S + LATE_S], abs=2e-3)


def test_of_two_that_disagree_nothing_is_merged(folders, capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(merge_module, "run_job", lambda *_, **__: Outcome(_nothing(), {"cam0": []}))
    monkeypatch.setattr(merge_module, "agreements", lambda found: [Agreement(False, -50.0)] * len(found))
    code, result, err = _merge(capsys, folders, "monday", "wednesday", more=("-o", str(tmp_path / "r.json")))
    assert code == 3
    assert result["status"] == "inconsistent" and result["cameras"] == {}
    assert result["disagreeing"]
    assert "too few to tell" in err and not (tmp_path / "r.json").exists()


def test_a_copy_of_a_recording_is_no_other_recording(folders, capsys, tmp_path) -> None:
    """It agreed with itself, and made sigmas smaller by a root of two."""
    copy = shutil.copytree(folders["monday"], tmp_path / "copy")
    code, _, err = _merge(capsys, folders | {"copy": copy}, "monday", "tuesday", "copy")
    assert code == 2 and err.count("\n") == 1
    assert f"{copy}: 601 of its 601 IMU readings are those of {folders['monday']}; give data once" in err


def test_other_recordings_with_the_same_stamps_are_merged(folders, capsys, tmp_path) -> None:
    """Simulators begin at zero."""
    again = write_asl(tmp_path / "again", simulate(77, 6.0, rig=reference_rig(77), camera_rate_hz=10.0), 0.0)
    assert _merge(capsys, folders | {"again": again}, "monday", "again")[0] in (0, 3)


def _nothing() -> CalibrationEstimate:
    return CalibrationEstimate(0, Status.CONVERGED, "", 1.0, "", 6.0, 60, 600, {}, None, [], 1.0, 0.0)


def test_one_recording_is_not_enough(folders, capsys) -> None:
    code, _, err = _merge(capsys, folders, "monday")
    assert code == 2 and "at least two" in err
