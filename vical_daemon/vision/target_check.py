"""Finds how images contradict the target file: other tags, another layout, other counts of corners.

A board that differs from its target file is not found, or worse, found in part. The user then reads that the
target is not in view. So some images are compared with boards that differ from the file by a usual mistake.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from vical_daemon.vision.aprilgrid import search_tags
from vical_daemon.vision.detection import FloatArray, Gray, IntArray
from vical_daemon.vision.grid_model import fit_grid
from vical_daemon.vision.saddle import SaddleImage
from vical_daemon.vision.target import TAG_FAMILY_SIZE, AprilGrid, Checkerboard, Target

_ANY_TAG = AprilGrid(TAG_FAMILY_SIZE, 1, 1.0, 0.3)
MIN_TAGS = 6
"""Least number of tags that show a layout: twelve coordinates, for eight numbers of a homography, one of a
lens, and the layout."""
MAX_MISFIT = 0.03
"""Largest RMS distance of tags from their places in the right layout, over the edge of a tag. In rendered
images it is at most 0.02, also with a fisheye lens; with a wrong number of columns it is 1 to 3."""
SPACING_ERROR = 0.01
"""Least difference of tagSpacing that is reported: 1 mm for tags of 100 mm, what a ruler shows."""
_FIRST = 10  # the first image that is checked, and how many lie between a finding and its confirmation
_EVERY, _RAREST, _RARER = 30, 150, 0.25
"""Images from one check to the next: at first, at most, and as a share of all so far. A check takes
0.1 to 0.2 s, while a search for a board that is not there takes some milliseconds an image."""
_TAGS_A_TURN = 4  # kinds of tags that one image is searched for
_MAX_COLS = 30  # of boards that are tried
_SPACINGS = np.geomspace(0.02, 2.0, 24)  # gaps over tags that are tried first
_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])  # of a tag, in edges
# a checkerboard of unknown counts: at least so many inner corners
_SMALLEST, _ANY_COUNTS = (3, 3), cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
_GOES_ON = 0.3
"""Of the contrast of the squares: what lies around them alternates by more where a board goes on."""
_FAMILIES = {
    "AprilTag 36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "AprilTag 36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "AprilTag 25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "AprilTag 16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "ArUco 6x6": cv2.aruco.DICT_6X6_250,
    "ArUco 5x5": cv2.aruco.DICT_5X5_250,
    "ArUco 4x4": cv2.aruco.DICT_4X4_250,
}
_OTHER_TAGS = [
    (name, border) for border in (1, 2) for name in _FAMILIES if (name, border) != ("AprilTag 36h11", 2)
]


class TargetCheck:
    """Compares images of one camera with the target file, until one fits or two agree on a mistake.

    Args:
        target: As the file states it.
        report: Called once, with what the images contradict, one line.
    """

    def __init__(self, target: Target, report: Callable[[str], None]) -> None:
        self._target, self._report = target, report
        self._settled = False
        self._turn = self._taken = 0
        self._next = _FIRST
        self._last = ""

    def take(self, gray: Gray) -> None:
        """Check an image, if it is one's turn.

        Args:
            gray: The image, uint8.
        """
        self._taken += 1
        if self._settled or self._taken < self._next:
            return
        text = contradiction(gray, self._target, self._turn)
        later = min(max(_EVERY, round(_RARER * self._taken)), _RAREST)
        self._next = self._taken + (_FIRST if text else later)
        if text is None:
            self._turn += 1
            return
        self._settled = text in ("", self._last)
        if self._settled and text:
            self._report(text)
        self._last = text


def contradiction(gray: Gray, target: Target, turn: int = 0) -> str | None:
    """Return what in the target file an image contradicts, "" if it fits, None if the image does not show it.

    Args:
        gray: The image, uint8.
        target: As the file states it.
        turn: Number of the check: other boards that take long to search for are tried in turn.
    """
    ids, quads = search_tags(SaddleImage(gray), gray, _ANY_TAG)
    if isinstance(target, Checkerboard):
        if len(ids) >= MIN_TAGS:
            return "AprilTags are in view, the target file states a checkerboard"
        return _other_counts(gray, target)
    if len(ids) < MIN_TAGS:
        return _other_tags(gray, turn // 2) if turn % 2 else _no_tags(gray)
    last = target.first_tag + target.tag_cols * target.tag_rows - 1
    if np.count_nonzero((ids < target.first_tag) | (ids > last)) > 0.5 * len(ids):
        return (
            f"other tags than those of the target file ({target.first_tag} to {last}) are in view: "
            "check codeOffset, tagCols and tagRows"
        )
    return _other_layout(ids - target.first_tag, quads, target, (gray.shape[0], gray.shape[1]))


def _other_layout(
    index: IntArray, quads: FloatArray, target: AprilGrid, shape: tuple[int, int]
) -> str | None:
    if _misfit_of_rows(index, quads, target.tag_cols, shape) > MAX_MISFIT:
        others = range(1, _MAX_COLS + 1)
        fitting = [cols for cols in others if _misfit_of_rows(index, quads, cols, shape) < MAX_MISFIT]
        if len(fitting) != 1:  # tags of one or two rows fit several
            return None
        return f"the tags stand in rows of {fitting[0]}, the target file states tagCols: {target.tag_cols}"
    spacing = _spacing(index, quads, target.tag_cols, shape)
    if abs(spacing - target.tag_spacing) > SPACING_ERROR:
        return (
            f"the gaps between tags are {spacing:.2f} times as large as the tags, "
            f"the target file states tagSpacing: {target.tag_spacing:g}"
        )
    return ""


def _misfit_of_rows(index: IntArray, quads: FloatArray, cols: int, shape: tuple[int, int]) -> float:
    """RMS distance of the centres of tags from a grid with `cols` columns, over the edge of a tag."""
    at = np.stack([index % cols, index // cols], axis=1).astype(np.float64)
    if cols > 1 and np.ptp(at[:, 0]) == 0.0:
        return float("inf")
    middle = _crossing(quads)
    return _misfit(at, middle, shape) / float(_edges(quads).mean())


def _spacing(index: IntArray, quads: FloatArray, cols: int, shape: tuple[int, int]) -> float:
    """Gap between tags over their size, by the best fit of all corners: on a grid that is refined twice."""
    at = np.stack([index % cols, index // cols], axis=1)[:, None]
    spacings = _SPACINGS
    for _ in range(3):
        places = [((1.0 + spacing) * at + _CORNERS).reshape(-1, 2) for spacing in spacings]
        k = int(np.argmin([_misfit(xy, quads.reshape(-1, 2), shape) for xy in places]))
        best, low, high = spacings[k], spacings[max(k - 1, 0)], spacings[min(k + 1, len(spacings) - 1)]
        spacings = np.linspace(low, high, 9)
    return float(best)


def _misfit(xy: FloatArray, uv_px: FloatArray, shape: tuple[int, int]) -> float:
    """RMS distance of points from a flat board with these coordinates, px."""
    model = fit_grid(xy, uv_px, shape)
    if model is None:
        return float("inf")
    error = np.linalg.norm(model.predict(xy) - uv_px, axis=1)
    return float(np.sqrt(np.mean(np.where(np.isfinite(error), error, max(shape)) ** 2)))


def _edges(quads: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2))


def _crossing(quads: FloatArray) -> FloatArray:
    """Where the diagonals of quadrilaterals cross, the image of the middle, shape (n, 2)."""
    p, a, b = quads[:, 0], quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    c = quads[:, 1] - p
    along = (c[:, 0] * b[:, 1] - c[:, 1] * b[:, 0]) / (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return np.asarray(p + along[:, None] * a)


def _other_tags(gray: Gray, turn: int) -> str | None:
    for k in range(_TAGS_A_TURN):
        name, border = _OTHER_TAGS[(turn * _TAGS_A_TURN + k) % len(_OTHER_TAGS)]
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        parameters.errorCorrectionRate = 0.0
        family = cv2.aruco.getPredefinedDictionary(_FAMILIES[name])
        _, ids, _ = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(gray)
        if ids is not None and len(np.unique(ids)) >= MIN_TAGS:
            return (
                f"tags of the family {name} with a border of {border} bits are in view; vical reads "
                "AprilTag 36h11 with a border of 2 bits, as Kalibr prints it (`vical target` makes a board)"
            )
    return None


def _no_tags(gray: Gray) -> str | None:
    found = _board_in_view(gray)
    if found is None:
        return None
    return (
        f"a checkerboard with {found[0]} x {found[1]} inner corners is in view, the target file states an "
        "aprilgrid: give its target file (`target_type: checkerboard`)"
    )


def _board_in_view(gray: Gray) -> tuple[int, int] | None:
    """Return the counts of inner corners of a whole checkerboard, the larger first; None: no board.

    A board that may go on beyond the border of the image, or whose squares do not alternate, is none.
    """
    from vical_daemon.vision.detector import BoardDetector

    found, corners, squares = cv2.findChessboardCornersSBWithMeta(gray, _SMALLEST, _ANY_COUNTS)
    if not found:
        return None
    rows, cols = squares.shape
    if not _ends_in_view(np.asarray(corners, np.float64).reshape(rows, cols, 2), gray):
        return None
    board = Checkerboard(max(cols, rows), min(cols, rows), 1.0, 1.0)
    if BoardDetector(board, guided=False).detect(gray) is None:
        return None
    return board.cols, board.rows


def _ends_in_view(grid: FloatArray, gray: Gray) -> bool:
    """Whether what surrounds the outer squares is in the image, and no further row or column of squares.

    Args:
        grid: Inner corners, px, shape (rows, cols, 2).
        gray: The image.
    """
    image = SaddleImage(gray)
    inside = image.levels((grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4)
    row, col = np.indices(inside.shape)
    contrast = abs(float(np.mean(np.where((row + col) % 2, 1.0, -1.0) * (inside - inside.mean()))))
    for side in (grid, grid[::-1], grid.swapaxes(0, 1), grid.swapaxes(0, 1)[::-1]):
        edge, inner = ((line[1:] + line[:-1]) / 2 for line in side[:2])
        beyond = edge + 1.5 * (edge - inner)  # middles of the squares that a larger board would have there
        if not np.all((beyond >= 0) & (beyond < gray.shape[1::-1])):
            return False
        levels = image.levels(beyond)
        signs = np.where(np.arange(len(levels)) % 2, 1.0, -1.0)
        if abs(float(np.mean(signs * (levels - levels.mean())))) > _GOES_ON * contrast:
            return False
    return True


def _other_counts(gray: Gray, target: Checkerboard) -> str | None:
    found = _board_in_view(gray)
    if found is None:
        return None
    if found == (max(target.cols, target.rows), min(target.cols, target.rows)):
        return ""  # a board of fewer columns or rows is found in it as well
    cols, rows = found if target.cols >= target.rows else found[::-1]
    return (
        f"a checkerboard with {cols} x {rows} inner corners is in view, the target file states "
        f"{target.cols} x {target.rows}: count inner corners, one less than squares"
    )
