"""What is printed on a calibration board: its black rectangles, drawn from the published definitions.

Kept apart from the daemon on purpose: the daemon prints and detects boards with its own code, and both have
to agree on where a corner lies and which way up a tag stands.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, cast

import cv2
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

TAG_BITS = 6
TAG_BORDER_BITS = 2
TAG_MODULES = TAG_BITS + 2 * TAG_BORDER_BITS


class GridOfTags(Protocol):
    """An AprilGrid; tags and gaps as in Kalibr's target file."""

    kind: str
    tag_cols: int
    tag_rows: int
    tag_size_m: float
    tag_spacing: float


class GridOfSquares(Protocol):
    """A checkerboard by its inner corners."""

    kind: str
    cols: int
    rows: int
    row_spacing_m: float
    col_spacing_m: float


@dataclass(frozen=True)
class BoardArt:
    """A board as ink on white paper.

    Attributes:
        black_m: Disjoint black rectangles x0, y0, x1, y1 in the target plane, m, shape (n, 4).
        paper_m: Extent of the white paper, x0, y0, x1, y1, m.
        front: Sign of z on the printed side: +1 y runs up for the viewer (AprilGrid), -1 y runs down.
    """

    black_m: FloatArray
    paper_m: tuple[float, float, float, float]
    front: int


def draw_board(target: object) -> BoardArt:
    """Draw `target`: anything with the attributes of `GridOfTags` or `GridOfSquares`, or art itself.

    Raises:
        ValueError: The kind is neither aprilgrid nor checkerboard.
    """
    if isinstance(target, BoardArt):
        return target
    kind = getattr(target, "kind", None)
    if kind == "aprilgrid":
        return _draw_tags(cast(GridOfTags, target))
    if kind == "checkerboard":
        return _draw_squares(cast(GridOfSquares, target))
    raise ValueError(f"cannot draw a board of kind {kind!r}; use aprilgrid or checkerboard")


def tag_modules(tag_id: int) -> npt.NDArray[np.bool_]:
    """Black modules of a 36h11 tag, upright as Kalibr prints it, shape (10, 10), first row on top.

    OpenCV draws the family upside down compared with the published code words (most significant bit at the
    upper left, bit 1 white), hence the half turn.
    """
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    bits = cv2.aruco.generateImageMarker(family, tag_id, TAG_BITS + 2)[1:-1, 1:-1]
    black = np.ones((TAG_MODULES, TAG_MODULES), bool)
    inner = slice(TAG_BORDER_BITS, TAG_BORDER_BITS + TAG_BITS)
    black[inner, inner] = np.rot90(bits, 2) == 0
    return black


def _draw_tags(target: GridOfTags) -> BoardArt:
    size, gap = target.tag_size_m, target.tag_size_m * target.tag_spacing
    pitch = size + gap
    rectangles: list[tuple[float, float, float, float]] = []
    for row in range(target.tag_rows):
        for col in range(target.tag_cols):
            tag_id = getattr(target, "first_tag", 0) + row * target.tag_cols + col
            rectangles += _draw_tag(tag_id, col * pitch, row * pitch, size)
    for row in range(target.tag_rows + 1):
        for col in range(target.tag_cols + 1):
            x, y = col * pitch - gap, row * pitch - gap
            rectangles.append((x, y, x + gap, y + gap))
    margin = 2 * gap
    paper = (-margin, -margin, target.tag_cols * pitch - gap + margin, target.tag_rows * pitch - gap + margin)
    return BoardArt(np.array(rectangles), paper, +1)


def _draw_tag(tag_id: int, x: float, y: float, size: float) -> list[tuple[float, float, float, float]]:
    """One tag as runs of black modules; (x, y) is its lower-left corner."""
    module = size / TAG_MODULES
    rectangles = []
    for line, black in enumerate(tag_modules(tag_id)):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], black.astype(np.int8), [0]])))
        bottom = y + (TAG_MODULES - 1 - line) * module
        for start, stop in edges.reshape(-1, 2):
            rectangles.append((x + start * module, bottom, x + stop * module, bottom + module))
    return rectangles


def _draw_squares(target: GridOfSquares) -> BoardArt:
    """Squares around the inner corners; the one at the upper left (before point 0) is black, y runs down."""
    w, h = target.col_spacing_m, target.row_spacing_m
    rectangles = [
        ((col - 1) * w, (row - 1) * h, col * w, row * h)
        for row in range(target.rows + 1)
        for col in range(target.cols + 1)
        if (row + col) % 2 == 0
    ]
    paper = (-1.5 * w, -1.5 * h, (target.cols + 0.5) * w, (target.rows + 0.5) * h)
    return BoardArt(np.array(rectangles), paper, -1)
