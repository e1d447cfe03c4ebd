"""`vical calibrate`: the real recording, repeatability, and every bad input as one line."""

from __future__ import annotations

import gzip
import io
import json
import re
import shutil
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vical_mocks.harness.asl import write_asl
from vical_mocks.points import simulate

from vical_daemon.bus.messages import DiagnosticStatus, Level, encode_diagnostics
from vical_daemon.cli import calibration_text, main
from vical_daemon.estimation.result import Status
from vical_daemon.logs import open_recording
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.offline import calibrate

G = 9.80665


@pytest.fixture
def copy(short: Path, tmp_path: Path) -> Path:
    """A copy of the short recording that a test may spoil."""
    return Path(shutil.copytree(short, tmp_path / "copy"))


@pytest.fixture
def copy_of_5_s(shortest: Path, tmp_path: Path) -> Path:
    """The same of the shortest recording: enough where one attempt to start is."""
    return Path(shutil.copytree(shortest, tmp_path / "copy"))


def _arguments(folder: Path, *more: str) -> list[str]:
    target, initial = str(folder / "target.yaml"), str(folder / "initial.yaml")
    return ["calibrate", str(folder), "--target", target, "--initial", initial, "--fix", "intrinsics", *more]


@pytest.fixture(scope="session")
def calibrated(shortest: Path) -> tuple[str, calibrate.Outcome]:
    """What the command prints for the shortest recording, and what it has found."""
    out, found, run_job = io.StringIO(), list[calibrate.Outcome](), calibrate.run_job

    def run(*words, **options) -> calibrate.Outcome:
        found.append(run_job(*words, **options))
        return found[-1]

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out):
        patch.setattr(calibrate, "run_job", run)
        assert main(_arguments(shortest, "--json", "--accept", "converging")) == 0
    return out.getvalue(), found[0]


@pytest.fixture(scope="session")
def plain(calibrated) -> str:
    return calibrated[0]


@pytest.fixture(scope="session")
def outcome(calibrated) -> calibrate.Outcome:
    return calibrated[1]


def test_json_has_the_promised_keys_and_the_same_bits_through_an_mcap(
    shortest: Path, plain: str, tmp_path: Path, capsys
) -> None:
    log = tmp_path / "log.mcap"
    with LogWriter(log) as writer:
        for key, payload in open_recording(shortest).messages():
            writer.write(key, payload, 1_700_000_000_000_000_000)
    first = json.loads(plain)
    more = _arguments(shortest, "--json", "--accept", "converging")[2:]
    assert main(["calibrate", str(log), *more]) == 0
    second = json.loads(capsys.readouterr().out)
    assert first.pop("cpu_s") > 0 and second.pop("cpu_s") > 0
    assert json.dumps(first) == json.dumps(second)
    camera = first["cameras"]["cam0"]
    assert np.asarray(camera["T_imu_cam"]["covariance"]).shape == (6, 6)
    assert camera["intrinsics"] == [458.654, 457.296, 367.215, 248.375] and camera["resolution"] == [752, 480]
    assert min(camera["intrinsics_sigma"]) > 0.0  # held, but the images contradict it
    for key in ("status", "reason", "duration_s", "frames", "imu_samples", "imu", "gravity_world_mps2"):
        assert key in first
    assert {"t_s", "p_m", "p_sigma_m", "q_wxyz", "r_sigma_rad", "timeshift_s", "timeshift_sigma_s"} <= set(
        first["trace"][0]
    )
    assert 1 <= len(first["trace"]) <= 6
    assert "cam0 in the imu frame" in calibration_text.describe(first | {"cpu_s": 1.0})
    assert "what would help: nod" in calibration_text.describe(first | {"guidance": "nod"})


def test_what_the_driver_said_of_its_stamps_counts_as_it_does_live(
    shortest: Path, plain: str, tmp_path: Path, capsys
) -> None:
    status = DiagnosticStatus(Level.OK, "imu/imu0", values={"stamp_sigma_us": "500.0"})
    log = tmp_path / "log.mcap"
    messages = list(open_recording(shortest).messages())
    with LogWriter(log) as writer:
        for n, (key, payload) in enumerate(messages):
            stamp_ns = stamp_of(payload)
            writer.write(key, payload, stamp_ns)
            if n % 200 == 0:
                message = encode_diagnostics(stamp_ns, "imu", [status])
                writer.write("vical/rig0/status/imu", message, stamp_ns)
    plain_s = json.loads(plain)["cameras"]["cam0"]["timeshift_sigma_s"]
    more = _arguments(shortest, "--json", "--accept", "converging")[2:]
    assert main(["calibrate", str(log), *more]) == 0
    told_s = json.loads(capsys.readouterr().out)["cameras"]["cam0"]["timeshift_sigma_s"]
    assert plain_s < 4e-4 < 5e-4 <= told_s


@pytest.mark.parametrize(
    ("status", "accept", "code"),
    [
        ("converged", "", 0),
        ("converging", "", 3),
        ("degenerate", "", 3),
        ("degenerate", "converging", 3),
        ("converging", "converging", 0),
        ("degenerate", "converging,degenerate", 0),
        ("inconsistent", "converging,degenerate", 1),
    ],
)
def test_the_exit_code_tells_whether_it_converged(
    shortest: Path, outcome, monkeypatch: pytest.MonkeyPatch, capsys, status: str, accept: str, code: int
) -> None:
    changed = replace(outcome, estimate=replace(outcome.estimate, status=Status(status), guidance="nod"))
    monkeypatch.setattr(calibrate, "run_job", lambda *_, **__: changed)
    more = ["--accept", accept] if accept else []
    assert main(_arguments(shortest, "--json", *more)) == code
    out, err = capsys.readouterr()
    assert json.loads(out)["status"] == status  # written in any case
    assert (f"{status}: " in err) == (status != "converged")


def test_a_recording_that_is_too_short_says_how_long_it_should_be(
    shortest: Path, outcome, monkeypatch, capsys
):
    assert main(_arguments(shortest, "--seconds", "2")) == 1
    said = capsys.readouterr().err
    assert "vical: error: no calibration: 2.0 s of data are short: a start needs about 5 s" in said
    assert "usually 10 to 30 s; use more (--seconds" in said and "if the motion was rich" not in said
    changed = replace(outcome, estimate=replace(outcome.estimate, status=Status.CONVERGING, guidance="nod"))
    monkeypatch.setattr(calibrate, "run_job", lambda *_, **__: changed)
    assert main(_arguments(shortest)) == 3
    said = capsys.readouterr().err
    assert (
        "warning: converging: " in said and "s of data are short" in said and said.endswith("; record more\n")
    )


def _scale_csv(path: Path, columns: slice, factor: float) -> None:
    rows = [line.split(",") for line in path.read_text().splitlines()]
    for row in rows:
        if not row[0].startswith("#"):
            row[columns] = [repr(float(v) * factor) for v in row[columns]]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")


def _spoil_missing(folder: Path) -> list[str]:
    return ["calibrate", str(folder / "nothing.mcap"), "--target", str(folder / "target.yaml")]


def _spoil_text(folder: Path) -> list[str]:
    (folder / "log.mcap").write_text("this is no log\n" * 100)
    return ["calibrate", str(folder / "log.mcap"), "--target", str(folder / "target.yaml")]


def _spoil_degrees(folder: Path) -> list[str]:
    _scale_csv(folder / "mav0/imu0/data.csv", slice(1, 4), 180 / np.pi)
    return _arguments(folder)


def _spoil_g(folder: Path) -> list[str]:
    _scale_csv(folder / "mav0/imu0/data.csv", slice(4, 7), 1 / G)
    return _arguments(folder)


def _spoil_camera_rate(folder: Path) -> list[str]:
    path = folder / "mav0/cam0/corners.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    begin = int(rows[1][0])
    for row in rows[1:]:
        row[0] = str(begin + 100 * (int(row[0]) - begin))
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")
    return _arguments(folder)


def _spoil_target_key(folder: Path) -> list[str]:
    (folder / "target.yaml").write_text("target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: -1\n")
    return _arguments(folder)


def _spoil_initial(folder: Path) -> list[str]:
    (folder / "initial.yaml").write_text("cam0: {intrinsiks: [1, 2, 3, 4]}\n")
    return _arguments(folder)


def _spoil_nothing_fixed(folder: Path) -> list[str]:
    return _arguments(folder, "--fix", "timeshift")


def _spoil_fix(folder: Path) -> list[str]:
    return _arguments(folder, "--fix", "intrinsic")


def _spoil_estimate(folder: Path) -> list[str]:
    return _arguments(folder, "--estimate", "everything")


def _spoil_accept(folder: Path) -> list[str]:
    return _arguments(folder, "--accept", "degenrate")


def _spoil_skip(folder: Path) -> list[str]:
    return _arguments(folder, "--skip", "9.5")


def _spoil_seconds(folder: Path) -> list[str]:
    return _arguments(folder, "--seconds", "0")


def _spoil_camera_name(folder: Path) -> list[str]:
    return _arguments(folder, "--camera", "cam7")


def _spoil_size(folder: Path) -> list[str]:
    (folder / "initial.yaml").write_text("cam0: {intrinsics: [458, 457, 367, 248]}\n")
    return _arguments(folder)


def _with_tag_size(folder: Path, size_m: float) -> list[str]:
    path = folder / "target.yaml"
    path.write_text(path.read_text().replace("tagSize: 0.088", f"tagSize: {size_m}"))
    return _arguments(folder)


def _spoil_no_initial(folder: Path) -> list[str]:
    return _arguments(folder, "--initial", str(folder / "nowhere.yaml"))


def _spoil_report(folder: Path) -> list[str]:
    return _arguments(folder, "--report", str(folder / "nowhere" / "r.html"))


def _spoil_output(folder: Path) -> list[str]:
    return _arguments(folder, "-o", str(folder))


def _spoil_gravity(folder: Path) -> list[str]:
    return _arguments(folder, "--gravity", "981")


def _spoil_twice(folder: Path) -> list[str]:
    command, first, *options = _arguments(folder)
    return [command, first, str(folder / ".." / folder.name), *options]


def _spoil_other_cameras(folder: Path) -> list[str]:
    (folder / "initial.yaml").write_text("cam1: {readout_s: 0.0}\ncam2: {readout_s: 0.0}\n")
    return _arguments(folder)


@pytest.mark.parametrize(
    ("spoil", "code", "words"),
    [
        (_spoil_missing, 1, "does not exist"),
        (_spoil_text, 1, "log.mcap"),
        (_spoil_degrees, 1, "deg/s"),
        (_spoil_g, 1, "looks like g"),
        (_spoil_camera_rate, 1, "cam0"),
        (_spoil_target_key, 1, "tagSize"),
        (_spoil_no_initial, 2, "no such file"),
        (_spoil_initial, 2, "did you mean intrinsics"),
        (_spoil_nothing_fixed, 2, "does not give it"),
        (_spoil_fix, 2, "did you mean intrinsics"),
        (_spoil_estimate, 2, "imu_intrinsics"),
        (_spoil_skip, 2, "is only 9.0 s long"),
        (_spoil_seconds, 2, "--seconds must be above 0"),
        (_spoil_accept, 2, "did you mean degenerate"),
        (_spoil_camera_name, 1, "cam7"),
        (_spoil_size, 2, "image size"),
        (_spoil_report, 2, "folder does not exist"),
        (_spoil_output, 2, "is a folder"),
        (_spoil_gravity, 2, "--gravity 981: 9.7 to 9.9 m/s^2"),
        (_spoil_twice, 2, "is given twice"),
        (_spoil_other_cameras, 2, "--initial has cam1, cam2, the recording has cam0"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_bad_input_is_one_line(copy: Path, capsys, spoil, code: int, words: str) -> None:
    assert main(spoil(copy)) == code
    out, err = capsys.readouterr()
    assert out == "" and "Traceback" not in err
    assert words in err.splitlines()[-1] and err.splitlines()[-1].startswith("vical: error: ")


def test_a_camera_too_slow_for_a_start_is_told_how_many_images_that_needs(tmp_path: Path, capsys) -> None:
    folder = write_asl(tmp_path / "slow", simulate(1, 16.0, camera_rate_hz=1.0))
    assert main(_arguments(folder)) == 1
    said = capsys.readouterr().err
    assert re.search("cam0: (9|10) images of the board in the latest 10 s, a start needs 15", said), said


def test_a_failure_is_one_line_and_keeps_an_earlier_result(
    copy_of_5_s: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """A board 23 times too large, as if no other size were tried: the accelerometer shows it."""
    copy = copy_of_5_s
    monkeypatch.setattr("vical_daemon.estimation.init.velocity_gravity_init._other_size", lambda *_: None)
    earlier = copy / "result.json"
    earlier.write_text("of yesterday", encoding="utf-8")
    assert main([*_with_tag_size(copy, 2.0), "-o", str(earlier)]) == 1
    out, err = capsys.readouterr()
    last = err.splitlines()[-1]
    assert out == "" and "Traceback" not in err and last.startswith("vical: error: ")
    assert "check the sizes in " in last and f"{earlier} was not written" in last
    assert earlier.read_text(encoding="utf-8") == "of yesterday"


def test_the_gravity_of_the_place_is_used(shortest: Path, capsys) -> None:
    assert main(_arguments(shortest, "--gravity", "9.78", "--json", "--accept", "converging")) == 0
    result = json.loads(capsys.readouterr().out)
    assert np.linalg.norm(result["gravity_world_mps2"]) == pytest.approx(9.78)


def test_a_slipped_decimal_point_is_reported_and_the_answer_is_right(
    copy_of_5_s: Path, plain: str, capsys
) -> None:
    known = json.loads(plain)["cameras"]["cam0"]["T_imu_cam"]
    assert main([*_with_tag_size(copy_of_5_s, 0.88), "--json", "--accept", "converging"]) == 0
    result = json.loads(capsys.readouterr().out)
    (size,) = (e for e in result["events"] if e["kind"] == "target_size")
    assert size["value"] == pytest.approx(-0.9, abs=0.02)
    apart_m = np.subtract(result["cameras"]["cam0"]["T_imu_cam"]["p_m"], known["p_m"])
    sigma_m = np.sqrt(np.diag(np.reshape(known["covariance"], (6, 6)))[:3])
    assert np.all(np.abs(apart_m) < 1.0 * sigma_m)


def _part(euroc: Path, folder: Path, begin_s: float, end_s: float, later_ns: int = 0) -> Path:
    """A part of the recording as one by itself, with other stamps."""
    (folder / "mav0/imu0").mkdir(parents=True)
    (folder / "mav0/cam0").mkdir()
    imu = (euroc / "mav0/imu0/data.csv").read_text().splitlines()
    with gzip.open(euroc / "mav0/cam0/corners.csv.gz", "rt") as file:
        corners = file.read().splitlines()
    first_ns = int(imu[1].split(",")[0])
    low, high = first_ns + round(begin_s * 1e9), first_ns + round(end_s * 1e9)
    for rows, path in ((imu, "imu0/data.csv"), (corners, "cam0/corners.csv")):
        kept = [rows[0]]
        for stamp, rest in (row.split(",", 1) for row in rows[1:]):
            if low <= int(stamp) < high:
                kept.append(f"{int(stamp) + later_ns},{rest}")
        (folder / "mav0" / path).write_text("\n".join(kept) + "\n")
    return folder


def test_several_recordings_are_one_calibration(euroc: Path, tmp_path: Path, capsys) -> None:
    """The second has the stamps of another boot, long before those of the first."""
    one = _part(euroc, tmp_path / "one", 0.0, 12.0)
    other = _part(euroc, tmp_path / "other", 40.0, 52.0, later_ns=-(10**17))
    files = ["--target", str(euroc / "target.yaml"), "--initial", str(euroc / "initial.yaml")]
    report = tmp_path / "report.html"
    words = [str(one), str(other), *files, "--fix", "intrinsics", "--json", "--accept", "converging"]
    assert main(["calibrate", *words, "--report", str(report)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [Path(part["path"]).name for part in result["inputs"]] == ["one", "other"]
    assert all(part["used"] and part["frames"] > 135 for part in result["inputs"])
    assert result["frames"] == sum(part["frames"] for part in result["inputs"])
    assert result["duration_s"] == pytest.approx(24.0, abs=0.2)
    begin_s = [part["begin_s"] for part in result["inputs"]]
    assert begin_s[0] == 0.0 and result["trace"][-1]["t_s"] > begin_s[1] > 20.0
    reference = np.array([-0.0172, -0.0690, 0.0042])  # of the whole recording
    camera = result["cameras"]["cam0"]["T_imu_cam"]
    sigma = np.sqrt(np.diag(camera["covariance"]))[:3]
    assert (np.abs(np.array(camera["p_m"]) - reference) < 4.0 * sigma).all()
    # the fixed lens is not this camera's: it moves x by 3.5 mm, which is in the sigma (`test_euroc.py`)
    assert sigma[0] < 4e-3 and sigma[1:].max() < 3e-3
    html = report.read_text()
    assert "Recordings" in html and str(other) in html
    text = calibration_text.describe(result)
    assert f"{other}: 12.0 s" in text


def test_a_recording_that_cannot_start_is_tried_again_after_the_others(
    euroc: Path, tmp_path: Path, capsys
) -> None:
    brief = _part(euroc, tmp_path / "brief", 20.0, 22.5)  # too short for a start of its own
    longer = _part(euroc, tmp_path / "longer", 40.0, 48.0)
    files = ["--target", str(euroc / "target.yaml"), "--initial", str(euroc / "initial.yaml")]
    words = [str(brief), str(longer), *files, "--fix", "intrinsics", "--json", "--accept", "converging"]
    assert main(["calibrate", *words]) == 0
    first, second = json.loads(capsys.readouterr().out)["inputs"]
    assert second["used"] and first["used"] and first["begin_s"] > second["begin_s"]
    assert 20 < first["frames"] < 60


def test_recordings_of_other_cameras_are_refused(euroc: Path, tmp_path: Path, capsys) -> None:
    one = _part(euroc, tmp_path / "one", 0.0, 2.0)
    two = _part(euroc, tmp_path / "two", 0.0, 2.0)
    shutil.copytree(two / "mav0/cam0", two / "mav0/cam1")
    (two / "mav0/cam0").rename(two / "mav0/cam2")
    files = ["--target", str(euroc / "target.yaml"), "--initial", str(euroc / "initial.yaml")]
    assert main(["calibrate", str(one), str(two), *files]) == 1
    assert "has the cameras cam1, cam2, and" in capsys.readouterr().err
