"""`vical target`: a board and its YAML; wrong numbers on a command line get one line and exit 2."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vical_daemon.cli import main
from vical_daemon.vision.target import load_target


@pytest.mark.parametrize("name", ["board.pdf", "board.svg"])
def test_board_and_its_yaml(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / name
    wanted = ["--type", "checkerboard", "--cols", "5", "--rows", "4"]
    assert main(["target", *wanted, "-o", str(out), "--json"]) == 0
    row = json.loads(capsys.readouterr().out)
    assert row["points"] == 20
    assert out.read_bytes()[:4] == (b"%PDF" if name.endswith("pdf") else b"<?xm")
    board = load_target(Path(row["yaml"]))
    assert board.kind == row["kind"] == "checkerboard"
    assert board.points_m.shape == (20, 3)


def test_a_measured_board_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["target", "--type", "checkerboard", "--square", "20mm", "-o", str(tmp_path / "board.pdf")]
    assert main(words) == 0
    measured = tmp_path / "board.yaml"
    with_a_note = "# printed on Monday\n" + measured.read_text()
    measured.write_text(with_a_note)
    assert main(words) == 0  # the same board: nothing to lose
    assert measured.read_text() == with_a_note
    measured.write_text(with_a_note.replace("rowSpacingMeters: 0.02", "rowSpacingMeters: 0.01987"))
    (tmp_path / "board.pdf").unlink()
    capsys.readouterr()
    assert main(words) == 1
    err = capsys.readouterr().err
    assert "board.yaml exists with other contents" in err and "--force" in err and err.count("\n") == 1
    assert "0.01987" in measured.read_text() and not (tmp_path / "board.pdf").exists()
    assert main([*words, "--force"]) == 0
    assert "0.01987" not in measured.read_text()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("target --type checkerboard --cols -3 -o b.pdf", "--cols: -3 is below 3; count inner corners"),
        ("target --type checkerboard --square 0 -o b.pdf", "--square: 0.0 is below 0.001 m"),
        ("target --type aprilgrid --tag-spacing -1 -o b.pdf", "--tag-spacing: -1.0 is below 0.02"),
        ("target --type aprilgrid --cols 5 -o b.pdf", "--cols is for checkerboard, not for aprilgrid"),
        ("target --type aprilgrid --tag-size 2 -o b.pdf", "a4 has 210 x 297"),
        ("target --type aprilgrid -o b.png", "must end in .pdf or .svg"),
        ("demo --web 99999", "--web 99999: a port must be 0 to 65535"),
        ("demo --seconds 1", "--seconds: 5 to 3600"),
    ],
)
def test_wrong_numbers_are_one_line_that_names_the_option(
    line: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(line.split()) == 2
    out, err = capsys.readouterr()
    assert words in err
    assert err.count("\n") == 1
    assert not out
    assert not list(tmp_path.iterdir())
