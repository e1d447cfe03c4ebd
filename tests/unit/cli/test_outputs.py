"""No command replaces what it reads."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from vical_mocks.harness.asl import write_asl
from vical_mocks.points import simulate

from vical_daemon.cli import main

TARGET = "target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3\n"


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    monkeypatch.chdir(tmp_path)
    found = {name: tmp_path / name for name in ("log.mcap", "target.yaml", "result.json", "imu.csv")}
    for path in found.values():
        path.write_text(TARGET)
    (tmp_path / "link.json").symlink_to("log.mcap")
    return found


def test_recordings_may_stand_on_both_sides_of_an_option(files, capsys) -> None:
    (files["log.mcap"].parent / "other.mcap").write_text(TARGET)
    assert main(["calibrate", "log.mcap", "--target", "target.yaml", "./log.mcap"]) == 2
    assert "./log.mcap is given twice" in capsys.readouterr().err
    assert main(["info", "log.mcap", "--json", "other.mcap"]) == 1
    assert capsys.readouterr().err.count("error:") == 2


@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", "log.mcap", "--target", "target.yaml", "-o", "log.mcap"],
        ["calibrate", "log.mcap", "--target", "target.yaml", "-o", "link.json"],
        ["calibrate", "log.mcap", "--target", "target.yaml", "-o", "./target.yaml"],
        ["calibrate", "result.json", "log.mcap", "--report", "log.mcap"],
        ["merge", "log.mcap", "imu.csv", "-o", "imu.csv"],
        ["compare", "result.json", "target.yaml", "--report", "result.json"],
        ["export", "result.json", "--format", "kalibr", "-o", "result.json"],
        ["allan", "imu.csv", "-o", "imu.csv"],
        ["imu-calibrate", "imu.csv", "-o", "imu.csv"],
        ["calibrate", "log.mcap", "-o", "new", "--report", "new"],
    ],
)
def test_an_output_onto_an_input_is_bad_usage(words, files, capsys) -> None:
    assert main(words) == 2
    line = capsys.readouterr().err
    assert ("is read by this command" in line or "two outputs" in line) and line.count("\n") == 1
    assert all(path.read_text() == TARGET for path in files.values())


def test_an_output_onto_a_link_to_itself_is_one_line(files, capsys) -> None:
    Path("loop").symlink_to("loop")
    assert main(["target", "--type", "checkerboard", "-o", "loop.svg", "--yaml", "loop"]) == 1
    err = capsys.readouterr().err
    assert err == "vical: error: loop: cannot be written (Too many levels of symbolic links)\n"


def test_a_current_folder_that_was_removed_is_no_bug(tmp_path, monkeypatch, capsys) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main(["target", "--type", "checkerboard", "-o", "board.pdf"]) == 1
    assert capsys.readouterr().err == (
        "vical: error: the current folder has been removed; change to another one\n"
    )


def test_a_full_disk_does_not_cost_the_result(tmp_path, monkeypatch, capsys) -> None:
    """It is printed although the file cannot be written."""

    def full(path: Path, _: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr("vical_daemon.cli.calibrate.write_output", full)
    folder = write_asl(tmp_path / "a", simulate(3, 8.0))
    options = ["--target", f"{folder}/target.yaml", "--initial", f"{folder}/initial.yaml"]
    assert main(["calibrate", str(folder), *options, "-o", f"{tmp_path}/r.json"]) == 1
    out = capsys.readouterr()
    assert "time shift" in out.out
    assert out.err.splitlines()[-1] == f"vical: error: {tmp_path}/r.json: No space left on device"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_refused_before_the_work(files, capsys) -> None:
    folder = files["log.mcap"].parent / "locked"
    folder.mkdir(mode=0o555)
    assert main(["calibrate", "log.mcap", "-o", "locked/r.json"]) == 2
    assert "locked/r.json cannot be written" in capsys.readouterr().err
