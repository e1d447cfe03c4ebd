from pathlib import Path

import numpy as np
import pytest

from vical_daemon.vision.target import AprilGrid, Checkerboard, TargetError, load_target

APRIL = "target_type: aprilgrid\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\n"
CHECKER = (
    "target_type: 'checkerboard'\ntargetCols: 8\ntargetRows: 6\nrowSpacingMeters: 5e-2\n"
    "colSpacingMeters: 0.04\n"
)


def write(folder: Path, text: str) -> Path:
    path = folder / "board.yaml"
    path.write_text(text)
    return path


def test_aprilgrid_points_follow_the_documented_order(tmp_path: Path) -> None:
    target = load_target(write(tmp_path, APRIL))
    assert isinstance(target, AprilGrid)
    assert target.kind == "aprilgrid"
    points = target.points_m
    assert points.shape == (120, 3)
    assert points.dtype == np.float64
    np.testing.assert_allclose(points[:4], [[0, 0, 0], [0.088, 0, 0], [0.088, 0.088, 0], [0, 0.088, 0]])
    np.testing.assert_allclose(points[4 * 1], [0.088 * 1.3, 0, 0])
    np.testing.assert_allclose(points[4 * 6 + 3], [0, 0.088 * 2.3, 0])


def test_checkerboard_ids_run_along_columns_first(tmp_path: Path) -> None:
    target = load_target(write(tmp_path, CHECKER))
    assert isinstance(target, Checkerboard)
    np.testing.assert_allclose(target.points_m[2 * 8 + 3], [3 * 0.04, 2 * 0.05, 0.0])


def test_the_first_tag_may_have_another_id(tmp_path: Path) -> None:
    """`codeOffset: 0` is in the example of Kalibr's wiki; points are numbered from the first tag on."""
    assert load_target(write(tmp_path, APRIL + "codeOffset: 0   # of the first tag\n")) == load_target(
        write(tmp_path, APRIL)
    )
    second = load_target(write(tmp_path, APRIL + "codeOffset: 30\n"))
    assert isinstance(second, AprilGrid) and second.first_tag == 30
    np.testing.assert_array_equal(second.points_m, AprilGrid(6, 5, 0.088, 0.3).points_m)


@pytest.mark.parametrize("text", [APRIL, APRIL + "codeOffset: 30\n", CHECKER])
def test_yaml_round_trip(tmp_path: Path, text: str) -> None:
    target = load_target(write(tmp_path, text))
    assert load_target(write(tmp_path, target.to_yaml())) == target


def test_points_are_read_only(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="read-only"):
        load_target(write(tmp_path, APRIL)).points_m[0, 0] = 1.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (APRIL.replace("0.088", "88"), ["tagSize", "above 2 m", "0.088", "line 4"]),
        (APRIL.replace("0.088", "0"), ["tagSize", "below", "metres"]),
        (APRIL.replace("0.088", "-1"), ["tagSize", "below"]),
        (APRIL.replace("0.088", ".nan"), ["tagSize", "not a number"]),
        (APRIL.replace("0.088", "nan"), ["tagSize", "finite"]),
        (APRIL.replace("0.088", "big"), ["tagSize", "'big' is not a number"]),
        (APRIL.replace("tagSize:", "tagsize:"), ["tagsize", "did you mean tagSize?"]),
        (APRIL.replace("tagSize: 0.088\n", ""), ["tagSize", "missing"]),
        (APRIL.replace("tagCols: 6", "tagCols: 6.5"), ["tagCols", "whole number", "line 2"]),
        (APRIL.replace("tagCols: 6", "tagCols: 60").replace("tagRows: 5", "tagRows: 50"), ["587"]),
        (APRIL.replace("tagSpacing: 0.3", "tagSpacing: 30"), ["tagSpacing", "above 2"]),
        (APRIL + "codeOffset: 560\n", ["tagCols", "from id 560 on", "587"]),
        (APRIL + "codeOffset: -1\n", ["codeOffset", "below 0", "line 6"]),
        (APRIL.replace("0.088", "2").replace("tagCols: 6", "tagCols: 60"), ["board of"]),
        (APRIL + "tagSize: 0.1\n", ["given twice", "lines 4 and 6"]),
        (APRIL.replace("tagCols: 6", "tagCols: [6]"), ["line 2", "list"]),
        (APRIL.replace("tagCols: 6", "tagCols:"), ["tagCols", "no value"]),
        (APRIL.replace("aprilgrid", "circlegrid"), ["circlegrid", "aprilgrid or checkerboard"]),
        (CHECKER.replace("targetCols: 8", "targetCols: 2"), ["targetCols", "below 3", "inner corners"]),
        (CHECKER.replace("0.04", "40"), ["colSpacingMeters", "0.04"]),
        ("hello", ["expected lines like"]),
        ("", ["expected lines like"]),
        ("a: [1\nb: }", ["is not YAML"]),
        ("a: \x07", ["not YAML"]),
    ],
)
def test_bad_files_end_in_one_clear_line(tmp_path: Path, text: str, words: list[str]) -> None:
    path = write(tmp_path, text)
    with pytest.raises(TargetError) as caught:
        load_target(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    for word in words:
        assert word in message


def test_missing_binary_and_huge_files(tmp_path: Path) -> None:
    with pytest.raises(TargetError, match="no such file"):
        load_target(tmp_path / "none.yaml")
    with pytest.raises(TargetError, match="is a folder, a file is needed"):
        load_target(tmp_path)
    binary = tmp_path / "x.mcap"
    binary.write_bytes(b"\x89MCAP\xff\xfe")
    with pytest.raises(TargetError, match="not a text file"):
        load_target(binary)
    binary.write_bytes(b"a" * 100000)
    with pytest.raises(TargetError, match="larger than 66 kB"):
        load_target(binary)
