"""`vical compare` and `vical verify` as a user types them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vical_daemon.cli import main
from vical_daemon.results.export import export

EUROC = Path(__file__).parents[4] / "shared" / "data" / "euroc_imu_april"
needs_euroc = pytest.mark.skipif(not EUROC.is_dir(), reason="no EuRoC corners in ../shared/data")


@pytest.fixture
def write(tmp_path, rig):
    """Write a result with one camera, moved by so many metres along x."""

    def write(name, moved_m=0.0, form="json"):
        camera = rig.cameras["cam0"]
        camera = replace(camera, p_imu_cam=camera.p_imu_cam + np.array([moved_m, 0.0, 0.0]))
        changed = replace(rig, cameras={"cam0": camera}, status="converged")
        path = tmp_path / name
        path.write_text(export(changed, form)[0].text)
        return str(path)

    return write


def run(capsys, *args):
    code = main(list(args))
    out = capsys.readouterr()
    return code, out.out, out.err


def test_compare_says_same_or_changed_with_exit_codes(write, capsys):
    a, b, c = write("a.json"), write("b.json", 1e-3), write("c.json", 0.1)
    code, out, _ = run(capsys, "compare", a, b)
    assert code == 0
    assert out.startswith("cam0: same")
    code, out, _ = run(capsys, "compare", a, c, "--map", "--distance", "2")
    assert code == 4
    assert out.startswith("cam0: changed: position")
    assert "at 2 m: projections differ" in out
    assert "sigma" in out


def test_compare_json_has_the_keys_of_the_interface(write, capsys):
    code, out, _ = run(capsys, "compare", write("a.json"), write("c.json", 0.1), "--json")
    document = json.loads(out)
    assert code == 4
    assert document["verdict"] == "changed"
    assert document["differences"]["cam0"]["p_x_m"] == pytest.approx(0.1)
    z = document["differences"]["cam0"]["p_x_m"] / document["joint_sigma"]["cam0"]["p_x_m"]
    assert document["z"]["cam0"]["p_x_m"] == pytest.approx(z)
    assert document["max_px"] >= document["max_px_beyond_sigmas"] > 0.0


@pytest.mark.parametrize("form", ["kalibr", "openvins"])
def test_compare_reads_other_software(write, capsys, form):
    code, out, _ = run(capsys, "compare", write("a.json"), write("chain.yaml", 1e-3, form))
    assert code == 0, out
    assert "chain.yaml: no sigma given, assumed: position 1 mm" in out


def test_compare_matrix_of_three(write, capsys):
    files = [write("a.json"), write("b.json"), write("c.json", 0.1)]
    code, out, _ = run(capsys, "compare", *files, "--matrix")
    assert code == 4
    assert out.count("same") == 1
    assert out.count("changed") == 2
    code, out, _ = run(capsys, "compare", *files, "--matrix", "--json")
    assert [pair["verdict"] for pair in json.loads(out)["pairs"]] == ["same", "changed", "changed"]


def test_compare_other_cameras_cannot_be_compared(tmp_path, rig, write, capsys):
    other = tmp_path / "other.json"
    camera = replace(rig.cameras["cam0"], resolution=(640, 480))
    other.write_text(export(replace(rig, cameras={"cam0": camera}), "json")[0].text)
    code, out, _ = run(capsys, "compare", write("a.json"), str(other))
    assert code == 5
    assert "not comparable: images of 752 x 480 and of 640 x 480 px" in out


@pytest.mark.parametrize(
    ("args", "code", "line"),
    [
        (["compare", "one.json"], 2, "two calibrations are compared, 1 are named"),
        (["compare", "none.json", "none.json"], 1, "none.json: no such file"),
        (["compare", "a", "b", "--distance", "-1"], 2, "--distance must be above 0 m"),
        (["verify", "log", "--against", "none.json"], 1, "none.json: no such file"),
        (["verify", "log", "--against", "x", "--rotation-deg", "0"], 2, "--rotation-deg must be above 0"),
    ],
)
def test_mistakes_are_one_line(capsys, args, code, line):
    found, _, err = run(capsys, *args)
    assert found == code
    assert line in err
    assert len(err.strip().splitlines()) == 1


@needs_euroc
def test_euroc_published_calibration_is_found_wrong(capsys):
    """It differs by 6 to 8 mm and 0.5 deg from what the corners say; the first seconds show it."""
    code, out, _ = run(
        capsys,
        "verify",
        str(EUROC / "mav0"),
        "--against",
        str(EUROC / "reference.yaml"),
        "--target",
        str(EUROC / "target.yaml"),
        "--json",
    )
    document = json.loads(out)
    assert code == 4
    assert document["verdict"] == "changed"
    assert document["seconds_used"] < 20.0
    assert document["probability_changed"] > 0.99


@needs_euroc
def test_euroc_mounting_without_lens_needs_the_lens(capsys):
    code, _, err = run(
        capsys, "verify", str(EUROC / "mav0"), "--against", str(EUROC / "reference_kalibr.yaml")
    )
    assert code == 2
    assert "give it with --initial" in err
