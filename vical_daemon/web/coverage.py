"""Where in the image corners have been and how well they fit, and where the board is wanted next. No I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import RADTAN, project
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.camera_rays import undistort

ACROSS = 16
"""Cells over the width of the image."""
ENOUGH = 5
"""Corners in a cell that count as seen: as many as the estimator asks for at the edges (`ImageCoverage`)."""
_NEW = 0.1  # weight of a new image in the misfit of a cell: predictions of the first seconds are forgotten
_MOST_ROWS = 4 * ACROSS  # a message may state any size
_TILT_RAD = np.deg2rad(30.0)
"""Tilt that is asked for: at 30 degrees the near edge of a board is clearly larger than the far one."""
_SHARES = (0.55, 0.35)  # of the image's width that the board is to fill: near, and far
_WORTH = 0.08  # share of the cells that a place must add to be worth asking for
_TILTS = {
    "head-on": (0.0, 0.0),
    "its left edge nearer": (0.0, -1.0),
    "its right edge nearer": (0.0, 1.0),
    "its upper edge nearer": (1.0, 0.0),
    "its lower edge nearer": (-1.0, 0.0),
}
_EDGE_POINTS = 6  # on each edge of an outline, which the lens bends


class Coverage:
    """Counts corners, and how far the filter's predictions were off, cell by cell.

    Args:
        size: width, height of the image, px.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.down = min(max(1, round(ACROSS * size[1] / size[0])), _MOST_ROWS)
        self.count = np.zeros((self.down, ACROSS), dtype=np.int64)
        self._images = np.zeros((self.down, ACROSS), dtype=np.int64)
        self._square = np.zeros((self.down, ACROSS))

    def cells(self, uv_px: FloatArray) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return row and column of the cell of each pixel."""
        scale = np.array([ACROSS, self.down]) / np.array(self.size)
        at = np.clip(uv_px * scale, 0, (ACROSS - 1, self.down - 1)).astype(np.int64)
        return at[:, 1], at[:, 0]

    def add(self, uv_px: FloatArray) -> None:
        """Take the corners of one image, shape (n, 2)."""
        np.add.at(self.count, self.cells(uv_px[np.isfinite(uv_px).all(axis=1)]), 1)

    def add_misfit(self, uv_px: FloatArray, error_px: FloatArray) -> None:
        """Take how far predictions were from corners, shape (n, 2) both."""
        good = np.isfinite(uv_px).all(axis=1) & np.isfinite(error_px).all(axis=1)
        uv_px, error_px = uv_px[good], error_px[good]
        where, shape = self.cells(uv_px), self.count.shape
        found, square = np.zeros(shape), np.zeros(shape)
        np.add.at(found, where, 1.0)
        np.add.at(square, where, 0.5 * np.sum(error_px**2, axis=1))
        new = found > 0
        self._images[new] += 1
        weight = np.maximum(1.0 / np.maximum(self._images, 1), _NEW)
        change = weight * (square / np.maximum(found, 1.0) - self._square)
        self._square[new] += change[new]

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """Cells that have been seen, shape (rows, columns)."""
        return np.asarray(self.count >= ENOUGH)

    def document(self) -> dict[str, Any]:
        """Return counts (0 to `ENOUGH`) and RMS misfit (px, None: not known), row by row."""
        rms = np.where(self._images * _NEW >= 1.0, np.sqrt(self._square), np.nan)  # fewer say little
        return {
            "columns": ACROSS,
            "rows": self.down,
            "count": np.minimum(self.count, ENOUGH).ravel().tolist(),
            "rms_px": [None if np.isnan(v) else round(float(v), 2) for v in rms.ravel()],
            "share": round(float(self.seen.mean()), 3),
        }


@dataclass(frozen=True, slots=True)
class Wanted:
    """A place to bring the board to.

    Attributes:
        outline_px: Its outline in the image, shape (n, 2).
        distance_m: Of the middle of the board from the camera.
        tilt: How to hold it, in words.
        gain: What it adds, see `gain`.
    """

    outline_px: FloatArray
    distance_m: float
    tilt: str
    gain: float

    @property
    def text(self) -> str:
        """What to do, in words."""
        held = self.tilt if self.tilt == "head-on" else f"tilted, {self.tilt}"
        return f"bring the board into the outline: {held}, {self.distance_m:.2f} m away"


def wanted(
    coverage: Coverage,
    tilts_seen: set[str],
    board_m: tuple[float, float],
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str = RADTAN,
) -> Wanted | None:
    """Return the pose of the board that adds most to what has been seen; None: nothing much is missing.

    Candidates lie in a raster over the image, at two distances and five tilts. Each is worth the share of
    unseen cells within its outline; a tilt that has not been seen yet adds as much as a small new area. The
    whole board must lie in the image: some detectors need that.

    Args:
        coverage: What has been seen.
        tilts_seen: Names of tilts that have been seen, see `tilt_name`.
        board_m: Width and height of the board, m.
        intrinsics: fx fy cx cy, px, shape (4,).
        distortion: Coefficients of the model, shape (d,).
        model: radtan, plumb_bob or equidistant.
    """
    best, most = None, _WORTH
    width, height = coverage.size
    for share in _SHARES:
        distance = float(intrinsics[0]) * board_m[0] / (share * width)
        for x, y in ((i, j) for j in (0.5, 0.27, 0.73) for i in (0.5, 0.25, 0.75)):
            ray, ok = undistort(np.array([[x * width, y * height]]), intrinsics, distortion, model)
            if not ok[0]:
                continue
            middle = distance * np.array([*ray[0], 1.0])
            for name in _TILTS:
                outline = _outline(middle, name, board_m, intrinsics, distortion, model)
                inside = (
                    np.isfinite(outline).all() and (outline > 0).all() and (outline < (width, height)).all()
                )
                if not inside:
                    continue
                worth = gain(coverage, tilts_seen, outline, name)
                if worth > most:
                    best, most = Wanted(outline, distance, name, worth), worth
    return best


def gain(coverage: Coverage, tilts_seen: set[str], outline_px: FloatArray, tilt: str) -> float:
    """Return what a place adds now: the share of unseen cells in it, and something for a new tilt."""
    return _new_share(coverage, outline_px) + (0.0 if tilt in tilts_seen else 1.5 * _WORTH)


def tilt_name(normal_cam: FloatArray) -> str:
    """Return the name of the tilt of a board with this normal (towards the camera, camera frame)."""
    best, least = "", np.inf
    for name, (x, y) in _TILTS.items():
        R = so3.exp(_TILT_RAD * np.array([x, y, 0.0]))
        apart = float(np.arccos(np.clip(-(R[:, 2] @ normal_cam), -1.0, 1.0)))
        if apart < least:
            best, least = name, apart
    return best


def _outline(
    middle: FloatArray,
    tilt: str,
    board_m: tuple[float, float],
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str,
) -> FloatArray:
    w, h = 0.5 * board_m[0], 0.5 * board_m[1]
    corners = np.array([[-w, -h, 0.0], [w, -h, 0.0], [w, h, 0.0], [-w, h, 0.0]])
    steps = np.arange(_EDGE_POINTS)[:, None] / _EDGE_POINTS
    edges = [a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    x, y = _TILTS[tilt]
    points = np.concatenate(edges) @ so3.exp(_TILT_RAD * np.array([x, y, 0.0])).T + middle
    return project(points, intrinsics, distortion, model)


def _new_share(coverage: Coverage, outline: FloatArray) -> float:
    """Share of all cells that lie within an outline (convex, clockwise) and have not been seen."""
    width, height = coverage.size
    x = (np.arange(ACROSS) + 0.5) * width / ACROSS
    y = (np.arange(coverage.down) + 0.5) * height / coverage.down
    centres = np.stack(np.meshgrid(x, y), axis=-1)
    along = np.roll(outline, -1, axis=0) - outline
    away = centres[..., None, :] - outline
    inside = (along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0] > 0).all(axis=-1)
    return float((inside & ~coverage.seen).mean())
