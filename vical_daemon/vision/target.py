"""Calibration targets: where the points of a printed board lie, read from Kalibr's target YAML.

Frame ``target``: origin at the point with id 0, every point has z = 0, x to the right as one looks at the
printed side. AprilGrid (Kalibr's order): y up, hence z towards the viewer, and a camera that sees the board
has positive z. Checkerboard (OpenCV's order): y down, hence z away from the viewer, and a camera that sees
the board has negative z.

No image is touched here and cv2 is not needed: the estimator's side may import this module freely.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from vical_daemon.vision.target_yaml import TargetError, TargetFile

FloatArray = npt.NDArray[np.float64]

TAG_FAMILY_SIZE = 587
"""Number of codes in the 36h11 family: ids run from 0 to 586."""

MAX_BOARD_M = 20.0  # a wall of a hall; larger ones are in millimetres by mistake
MAX_SPACING_RATIO = 2.0  # gaps twice as wide as the tags
MAX_CHECKERBOARD_CORNERS = 200  # along one side


@dataclass(frozen=True)
class AprilGrid:
    """A grid of AprilTags of the 36h11 family, as Kalibr prints it.

    Tag ids run along x first, then up, from ``first_tag`` on. ``point_id = 4 * (tag_id - first_tag) +
    corner``, corners 0..3 at (0,0), (s,0), (s,s), (0,s) from the tag's lower-left corner, s =
    ``tag_size_m``. Tags repeat every ``tag_size_m * (1 + tag_spacing)``.

    Attributes:
        tag_cols: Tags along x.
        tag_rows: Tags along y.
        tag_size_m: Edge of a tag's black square, m.
        tag_spacing: Gap between tags divided by `tag_size_m`.
        first_tag: Id of the tag at the origin (Kalibr's `codeOffset`).
    """

    tag_cols: int
    tag_rows: int
    tag_size_m: float
    tag_spacing: float
    first_tag: int = 0
    kind: ClassVar[str] = "aprilgrid"
    alike_upside_down: ClassVar[bool] = False  # each tag says where it belongs

    @property
    def pitch_m(self) -> float:
        """Distance from one tag to the next, m."""
        return self.tag_size_m * (1.0 + self.tag_spacing)

    @property
    def gap_m(self) -> float:
        """White gap between tags, which is the edge of the small black squares too, m."""
        return self.tag_size_m * self.tag_spacing

    @cached_property
    def points_m(self) -> FloatArray:
        """Points in the target frame, shape (4 * tags, 3), m; the row index is the point id."""
        s = self.tag_size_m
        corner = np.array([[0.0, 0.0], [s, 0.0], [s, s], [0.0, s]])
        row, col = np.divmod(np.arange(self.tag_cols * self.tag_rows), self.tag_cols)
        origin = np.stack([col, row], axis=1) * self.pitch_m
        xy = (origin[:, None, :] + corner[None, :, :]).reshape(-1, 2)
        return _frozen(np.column_stack([xy, np.zeros(len(xy))]))

    def to_yaml(self) -> str:
        """Return Kalibr's target file for this board."""
        return (
            "target_type: aprilgrid\n"
            f"tagCols: {self.tag_cols}\n"
            f"tagRows: {self.tag_rows}\n"
            f"tagSize: {self.tag_size_m!r}     # m, edge of a tag's black square\n"
            f"tagSpacing: {self.tag_spacing!r}     # gap between tags / tagSize\n"
            + (f"codeOffset: {self.first_tag}     # id of the first tag\n" if self.first_tag else "")
        )


@dataclass(frozen=True)
class Checkerboard:
    """A checkerboard, described by its inner corners.

    ``point_id = row * cols + col`` at (col * col_spacing_m, row * row_spacing_m): rows count downwards. Where
    ``cols + rows`` is odd the two ends differ in colour and the square above and left of point 0 is black;
    otherwise a half turn maps the board onto itself, and one image cannot tell which end is up.

    Attributes:
        cols: Inner corners along x.
        rows: Inner corners along y.
        row_spacing_m: Distance between rows (along y), m.
        col_spacing_m: Distance between columns (along x), m.
    """

    cols: int
    rows: int
    row_spacing_m: float
    col_spacing_m: float
    kind: ClassVar[str] = "checkerboard"

    @property
    def alike_upside_down(self) -> bool:
        """Whether a half turn maps the board onto itself."""
        return (self.cols + self.rows) % 2 == 0

    @cached_property
    def points_m(self) -> FloatArray:
        """Points in the target frame, shape (rows * cols, 3), m; the row index is the point id."""
        row, col = np.divmod(np.arange(self.cols * self.rows), self.cols)
        return _frozen(
            np.column_stack([col * self.col_spacing_m, row * self.row_spacing_m, np.zeros(len(row))])
        )

    def to_yaml(self) -> str:
        """Return Kalibr's target file for this board."""
        return (
            "target_type: checkerboard\n"
            f"targetCols: {self.cols}     # inner corners\n"
            f"targetRows: {self.rows}\n"
            f"rowSpacingMeters: {self.row_spacing_m!r}\n"
            f"colSpacingMeters: {self.col_spacing_m!r}\n"
        )


Target = AprilGrid | Checkerboard


def load_target(path: str | Path) -> Target:
    """Read a target YAML in Kalibr's format.

    Args:
        path: The file. ``target_type: aprilgrid`` (tagCols tagRows tagSize tagSpacing [codeOffset]) or
            ``target_type: checkerboard`` (targetCols targetRows rowSpacingMeters colSpacingMeters).

    Raises:
        TargetError: The file is missing, no YAML, has unknown, missing or doubled keys, or a value out of
            bounds; one line naming file, line, key, bound and what to try.
    """
    return _build(TargetFile.read(Path(path)))


def parse_target(text: str, path: str | Path) -> Target:
    """Read a target from the text of a file; `path` is only named in errors.

    Raises:
        TargetError: As `load_target`.
    """
    return _build(TargetFile.parse(text, Path(path)))


def _build(file: TargetFile) -> Target:
    kind = file.text("target_type")
    if kind == "aprilgrid":
        return _aprilgrid(file)
    if kind == "checkerboard":
        return _checkerboard(file)
    raise file.error("target_type", f"{kind!r} is not known; use aprilgrid or checkerboard")


def _aprilgrid(file: TargetFile) -> AprilGrid:
    file.only("target_type", "tagCols", "tagRows", "tagSize", "tagSpacing", "codeOffset")
    cols = file.integer("tagCols", 1, TAG_FAMILY_SIZE)
    rows = file.integer("tagRows", 1, TAG_FAMILY_SIZE)
    first = file.integer("codeOffset", 0, TAG_FAMILY_SIZE - 1) if "codeOffset" in file.values else 0
    if first + cols * rows > TAG_FAMILY_SIZE:
        begin = f" from id {first} on" if first else ""
        text = f"{cols} x {rows} tags{begin} are more than the {TAG_FAMILY_SIZE} of the 36h11 family"
        raise file.error("tagCols", text)
    size = file.length("tagSize", 0.002, 2.0)
    spacing = file.number(
        "tagSpacing", 0.02, MAX_SPACING_RATIO, hint="it is the gap divided by tagSize, often 0.3"
    )
    _check_board_size(file, "tagSize", max(cols, rows) * size * (1 + spacing))
    return AprilGrid(cols, rows, size, spacing, first)


def _checkerboard(file: TargetFile) -> Checkerboard:
    file.only("target_type", "targetCols", "targetRows", "rowSpacingMeters", "colSpacingMeters")
    hint = "count inner corners, one less than squares"
    cols = file.integer("targetCols", 3, MAX_CHECKERBOARD_CORNERS, hint=hint)
    rows = file.integer("targetRows", 3, MAX_CHECKERBOARD_CORNERS, hint=hint)
    row_spacing = file.length("rowSpacingMeters", 0.001, 2.0)
    col_spacing = file.length("colSpacingMeters", 0.001, 2.0)
    _check_board_size(file, "colSpacingMeters", max(cols * col_spacing, rows * row_spacing))
    return Checkerboard(cols, rows, row_spacing, col_spacing)


def _check_board_size(file: TargetFile, key: str, size_m: float) -> None:
    if size_m > MAX_BOARD_M:
        raise file.error(
            key, f"makes a board of {size_m:.1f} m, above {MAX_BOARD_M:g} m; lengths are in metres"
        )


def _frozen(array: FloatArray) -> FloatArray:
    array.setflags(write=False)
    return array


__all__ = ["AprilGrid", "Checkerboard", "Target", "TargetError", "load_target", "parse_target"]
