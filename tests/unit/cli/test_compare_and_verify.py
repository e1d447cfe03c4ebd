"""`vical compare` and `vical verify` as a user types them."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vical_mocks.harness.asl import write_asl
from vical_mocks.points import simulate

from vical_daemon.cli import main
from vical_daemon.results.export import export

EUROC = Path(__file__).parents[4] / "shared" / "data" / "euroc_imu_april"
OPENVINS = Path(__file__).parents[4] / "shared" / "data" / "openvins_sim_tum"
needs_openvins = pytest.mark.skipif(not OPENVINS.is_dir(), reason="no OpenVINS simulation in ../shared/data")
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


def test_compare_report_shows_what_the_json_says(write, tmp_path, capsys):
    a, c, page = write("a.json"), write("c.json", 0.1), tmp_path / "page.html"
    assert run(capsys, "compare", a, c, "--report", str(page))[0] == 4
    document = json.loads(run(capsys, "compare", a, c, "--json")[1])
    camera, text = document["cameras"]["cam0"], page.read_text()
    along = [np.multiply(row["value"], row["axis"]) for row in camera["directions"][:3]]
    assert np.sum(along, axis=0) == pytest.approx([0.1, 0.0, 0.0], abs=1e-12)
    sigmas = [row["sigma"] for row in camera["directions"][:3]]
    assert sigmas == sorted(sigmas, reverse=True)
    assert "differs in position" in text
    assert text.count("<svg") == 1 + 2 * len(camera["maps"])
    largest = np.max(camera["maps"][0]["apart_px"])
    assert f"{largest:.2f} at most apart" in text
    assert "http://" not in re.sub(r'xmlns(:\w+)?="[^"]*"', "", text)


def test_compare_names_a_lens_that_one_of_them_held(rig, tmp_path, capsys):
    """By its own images its cx may be 3 px off: every point then appears 3 px from where it is projected."""
    only = replace(rig, cameras={"cam0": rig.cameras["cam0"]}, status="converged")
    document = json.loads(export(only, "json")[0].text)
    entry = document["cameras"]["cam0"]
    n = len(entry["distortion"])
    paths = []
    for name, lens_px, fixed in (("held", [1e-4, 1e-4, 3.0, 1e-4], ["intrinsics"]), ("free", [1.0] * 4, [])):
        lens = [*lens_px, *[1e-6 if fixed else 1e-3] * n]
        entry |= {"intrinsics_sigma": lens[:4], "distortion_sigma": lens[4:]}
        entry["calibration_covariance"] = np.diag(np.square([1e-3] * 6 + [1e-4] + lens)).tolist()
        (tmp_path / name).write_text(json.dumps(document | {"fixed": fixed}))
        paths.append(str(tmp_path / name))
    _, out, _ = run(capsys, "compare", *paths)
    assert "A held its lens at given values (by its images 3.00 px RMS off), B estimated it." in out
    _, out, _ = run(capsys, "compare", *paths[::-1], "--report", str(tmp_path / "page.html"))
    assert "B held its lens at given values (by its images 3.00 px RMS off), A estimated it." in out
    assert "by its images 3.00 px RMS off" in (tmp_path / "page.html").read_text()
    camera = json.loads(run(capsys, "compare", *paths, "--json")[1])["cameras"]["cam0"]
    assert (camera["lens_held_by"], camera["lens_held_off_px"]) == ("a", pytest.approx(3.0))


def test_compare_matrix_of_three(write, capsys):
    files = [write("a.json"), write("b.json"), write("c.json", 0.1)]
    code, out, _ = run(capsys, "compare", *files, "--matrix")
    assert code == 4
    assert out.count("same") == 1
    assert out.count("changed") == 2
    foreign = write("chain.yaml", 0.0, "kalibr")
    _, out, _ = run(capsys, "compare", files[0], foreign, files[1], "--matrix")
    assert "note (1-2, 2-3): chain.yaml: no sigma given, assumed: position 1 mm" in out
    code, out, _ = run(capsys, "compare", *files, "--matrix", "--json")
    assert [pair["verdict"] for pair in json.loads(out)["pairs"]] == ["same", "changed", "changed"]


def test_an_inconsistent_result_is_no_calibration(tmp_path, rig, write, capsys):
    wrong = tmp_path / "wrong.json"
    only = replace(rig, cameras={"cam0": rig.cameras["cam0"]}, status="inconsistent")
    wrong.write_text(export(only, "json")[0].text)
    code, out, _ = run(capsys, "compare", write("a.json"), str(wrong))
    assert code == 5
    assert "wrong.json is inconsistent" in out
    code, _, err = run(capsys, "verify", "log", "--against", str(wrong))
    assert code == 1
    assert "wrong.json is inconsistent" in err


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
        (["compare", "one.json"], 2, "compare takes two calibrations, not 1"),
        (["compare", "a", "b", "--report", "none/p.html"], 2, "--report: the folder of none/p.html does not"),
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


def test_verify_says_which_cameras_it_did_not_check(write, rig, tmp_path, capsys):
    """A recording of one camera of two said that both hold."""
    folder = write_asl(tmp_path / "day", simulate(3, 6.0, camera_rate_hz=10.0))
    truth = simulate(3, 0.2).rig
    camera = replace(
        rig.cameras["cam0"],
        R_imu_cam=truth.R_imu_cam,
        p_imu_cam=np.asarray(truth.p_imu_cam),
        timeshift_cam_imu_s=truth.timeshift_cam_imu_s,
        intrinsics=tuple(truth.lens.intrinsics),
        distortion_model=truth.lens.model,
        distortion=tuple(truth.lens.distortion),
        resolution=(640, 480),
    )
    both = tmp_path / "both.yaml"
    both.write_text(export(replace(rig, cameras={"cam0": camera, "cam1": camera}), "kalibr")[0].text)
    asked = ["verify", str(folder), "--against", str(both), "--target", str(folder / "target.yaml")]
    _, out, _ = run(capsys, *asked)
    assert "\ncam1: not checked, this recording does not have it" in out
    assert json.loads(run(capsys, *asked, "--json")[1])["not_checked"] == ["cam1"]
    assert json.loads(run(capsys, *asked, "--json", "--camera", "cam0")[1])["not_checked"] == []


@needs_euroc
def test_euroc_published_calibration_is_found_wrong(capsys):
    """It differs by 6 to 8 mm from what the corners say, and its lens by 5 px; 16 s show it."""
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
    assert document["probability_changed"] > 0.98  # odds of 1000 and a prior of 5 %


@needs_euroc
def test_euroc_mounting_without_lens_needs_the_lens(capsys):
    code, _, err = run(
        capsys, "verify", str(EUROC / "mav0"), "--against", str(EUROC / "reference_kalibr.yaml")
    )
    assert code == 2
    assert "give it with --initial" in err


@needs_openvins
def test_openvins_config_is_asked_with_the_files_that_it_names(tmp_path, capsys):
    """Its start values are 11 mm and 5.5 ms off: 20 s of walking show it, without a board."""
    from vical_daemon.offline.sources import read_source

    rig = read_source(str(OPENVINS / "initial.yaml"))
    config = '%YAML:1.0\nrelative_config_imu: "imu.yaml"\nrelative_config_imucam: "chain.yaml"\n'
    (tmp_path / "estimator_config.yaml").write_text(config)
    chain, imu = export(rig, "openvins")
    (tmp_path / "chain.yaml").write_text(chain.text)
    (tmp_path / "imu.yaml").write_text(imu.text)
    asked = str(tmp_path / "estimator_config.yaml")
    code, out, _ = run(capsys, "compare", str(OPENVINS / "reference.yaml"), asked, "--json")
    assert code == 4
    moved = json.loads(out)["differences"]["cam0"]
    assert np.linalg.norm([moved[f"p_{k}_m"] for k in "xyz"]) == pytest.approx(0.0109, abs=2e-4)
    code, out, _ = run(
        capsys, "verify", str(OPENVINS / "mav0"), "--against", asked, "--seconds", "20", "--json"
    )
    document = json.loads(out)
    assert code == 4, document
    assert "time shift" in {change["what"] for change in document["changes"]}
