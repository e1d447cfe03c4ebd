"""No command replaces what it reads."""

from __future__ import annotations

from pathlib import Path

import pytest

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
