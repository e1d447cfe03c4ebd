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
SQUARE_SHARE = 0.45  # of a square's side that the window around its corner may reach


@dataclass(frozen=True)
class Steps:
    """Two corners near each corner, one step apart along an axis: their pixels give the local axes.

    Attributes:
        before: Index of the one with the smaller coordinate, along x and along y, shape (2, n).
        after: Index of the other.
        length_m: Distance of the two on the board, shape (2, n).
    """

    before: IntArray
    after: IntArray
    length_m: FloatArray

    @classmethod
    def of_tags(cls, count: int, tag_size_m: float) -> Steps:
        """The edges of a corner's own tag; `count` corners."""
        tag = np.arange(count) // 4 * 4
        corner = np.arange(count) % 4
        # Corners 0..3 lie at (0, 0), (1, 0), (1, 1), (0, 1): below are 0 and 1, on the left 0 and 3.
        before = tag + np.stack([np.array([0, 0, 3, 3])[corner], np.array([0, 1, 1, 0])[corner]])
        after = tag + np.stack([np.array([1, 1, 2, 2])[corner], np.array([3, 2, 2, 3])[corner]])
        return cls(before, after, np.full((2, count), tag_size_m))

    @classmethod
    def of_grid(cls, cols: int, rows: int, spacing_m: tuple[float, float]) -> Steps:
        """The neighbours on both sides in a full grid, the corner itself at its edge."""
        row, col = np.divmod(np.arange(cols * rows), cols)
        left, right = np.maximum(col - 1, 0), np.minimum(col + 1, cols - 1)
        down, up = np.maximum(row - 1, 0), np.minimum(row + 1, rows - 1)
        before = np.stack([row * cols + left, down * cols + col])
        after = np.stack([row * cols + right, up * cols + col])
        return cls(before, after, np.stack([(right - left) * spacing_m[0], (up - down) * spacing_m[1]]))

    def take(self, index: IntArray) -> Steps:
        """Those of some corners."""
        return Steps(self.before[:, index], self.after[:, index], self.length_m[:, index])

    def axes_px(self, uv_px: FloatArray) -> FloatArray:
        """Pixels per metre along the board's x and y at each corner, shape (n, 2, 2): [:, 0] is d(uv)/dx.

        Args:
            uv_px: Rough pixels of all corners, shape (all, 2); nan where unknown.
        """
        axes = (uv_px[self.after] - uv_px[self.before]) / self.length_m[..., None]
        return np.asarray(axes.swapaxes(0, 1))


@dataclass(frozen=True)
class BoardLayout:
    """The corners of a board as a picture shows them.

    Attributes:
        target: The board.
        xy_m: Corner positions on the board, shape (n, 2), m; the row index is the point id.
        polarity: -1 where the sectors towards (+x, +y) and (-x, -y) are black, +1 where the other two are.
        reach_m: Distance along the axes within which a corner's four sectors are undisturbed, m.
        neighbours: Nearest other corners of each, see `grid_model.neighbour_table`.
        steps: Pairs of corners one step apart along x and y.
        rim: A checkerboard with one more row and column on each side, did it go on; None: AprilGrid.
        rim_index: Of the corners that this layout has more than the board; None: none.
    """

    target: Target
    xy_m: FloatArray
    polarity: npt.NDArray[np.int64]
    reach_m: float
    neighbours: IntArray
    steps: Steps
    rim: BoardLayout | None = None
    rim_index: IntArray | None = None

    @classmethod
    def of(cls, target: Target) -> BoardLayout:
        """Derive the layout of a target."""
        xy = np.ascontiguousarray(target.points_m[:, :2])
        if isinstance(target, AprilGrid):
            reach = min(TAG_BORDER_SHARE * target.tag_size_m, target.gap_m)
            polarity = np.where(np.arange(len(xy)) % 2 == 0, -1, 1)
            steps = Steps.of_tags(len(xy), target.tag_size_m)
            return cls(target, xy, polarity, reach, neighbour_table(xy), steps)
        return _grid(target, 0)

    def radius_px(self, axes_px: FloatArray) -> FloatArray:
        """Radius of a window that stays within `reach_m`, px, from the local axes (n, 2, 2) in px per m."""
        squares = axes_px[..., 0] ** 2 + axes_px[..., 1] ** 2
        return np.asarray(np.sqrt(np.minimum(squares[:, 0], squares[:, 1])) * self.reach_m - 0.5)


def _grid(target: Checkerboard, beyond: int) -> BoardLayout:
    """A checkerboard, continued by some squares beyond each of its edges."""
    row, col = (
        part.ravel() for part in np.mgrid[-beyond : target.rows + beyond, -beyond : target.cols + beyond]
    )
    xy = np.stack([col * target.col_spacing_m, row * target.row_spacing_m], axis=1)
    steps = Steps.of_grid(
        target.cols + 2 * beyond, target.rows + 2 * beyond, (target.col_spacing_m, target.row_spacing_m)
    )
    reach = SQUARE_SHARE * min(target.row_spacing_m, target.col_spacing_m)
    polarity = np.where((row + col) % 2 == 0, -1, 1)
    if beyond:
        outside = (row < 0) | (row == target.rows) | (col < 0) | (col == target.cols)
        return BoardLayout(
            target, xy, polarity, reach, neighbour_table(xy), steps, rim_index=np.flatnonzero(outside)
        )
    return BoardLayout(target, xy, polarity, reach, neighbour_table(xy), steps, rim=_grid(target, 1))
