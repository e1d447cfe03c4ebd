"""What is printed is what the detector reads: the SVG's own rectangles are photographed and detected."""

import argparse
import json
import re

import numpy as np
import pytest
from vical_mocks.board_art import BoardArt
from vical_mocks.camera import CameraSettings, SimulatedCamera
from vical_mocks.lens import Lens

from vical_daemon.cli import target as command
from vical_daemon.cli.errors import CliError
from vical_daemon.vision.board_sheet import (
    LINE_MM,
    RULER_MM,
    SheetError,
    board_extent_mm,
    lay_out,
    paper_size_mm,
)
from vical_daemon.vision.detector import BoardDetector
from vical_daemon.vision.sheet_files import POINTS_PER_MM, to_pdf, to_svg
from vical_daemon.vision.target import AprilGrid, Checkerboard, load_target

BOARDS = [
    AprilGrid(4, 3, 0.04, 0.3),
    AprilGrid(3, 3, 0.04, 0.25, first_tag=36),
    Checkerboard(7, 6, 0.02, 0.025),
]


def svg_rectangles(svg, height):
    """x, y (up), width, height of every black rectangle, mm."""
    found = re.findall(r'<rect x="([\d.-]+)" y="([\d.-]+)" width="([\d.]+)" height="([\d.]+)"/>', svg)
    return [(x, height - y - h, w, h) for x, y, w, h in np.array(found, float)]


def arguments(*words):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(words)


@pytest.mark.parametrize("board", BOARDS)
def test_the_printed_board_is_detected_at_its_true_size(board):
    sheet = lay_out(board, "a4")
    rectangles = svg_rectangles(to_svg(sheet), sheet.size_mm[1])
    flip = 1.0 if board.kind == "aprilgrid" else -1.0
    ox, oy = sheet.origin_mm
    black = []
    for x, y, w, h in rectangles:
        ys = sorted([flip * (y - oy), flip * (y + h - oy)])
        black.append([x - ox, ys[0], x + w - ox, ys[1]])
    page = sorted([flip * -oy, flip * (sheet.size_mm[1] - oy)])
    paper = (-ox / 1e3, page[0] / 1e3, (sheet.size_mm[0] - ox) / 1e3, page[1] / 1e3)
    art = BoardArt(np.array(black) / 1e3, paper, int(flip))
    middle = board.points_m.mean(axis=0)

    def pose(t_s):
        R = np.eye(3) if flip < 0 else np.diag([1.0, -1.0, -1.0])
        return R[None], (middle + np.array([0, 0, flip * 0.3]))[None]

    camera = SimulatedCamera(art, Lens(), pose, CameraSettings(exposure_s=0.0))
    found = BoardDetector(board).detect(camera.render(0.0))
    uv, _ = camera.project(board.points_m, 0.0)
    np.testing.assert_array_equal(found.ids, np.arange(len(board.points_m)))
    assert np.abs(found.uv_px - uv).max() < 0.1


@pytest.mark.parametrize("board", BOARDS)
def test_pdf_and_svg_hold_the_same_rectangles(board):
    sheet = lay_out(board, "a4")
    pdf = to_pdf(sheet, "board")
    assert pdf == to_pdf(sheet, "board")
    found = re.findall(rb"n ([\d.-]+) ([\d.-]+) ([\d.]+) ([\d.]+) re f", pdf)
    in_mm = np.array(found, float) / POINTS_PER_MM
    np.testing.assert_allclose(in_mm, svg_rectangles(to_svg(sheet), sheet.size_mm[1]), atol=2e-3)
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", pdf)
    np.testing.assert_allclose([float(v) / POINTS_PER_MM for v in box.groups()], sheet.size_mm, atol=1e-3)


def test_everything_lies_on_the_page_and_the_ruler_is_true():
    for board in BOARDS:
        sheet = lay_out(board, "a4")
        black = np.array(sheet.black)
        assert black[:, :2].min() > 5
        assert np.all(black[:, :2] + black[:, 2:] < np.array(sheet.size_mm) - 5)
        (ruler,) = (r for r in sheet.black if r[2:] == (RULER_MM, LINE_MM))
        marks = [x + w / 2 for x, y, w, _ in sheet.black if w == LINE_MM and y == ruler[1]]
        np.testing.assert_allclose(marks, ruler[0] + np.arange(0.0, RULER_MM + 1, 5.0), atol=1e-9)
        x0, y0, x1, y1 = board_extent_mm(board)
        points = board.points_m[:, :2] * 1e3 * [1, 1 if board.kind == "aprilgrid" else -1]
        assert np.all(points >= [x0, y0]) and np.all(points <= [x1, y1])


def test_a_board_too_large_says_what_would_fit():
    with pytest.raises(SheetError, match=r"needs 7\d\d x .* mm squares would fit"):
        lay_out(AprilGrid(6, 6, 0.088, 0.3), "a4")
    assert lay_out(AprilGrid(6, 6, 0.088, 0.3), "a0").size_mm == (841.0, 1189.0)
    assert lay_out(Checkerboard(9, 5, 0.025, 0.025), "a4").size_mm == (297.0, 210.0)


@pytest.mark.parametrize("paper", ["a4x", "10x10", "axb"])
def test_unknown_papers(paper):
    with pytest.raises(SheetError, match="paper"):
        paper_size_mm(paper)
    assert paper_size_mm("600x900") == (600.0, 900.0)


def test_the_command_writes_board_and_yaml(tmp_path, capsys):
    out = tmp_path / "board.pdf"
    assert command.run(arguments("--type", "aprilgrid", "-o", str(out), "--json")) == 0
    row = json.loads(capsys.readouterr().out)
    target = load_target(row["yaml"])
    assert out.read_bytes().startswith(b"%PDF")
    assert row["points"] == 144
    assert target == AprilGrid(6, 6, 0.023, 0.3)
    again = tmp_path / "again.svg"
    assert command.run(arguments("--from", row["yaml"], "-o", str(again))) == 0
    assert "aprilgrid" in capsys.readouterr().out
    assert load_target(again.with_suffix(".yaml")) == target


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--type", "aprilgrid", "-o", "b.png"), "pdf or .svg"),
        (("--type", "aprilgrid", "--tag-size", "88mm", "-o", "b.pdf"), "would fit"),
        (("--type", "aprilgrid", "--tag-size", "big", "-o", "b.pdf"), "give metres"),
        (("--type", "aprilgrid", "--tag-cols", "600", "-o", "b.pdf"), "above 587"),
        (("--type", "checkerboard", "--cols", "2", "-o", "b.pdf"), "below 3"),
        (("--type", "checkerboard", "--square", "88", "-o", "b.pdf"), "metres"),
        (
            ("--type", "aprilgrid", "--cols", "0", "-o", "b.pdf"),
            "--cols is for checkerboard",
        ),
        (("--from", "t.yaml", "--rows", "3", "-o", "b.pdf"), "not for a board from a file"),
        (("--from", "none.yaml", "-o", "b.pdf"), "no such file"),
        (("--type", "checkerboard", "-o", "none/b.pdf"), "cannot be written"),
    ],
)
def test_bad_use_ends_in_one_line(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CliError, match=message) as caught:
        command.run(arguments(*words))
    assert "\n" not in str(caught.value)
