"""What is said of a board that is not the one of the target file, from rendered pictures."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from vical_daemon.vision import target_check
from vical_daemon.vision.detector import BoardDetector
from vical_daemon.vision.target import AprilGrid, Checkerboard
from vical_daemon.vision.target_check import TargetCheck, contradiction

GRID, BOARD = AprilGrid(6, 6, 0.088, 0.3), Checkerboard(8, 7, 0.05, 0.05)
PICTURES: dict[int, np.ndarray] = {}  # of the grid, by seed


@pytest.mark.parametrize(
    ("stated", "text"),
    [
        (GRID, ""),
        (replace(GRID, tag_spacing=0.305), ""),  # less than a ruler shows
        (replace(GRID, tag_spacing=0.28), "0.30 times as large as the tags, .* tagSpacing: 0.28"),
        (replace(GRID, tag_spacing=0.0264), "0.30 times .* tagSpacing: 0.0264"),  # in metres
        (replace(GRID, tag_cols=5, tag_rows=7), "rows of 6, the target file states tagCols: 5"),
        (replace(GRID, tag_cols=7, tag_rows=7), "rows of 6, the target file states tagCols: 7"),
        (replace(GRID, first_tag=36), r"other tags than those of the target file \(36 to 71\)"),
        (BOARD, "AprilTags are in view, the target file states a checkerboard"),
    ],
)
@pytest.mark.parametrize("seed", [3, 4])
def test_a_grid_of_tags(film, stated, text, seed):
    if seed not in PICTURES:
        PICTURES[seed] = film(GRID, 0.9, seed=seed, exposure_s=0.003).render(0.2)
    said = contradiction(PICTURES[seed], stated)
    assert said is not None
    assert re.search(text, said) if text else said == ""


def test_lens_size_and_part_of_the_board_do_not_matter(film, fisheye):
    board = AprilGrid(10, 7, 0.05, 0.25)
    for camera in (film(board, 0.35, lens=fisheye), film(board, 1.4), film(board, 0.3)):
        said = [contradiction(camera.render(0.3 * k), board) for k in range(4)]
        assert set(said) <= {"", None} and "" in said


@pytest.mark.parametrize(("cols", "rows"), [(9, 8), (7, 6), (9, 7)])
def test_squares_counted_for_corners(film, cols, rows):
    stated = replace(BOARD, cols=cols, rows=rows)
    said = contradiction(film(BOARD, 0.7).render(0.0), stated)
    assert said == (
        f"a checkerboard with 8 x 7 inner corners is in view, the target file states {cols} x {rows}: "
        "count inner corners, one less than squares"
    )


@pytest.mark.parametrize(
    ("board", "distance_m"), [(BOARD, 0.9), (Checkerboard(9, 6, 0.06, 0.06), 1.4), (BOARD, 2.0)]
)
def test_a_checkerboard_of_any_counts_in_place_of_tags_or_another_one(film, board, distance_m):
    camera = film(board, distance_m, exposure_s=0.003)
    text = f"a checkerboard with {board.cols} x {board.rows} inner corners is in view, the target file states"
    for stated, what in ((GRID, "an aprilgrid: "), (Checkerboard(11, 5, 0.05, 0.05), "11 x 5: ")):
        said = [contradiction(camera.render(0.4 * k), stated) for k in range(3)]
        assert set(said) <= {None, said[0]} and said.count(said[0]) >= 2
        assert said[0] is not None and said[0].startswith(f"{text} {what}")


def test_a_part_of_a_board_is_no_other_board(film):
    """Neither one that the image cuts off nor one that a hand hides from there on."""
    camera = film(BOARD, 0.7)
    picture = camera.render(0.0)
    u = camera.project(BOARD.points_m, 0.0)[0][:, 0].reshape(BOARD.rows, BOARD.cols)
    cut = round(float(np.mean(u[:, -2:])))  # between the last two columns of corners
    left = np.ascontiguousarray(picture[:, :cut])
    hidden = picture.copy()
    hidden[: picture.shape[0] // 3] = 90
    assert contradiction(picture, GRID) is not None
    assert {contradiction(part, target) for part in (left, hidden) for target in (GRID, BOARD)} == {None}


def test_tags_of_another_family():
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_25h9)
    picture = np.full((480, 640), 220, np.uint8)
    for k in range(12):
        u, v = 40 + 140 * (k % 4), 30 + 140 * (k // 4)
        picture[v : v + 100, u : u + 100] = cv2.aruco.generateImageMarker(family, k, 100)
    said = [contradiction(picture, GRID, turn) for turn in range(9)]
    assert any(text and "family AprilTag 25h9 with a border of 1 bits" in text for text in said)


def test_an_empty_scene_says_nothing():
    picture = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
    picture = cv2.resize(picture, (640, 480), interpolation=cv2.INTER_CUBIC)
    assert {contradiction(picture, target, turn) for target in (GRID, BOARD) for turn in range(9)} == {None}


def test_two_pictures_must_agree_and_it_is_told_once(film):
    told: list[str] = []
    stated = replace(GRID, tag_spacing=0.25)
    detector, camera = BoardDetector(stated, check=TargetCheck(stated, told.append)), film(GRID, 0.9)
    counts, pictures = [], [camera.render(0.02 * k) for k in range(20)]
    for k in range(80):
        assert detector.detect(pictures[k % 20], 20_000_000 * k) is not None
        counts.append(len(told))
    assert counts.index(1) == 2 * target_check._FIRST - 1 and counts[-1] == 1


@pytest.mark.parametrize(("cols", "text"), [(7, "8 x 7 inner corners is in view, .* states 7 x 7"), (8, "")])
def test_fewer_columns_are_told_although_such_a_board_is_found_in_some_images(film, cols, text):
    """One of ten images of a larger board shows it; after the first of them nothing was checked any more."""
    told: list[str] = []
    check, picture = TargetCheck(replace(BOARD, cols=cols), told.append), film(BOARD, 0.7).render(0.0)
    for _ in range(2 * target_check._FIRST):
        check.take(picture)
    assert bool(told) == bool(text) and re.search(text, "".join(told))


def test_a_board_that_fits_is_looked_at_once(film, monkeypatch):
    looks: list[int] = []
    monkeypatch.setattr(target_check, "contradiction", lambda *_: looks.append(1) or "")
    check = TargetCheck(GRID, lambda text: pytest.fail(text))
    for _ in range(100):
        check.take(np.zeros((4, 4), np.uint8))
    assert len(looks) == 1


def test_without_a_board_the_checks_go_on_and_cost_little(monkeypatch):
    looks: list[int] = []
    monkeypatch.setattr(target_check, "contradiction", lambda *_: looks.append(1))
    check = TargetCheck(GRID, lambda text: pytest.fail(text))
    for _ in range(10_000):
        check.take(np.zeros((4, 4), np.uint8))
    assert 65 <= len(looks) <= 90  # a board that comes later is told of within 15 s at 20 Hz
