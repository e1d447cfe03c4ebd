"""A board laid out on a sheet of paper, to scale: what `vical target` writes as PDF or SVG.

A checkerboard needs no cv2; the codes of tags come from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from vical_daemon.vision.target import AprilGrid, Checkerboard, Target

PAPERS_MM: dict[str, tuple[float, float]] = {
    "a5": (148.0, 210.0),
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
MARGIN_MM = 8.0  # printers leave 4 to 6 mm of a page white
LABEL_MM = 5.0  # beside the board, for the numbers of rows and columns
FOOTER_MM = 17.0  # below it, for ruler and text
TEXT_MM = 2.6  # height of letters: 7 pt
RULER_MM = 100.0
"""Length of the ruler where the page is wide enough."""
LINE_MM = 0.3
"""More than a pixel of 1/96 inch, or a screen leaves some marks of the ruler out."""
Rectangle = tuple[float, float, float, float]


class SheetError(ValueError):
    """The board does not fit the paper; the message is one line for a person."""


@dataclass(frozen=True)
class Text:
    """Words on the sheet: lower-left corner (or middle) and height, mm."""

    x_mm: float
    y_mm: float
    words: str
    height_mm: float = TEXT_MM
    centred: bool = False


@dataclass(frozen=True)
class Sheet:
    """Everything on one page, mm from its lower-left corner, y up.

    Attributes:
        size_mm: Width and height of the page.
        black: Black rectangles x, y, width, height.
        texts: Labels and notes.
        origin_mm: Where the point with id 0 lies.
    """

    size_mm: tuple[float, float]
    black: list[Rectangle]
    texts: list[Text]
    origin_mm: tuple[float, float]


def paper_size_mm(paper: str) -> tuple[float, float]:
    """Size of a named paper or of "WIDTHxHEIGHT" in mm.

    Raises:
        SheetError: Neither.
    """
    if paper.lower() in PAPERS_MM:
        return PAPERS_MM[paper.lower()]
    try:
        width, height = (float(part) for part in paper.lower().removesuffix("mm").split("x"))
    except ValueError:
        names = ", ".join(sorted(PAPERS_MM))
        raise SheetError(f"paper {paper!r} is not known; use {names}, or e.g. 600x900 (mm)") from None
    if not (50 <= width <= 5000 and 50 <= height <= 5000):
        raise SheetError(f"paper {paper}: edges must lie between 50 and 5000 mm")
    return width, height


def lay_out(target: Target, paper: str) -> Sheet:
    """Put the board on the paper, upright or across, with ruler and notes.

    Raises:
        SheetError: The board is larger than the paper.
    """
    x0, y0, x1, y1 = board_extent_mm(target)
    page = _page(target, paper)
    if page is None:
        width, height = paper_size_mm(paper)
        need = _needed_mm(target)
        raise SheetError(
            f"the board needs {need[0]:.0f} x {need[1]:.0f} mm with its margins, {paper} has {width:.0f} x "
            f"{height:.0f}; {_advice(target, paper)}"
        )
    width, height = page
    origin = (
        (width + LABEL_MM - (x1 - x0)) / 2 - x0,
        (height + FOOTER_MM + LABEL_MM - (y1 - y0)) / 2 - y0,
    )
    black = [(x + origin[0], y + origin[1], w, h) for x, y, w, h in board_rectangles_mm(target)]
    texts = _labels(target, origin)
    ruler, notes = _footer(target, width)
    return Sheet((width, height), black + ruler, texts + notes, origin)


def _needed_mm(target: Target) -> tuple[float, float]:
    x0, y0, x1, y1 = board_extent_mm(target)
    return x1 - x0 + 2 * MARGIN_MM + LABEL_MM, y1 - y0 + 2 * MARGIN_MM + LABEL_MM + FOOTER_MM


def _page(target: Target, paper: str) -> tuple[float, float] | None:
    """The page, upright or else across, or None where the board does not fit."""
    short, long = sorted(paper_size_mm(paper))
    need = _needed_mm(target)
    for page in ((short, long), (long, short)):
        if need[0] <= page[0] + 1e-9 and need[1] <= page[1] + 1e-9:
            return page
    return None


def largest_on(target: Target, paper: str) -> Target:
    """The same board with the largest squares, in whole millimetres, that the paper takes.

    Raises:
        SheetError: Not even 2 mm fit.
    """
    for size_mm in range(400, 1, -1):
        candidate = _resized(target, size_mm / 1000)
        if _page(candidate, paper) is not None:
            return candidate
    raise SheetError(f"so many squares do not fit on {paper}; take fewer or a larger paper")


def board_extent_mm(target: Target) -> Rectangle:
    """Extent of the black parts around point 0: x0, y0, x1, y1, mm, y up."""
    if isinstance(target, AprilGrid):
        gap, pitch = target.gap_m * 1e3, target.pitch_m * 1e3
        return -gap, -gap, target.tag_cols * pitch, target.tag_rows * pitch
    w, h = target.col_spacing_m * 1e3, target.row_spacing_m * 1e3
    return -w, -target.rows * h, target.cols * w, h


def board_rectangles_mm(target: Target) -> list[Rectangle]:
    """Black rectangles x, y, width, height around point 0, mm, y up."""
    return _tag_rectangles(target) if isinstance(target, AprilGrid) else _squares(target)


def _tag_rectangles(target: AprilGrid) -> list[Rectangle]:
    from vical_daemon.vision.tag_code import BORDER, MODULES, tag_bits

    size, gap, pitch = target.tag_size_m * 1e3, target.gap_m * 1e3, target.pitch_m * 1e3
    module = size / MODULES
    rectangles: list[Rectangle] = []
    for row in range(target.tag_rows + 1):
        rectangles += [(c * pitch - gap, row * pitch - gap, gap, gap) for c in range(target.tag_cols + 1)]
    for tag in range(target.tag_cols * target.tag_rows):
        x, y = (tag % target.tag_cols) * pitch, (tag // target.tag_cols) * pitch
        border = BORDER * module
        rectangles += [(x, y, size, border), (x, y + size - border, size, border)]
        rectangles += [(x, y + border, border, size - 2 * border)]
        rectangles += [(x + size - border, y + border, border, size - 2 * border)]
        for line, bits in enumerate(tag_bits()[target.first_tag + tag]):
            bottom = y + size - border - (line + 1) * module
            for start, stop in _runs([not white for white in bits]):
                left = x + border + start * module
                rectangles.append((left, bottom, (stop - start) * module, module))
    return rectangles


def _runs(black: list[bool]) -> list[tuple[int, int]]:
    """Start and end of each run of True."""
    edges = [i for i in range(len(black) + 1) if (i and black[i - 1]) != (i < len(black) and black[i])]
    return list(zip(edges[::2], edges[1::2], strict=True))


def _squares(target: Checkerboard) -> list[Rectangle]:
    w, h = target.col_spacing_m * 1e3, target.row_spacing_m * 1e3
    return [
        ((col - 1) * w, -row * h, w, h)
        for row in range(target.rows + 1)
        for col in range(target.cols + 1)
        if (row + col) % 2 == 0
    ]


def _labels(target: Target, origin: tuple[float, float]) -> list[Text]:
    """Ids along the left edge (first point or tag of each row) and below (columns)."""
    x0, y0, _, _ = board_extent_mm(target)
    left, below = origin[0] + x0 - LABEL_MM, origin[1] + y0 - 0.8 * LABEL_MM
    if isinstance(target, AprilGrid):
        pitch, half = target.pitch_m * 1e3, target.tag_size_m * 5e2
        first = target.first_tag
        rows = [(first + r * target.tag_cols, r * pitch + half) for r in range(target.tag_rows)]
        cols = [(first + c, c * pitch + half) for c in range(target.tag_cols)]
    else:
        rows = [(r * target.cols, -r * target.row_spacing_m * 1e3) for r in range(target.rows)]
        cols = [(c, c * target.col_spacing_m * 1e3) for c in range(target.cols)]
    return [Text(left, origin[1] + y - TEXT_MM / 2, str(i)) for i, y in rows] + [
        Text(origin[0] + x, below, str(i), centred=True) for i, x in cols
    ]


def _footer(target: Target, width: float) -> tuple[list[Rectangle], list[Text]]:
    """A ruler of whole centimetres and what the board is."""
    length = min(RULER_MM, math.floor((width - 2 * MARGIN_MM) / 10) * 10)
    y = MARGIN_MM + TEXT_MM + 2.0
    ruler: list[Rectangle] = [(MARGIN_MM, y, length, LINE_MM)]
    for mark in range(int(length) // 5 + 1):
        tall = 3.0 if mark % 2 == 0 else 1.8
        ruler.append((MARGIN_MM + 5.0 * mark - LINE_MM / 2, y, LINE_MM, tall))
    notes = [
        Text(MARGIN_MM, y + 4.0, f"Print at 100 % (no scaling): this ruler is {length:.0f} mm"),
        Text(MARGIN_MM, MARGIN_MM, describe(target)),
    ]
    return ruler, notes


def describe(target: Target) -> str:
    """One line for the sheet."""
    if isinstance(target, AprilGrid):
        begin = f" from id {target.first_tag} on" if target.first_tag else ""
        return (
            f"vical aprilgrid 36h11  {target.tag_cols} x {target.tag_rows} tags{begin}  "
            f"tagSize {target.tag_size_m * 1e3:g} mm  tagSpacing {target.tag_spacing:g}"
        )
    return (
        f"vical checkerboard  {target.cols} x {target.rows} inner corners  "
        f"{target.col_spacing_m * 1e3:g} x {target.row_spacing_m * 1e3:g} mm"
    )


def _resized(target: Target, size_m: float) -> Target:
    if isinstance(target, AprilGrid):
        return replace(target, tag_size_m=size_m)
    ratio = target.row_spacing_m / target.col_spacing_m
    return Checkerboard(target.cols, target.rows, round(size_m * ratio, 6), size_m)


def _advice(target: Target, paper: str) -> str:
    try:
        fitting = largest_on(target, paper)
    except SheetError:
        return "take a larger paper or fewer squares"
    size = fitting.tag_size_m if isinstance(fitting, AprilGrid) else fitting.col_spacing_m
    return f"{size * 1e3:.0f} mm squares would fit, or take a larger paper"
