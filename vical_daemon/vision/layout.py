"""What a detector must know about a board's corners: polarity, free space around each, tags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray, IntArray
from vical_daemon.vision.grid_model import neighbour_table
from vical_daemon.vision.target import AprilGrid, Checkerboard, Target

TAG_BORDER_SHARE = 0.2
"""Width of a tag's black border divided by its size: 2 of 10 modules (Kalibr)."""
SQUARE_SHARE = 0.45


@dataclass(frozen=True)
class BoardLayout:
    """The corners of a board as a picture shows them.

    Attributes:
        target: The board.
        xy_m: Corner positions on the board, shape (n, 2), m; the row index is the point id.
        polarity: -1 where the sectors towards (+x, +y) and (-x, -y) are black, +1 where the other two are.
        reach_m: Distance along the axes within which a corner's four sectors are undisturbed, m.
        neighbours: Nearest other corners of each, see `grid_model.neighbour_table`.
        rim: Where the next corners beyond a checkerboard's edge would be, did it go on; None: AprilGrid.
    """

    target: Target
    xy_m: FloatArray
    polarity: npt.NDArray[np.int64]
    reach_m: float
    neighbours: IntArray
    rim: BoardLayout | None = None

    @classmethod
    def of(cls, target: Target) -> BoardLayout:
        """Derive the layout of a target."""
        xy = np.ascontiguousarray(target.points_m[:, :2])
        index = np.arange(len(xy))
        near = neighbour_table(xy)
        if isinstance(target, AprilGrid):
            reach = min(TAG_BORDER_SHARE * target.tag_size_m, target.gap_m)
            return cls(target, xy, np.where(index % 2 == 0, -1, 1), reach, near)
        row, col = np.divmod(index, target.cols)
        reach = SQUARE_SHARE * min(target.row_spacing_m, target.col_spacing_m)
        rim = _rim(target, reach)
        return cls(target, xy, np.where((row + col) % 2 == 0, -1, 1), reach, near, rim)

    def radius_px(self, axes_px: FloatArray) -> FloatArray:
        """Radius of a window that stays within `reach_m`, px, from the local axes (n, 2, 2) in px per m."""
        return np.asarray(np.linalg.norm(axes_px, axis=2).min(axis=1) * self.reach_m - 0.5)


def _rim(target: Checkerboard, reach_m: float) -> BoardLayout:
    row, col = (part.ravel() for part in np.mgrid[-1 : target.rows + 1, -1 : target.cols + 1])
    beyond = (row < 0) | (row == target.rows) | (col < 0) | (col == target.cols)
    row, col = row[beyond], col[beyond]
    xy = np.stack([col * target.col_spacing_m, row * target.row_spacing_m], axis=1)
    return BoardLayout(target, xy, np.where((row + col) % 2 == 0, -1, 1), reach_m, neighbour_table(xy))
