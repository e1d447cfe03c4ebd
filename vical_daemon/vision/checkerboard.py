"""Full search for a checkerboard: OpenCV's two finders, with their answer put in order.

First the quick one, which links black squares, then, seldom, the slow sector-based one, which also sees
blurred boards. Both need the whole board in view and are sometimes wrong by tens of pixels on partly hidden
boards, so their corners are only a start; `guided` refines and checks each. Their order may be turned:
colours settle that where the board allows it, otherwise the order nearest to the last frame, or the one
whose rows run downwards.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from vical_daemon.vision.detection import FloatArray, Gray
from vical_daemon.vision.layout import BoardLayout
from vical_daemon.vision.saddle import SaddleImage
from vical_daemon.vision.target import Checkerboard

LEAST_WIDTH_PX = 320  # of a reduced picture: a board of ten squares across half of it has 16 px for each
QUICK = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
FULL_SIZE_EVERY = 3  # pictures without a board: the full size, which takes longest, is searched this rarely
SLOW_EVERY = 20
"""Of pictures without a board: how often the quick finder looks at full size, and how often the slow one
looks at all. On a picture without a board that costs up to 10 and 150 ms."""


def search_checkerboard(gray: Gray, target: Checkerboard, misses: int = 0) -> FloatArray | None:
    """Find the inner corners, shape (rows * cols, 2), px, in the finder's own order; None without a board.

    Reduced pictures come first: they show most boards at a fraction of the time, and the corners are refined
    afterwards in the full picture anyway.

    Args:
        gray: The picture.
        target: The board.
        misses: Pictures before this one in which no board was found. The first gets every attempt.
    """
    width = gray.shape[1]
    sizes = [r for r in (4, 2) if width / r >= LEAST_WIDTH_PX]
    slow = [(_find_slowly, r) for r in (*sizes, 1)] if misses % SLOW_EVERY == 0 else []
    if misses % FULL_SIZE_EVERY == 0 or not sizes:
        sizes.append(1)
    for find, reduction in [(_find_quickly, r) for r in sizes] + slow:
        small = gray
        if reduction > 1:
            share = 1.0 / reduction
            small = np.asarray(
                cv2.resize(gray, None, fx=share, fy=share, interpolation=cv2.INTER_AREA), np.uint8
            )
        found, corners = find(small, (target.cols, target.rows))
        if found and len(corners) == target.cols * target.rows:
            uv = np.asarray(corners, np.float64).reshape(-1, 2)
            return (uv + 0.5) * reduction - 0.5
    return None


def _find_quickly(gray: Gray, size: tuple[int, int]) -> tuple[bool, Any]:
    return cv2.findChessboardCorners(gray, size, flags=QUICK)


def _find_slowly(gray: Gray, size: tuple[int, int]) -> tuple[bool, Any]:
    return cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)


def orders(target: Checkerboard) -> list[np.ndarray]:
    """Index arrays that turn the board's corners by the quarter turns that keep its outline."""
    grid = np.arange(target.cols * target.rows).reshape(target.rows, target.cols)
    turned = [grid, grid[::-1, ::-1]]
    if target.cols == target.rows:
        turned += [np.rot90(grid), np.rot90(grid, -1)]
    return [t.ravel() for t in turned]


def put_in_order(
    image: SaddleImage, layout: BoardLayout, uv_px: FloatArray, last_px: FloatArray | None
) -> FloatArray:
    """Return the corners in the order of the point ids.

    Args:
        image: The picture, for the colours.
        layout: The checkerboard.
        uv_px: All corners in the finder's order, shape (n, 2).
        last_px: Where the corners were (or are expected), nan where unknown; None: no memory.
    """
    assert isinstance(layout.target, Checkerboard)
    candidates = [_unmirrored(uv_px[order], layout.target) for order in orders(layout.target)]
    colours = [_colour_match(image, layout.target, uv) for uv in candidates]
    best = max(colours)
    candidates = [uv for uv, c in zip(candidates, colours, strict=True) if c >= best - 0.5 * abs(best)]
    if last_px is not None and np.isfinite(last_px).any():
        return min(candidates, key=lambda uv: float(np.nanmedian(np.linalg.norm(uv - last_px, axis=1))))
    return max(candidates, key=lambda uv: float(uv[-1] @ [1, 2] - uv[0] @ [1, 2]))


def _unmirrored(uv: FloatArray, target: Checkerboard) -> FloatArray:
    """Flip the columns if the finder walked the board as its mirror image."""
    grid = uv.reshape(target.rows, target.cols, 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    mirrored = along[0] * down[1] - along[1] * down[0] < 0
    return grid[:, ::-1].reshape(-1, 2) if mirrored else uv


def _colour_match(image: SaddleImage, target: Checkerboard, uv: FloatArray) -> float:
    """Mean grey of the squares that should be white minus those that should be black."""
    grid = uv.reshape(target.rows, target.cols, 2)
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    level = image.levels(centres)
    row, col = np.indices(level.shape)
    black = (row + col) % 2 == 0
    return float(level[~black].mean() - level[black].mean())
