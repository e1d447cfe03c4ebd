"""The detector a role uses: full search once, guided from then on, full search again on loss."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vical_daemon.vision.aprilgrid import search_tags
from vical_daemon.vision.checkerboard import put_in_order, search_checkerboard
from vical_daemon.vision.detection import AnyImage, Detection, FloatArray, Gray, as_gray
from vical_daemon.vision.grid_model import GridModel
from vical_daemon.vision.guided import (
    BoardFix,
    check_identity,
    complete_board,
    refine_missing,
    refine_predicted,
)
from vical_daemon.vision.layout import BoardLayout
from vical_daemon.vision.saddle import SaddleImage
from vical_daemon.vision.target import AprilGrid, Target
from vical_daemon.vision.target_check import TargetCheck

MIN_POINTS = 4  # as many as a pose needs
FLOW_POINTS = 24  # corners followed: a homography needs four, and half may be lost
FLOW_WIDTH_PX = 320
"""Optical flow works on pictures reduced to at least this width: the refinement needs only a pixel or two."""
FLOW_WINDOW = (11, 11)  # px of the reduced picture
FLOW_LEVELS = 2  # halvings: moves of 4 times half a window
FLOW_TOLERANCE_PX = 3.0
"""From the common homography; beyond, the optical flow of a corner is wrong."""
KEEP_SHARE = 0.5
"""Guided detection holds while it finds this share of the corners that should be in view."""
MAX_GAP_NS = 400_000_000  # between pictures, for the flow; a hand turns by 24 deg in it at 60 deg/s


@dataclass
class DetectorStats:
    """What the detector did so far.

    Attributes:
        guided: Pictures in which the board was found without a full search.
        searches: Full searches.
    """

    guided: int = 0
    searches: int = 0


@dataclass(frozen=True)
class _LastFrame:
    """The last frame with a board."""

    fix: BoardFix
    reduced: Gray
    t_ns: int | None
    velocity_px: FloatArray
    """Motion of each corner per second (per frame without stamps); 0 where unknown, shape (n, 2)."""


class BoardDetector:
    """Detects one target in a stream of pictures of one camera.

    Args:
        target: The board.
        guided: Use the last frames; False: full search on every picture.
        check: Compares images with the target file; None: no check.
    """

    def __init__(self, target: Target, guided: bool = True, check: TargetCheck | None = None) -> None:
        self.target = target
        self._check = check
        self.stats = DetectorStats()
        self._layout = BoardLayout.of(target)
        self._guided = guided
        self._last: _LastFrame | None = None
        self._lens = -0.1
        self._misses = 0

    def detect(self, image: AnyImage, t_ns: int | None = None) -> Detection | None:
        """Find the board.

        Args:
            image: Shape (height, width) uint8/uint16 or (height, width, 3) uint8 (BGR).
            t_ns: Stamp, ns; lets the guided search scale velocities over dropped frames.

        Returns:
            The points found (at least four), or None.

        Raises:
            ValueError: The picture has a shape or type that no camera of ours gives.
        """
        gray = as_gray(image)
        reduced = _reduced(gray) if self._guided else gray
        fix = self._follow(gray, reduced, t_ns) if self._guided else None
        if fix is not None:
            self.stats.guided += 1
        else:
            fix = self._search(gray)
        found = fix is not None and fix.found.sum() >= MIN_POINTS
        if self._check is not None:
            self._check.take(gray)
        if fix is None or not found:
            self._last = None
            self._misses += 1
            return None
        self._misses = 0
        self._remember(fix, reduced, t_ns)
        ids = np.flatnonzero(fix.found).astype(np.int64)
        return Detection(ids, fix.uv_px[ids], fix.sigma_px[ids])

    def _search(self, gray: Gray) -> BoardFix | None:
        self.stats.searches += 1
        picture = SaddleImage(gray)
        uv = np.full((len(self._layout.xy_m), 2), np.nan)
        if isinstance(self.target, AprilGrid):
            tags, corners = search_tags(picture, gray, self.target, self._misses)
            for tag, quad in zip(tags, corners, strict=True):
                uv[4 * tag : 4 * tag + 4] = quad
        else:
            found = search_checkerboard(gray, self.target, self._misses)
            if found is None:
                return None
            last = None
            if self._last is not None:
                last = np.where(self._last.fix.found[:, None], self._last.fix.uv_px, np.nan)
            uv = put_in_order(picture, self._layout, found, last)
        return complete_board(picture, self._layout, uv, np.isfinite(uv).all(axis=1), self._lens)

    def _follow(self, gray: Gray, reduced: Gray, t_ns: int | None) -> BoardFix | None:
        """Guided detection; None when there is nothing to follow or the board is lost."""
        start = self._flow(reduced, t_ns)
        if start is None or start[0].shape != gray.shape:
            return None
        model, predicted, around = start
        picture = SaddleImage(gray, around)
        fix = refine_predicted(picture, self._layout, model, predicted, search_px=5.0)
        if fix is not None:
            fix = check_identity(picture, self._layout, refine_missing(picture, self._layout, fix))
        if fix is None or not self._holds(fix, picture.shape):
            return None
        return fix

    def _flow(self, reduced: Gray, t_ns: int | None) -> tuple[GridModel, FloatArray, FloatArray] | None:
        """Start from the last frame, moved by the optical flow of a few well spread corners.

        Returns:
            The last model; a place for each corner, shape (n, 2), nan where there is none; and the finite
            places that the checks look at, shape (m, 2). None where there is nothing to follow.
        """
        last = self._last
        if last is None or last.reduced.shape != reduced.shape:
            return None
        step = _elapsed(last.t_ns, t_ns)
        if step is None:
            return None
        found = np.flatnonzero(last.fix.found)
        count = min(len(found), FLOW_POINTS)
        chosen = found[np.arange(count) * len(found) // count]
        scale = round(last.fix.model.shape[1] / reduced.shape[1])
        middle = 0.5 * (scale - 1)  # of the first pixel of the reduced picture
        before = last.fix.uv_px[chosen]
        guess = before + last.velocity_px[chosen] * step
        after, status, _ = cv2.calcOpticalFlowPyrLK(
            last.reduced,
            reduced,
            np.ascontiguousarray(((before - middle) / scale)[:, None], np.float32),
            np.ascontiguousarray(((guess - middle) / scale)[:, None], np.float32),
            winSize=FLOW_WINDOW,
            maxLevel=FLOW_LEVELS,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.05),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        good = status.ravel() > 0
        if good.sum() < 4:
            return None
        where = after[good, 0].astype(np.float64) * scale + middle
        H, _ = cv2.findHomography(before[good], where, cv2.USAC_FAST, FLOW_TOLERANCE_PX)
        if H is None:
            return None
        model, rim = last.fix.model, self._layout.rim
        predicted = _moved(last.fix.places_px, H)
        around = predicted if rim is None else _moved(model.predict(rim.xy_m), H)
        around = around[np.isfinite(around).all(axis=1)]
        return (model, predicted, around) if len(around) else None

    def _holds(self, fix: BoardFix, shape: tuple[int, int]) -> bool:
        """Whether guided detection still finds most of what should be in view."""
        u, v = fix.predicted_px.T
        margin = 12.0
        inside = (u > margin) & (u < shape[1] - 1 - margin) & (v > margin) & (v < shape[0] - 1 - margin)
        found = int(fix.found.sum())
        return found >= 8 and found >= KEEP_SHARE * int(inside.sum())

    def _remember(self, fix: BoardFix, reduced: Gray, t_ns: int | None) -> None:
        velocity = np.zeros(fix.uv_px.shape)
        if self._last is not None:
            step = _elapsed(self._last.t_ns, t_ns)
            if step is not None:
                both = fix.found & self._last.fix.found
                velocity[both] = (fix.uv_px - self._last.fix.uv_px)[both] / step
                if both.any():
                    velocity[~both] = velocity[both].mean(axis=0)
        if fix.found.sum() >= 24:
            self._lens += 0.2 * (float(fix.model.parameters[8]) - self._lens)
        self._last = _LastFrame(fix, reduced, t_ns, velocity)


def _moved(uv_px: FloatArray, H: FloatArray) -> FloatArray:
    """Pixels moved by a homography, shape (n, 2)."""
    return np.asarray(cv2.perspectiveTransform(uv_px[:, None], H)[:, 0])


def _reduced(gray: Gray) -> Gray:
    """The picture, halved until the next half would be narrower than `FLOW_WIDTH_PX`."""
    while gray.shape[1] >= 2 * FLOW_WIDTH_PX:
        height, width = (size // 2 for size in gray.shape)  # means of four: a quarter of cv2.pyrDown's time
        whole = gray[: 2 * height, : 2 * width]
        gray = np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    return gray


def _elapsed(before_ns: int | None, now_ns: int | None) -> float | None:
    """Seconds between stamps; 1.0 (one frame) without stamps; None when too long ago or not after."""
    if before_ns is None or now_ns is None:
        return 1.0
    gap = now_ns - before_ns
    return gap * 1e-9 if 0 < gap <= MAX_GAP_NS else None
