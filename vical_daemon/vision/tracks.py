"""Feature tracks for calibration without a target: corners of the scene followed from frame to frame.

Pyramidal Lucas-Kanade from the last frame, started where the gyro (or the last flow) says; a way back that
must end where it began; a last alignment with how the feature looked when first seen, so that errors do not
add up along a track; an epipolar check against a frame some time ago. New features fill empty grid cells.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import AnyImage, Detection, FloatArray, Gray, IntArray, as_gray, median
from vical_daemon.vision.flow_prediction import FlowPredictor
from vical_daemon.vision.patches import Float32, Templates, no_templates
from vical_daemon.vision.saddle import SMOOTHING_PX

BoolArray = npt.NDArray[np.bool_]

_KERNEL = cv2.getGaussianKernel(5, SMOOTHING_PX, cv2.CV_32F)


@dataclass(frozen=True)
class TrackOptions:
    """Settings of the tracker.

    Attributes:
        max_features: Upper bound on features alive.
        cells: Columns and rows of the grid that spreads them.
        window_px: Edge of the Lucas-Kanade window, in the picture at half the size.
        back_window_px: The same on the way back: with another window, a point on an edge slides elsewhere.
        levels: Pyramid levels above the picture at half the size.
        back_px: Largest distance of the way back from where it began.
        align_px: Largest move of the alignment with a feature's first look; beyond, it is given up.
        unlike: Largest unlikeness (0 equal, 1 unrelated); likewise.
        epipolar_px: Largest distance from the epipolar line.
        fast_threshold: Contrast of a new corner, grey levels.
        border_px: Features nearer to the edge are given up.
        sigma_floor_px: Error that noise and contrast do not explain: perspective, corners in depth.
    """

    max_features: int = 80
    cells: tuple[int, int] = (10, 8)
    window_px: int = 11
    back_window_px: int = 5
    levels: int = 3
    back_px: float = 0.7
    align_px: float = 1.0
    unlike: float = 0.45
    epipolar_px: float = 1.5
    fast_threshold: int = 18
    border_px: int = 8
    sigma_floor_px: float = 0.05


_PARTS = (16, 12)  # columns and rows of a picture's parts; their median tells light from what moves


@dataclass(frozen=True)
class _Picture:
    """A picture at half the size (pixel u is at u / 2), grey levels (plus 1) of its parts, its stamp, ns."""

    half: Gray
    levels: FloatArray
    t_ns: int | None

    @classmethod
    def of(cls, gray: Gray, t_ns: int | None) -> _Picture:
        """Of a picture at full size."""
        half = np.asarray(cv2.pyrDown(gray), np.uint8)
        levels = cv2.resize(half, _PARTS, interpolation=cv2.INTER_AREA)
        return cls(half, levels.ravel() + 1.0, t_ns)


@dataclass
class _Features:
    """The features alive, as columns."""

    ids: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    uv: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    sigma: FloatArray = field(default_factory=lambda: np.zeros(0))
    old_uv: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    warp: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 2)))
    templates: Templates = field(default_factory=no_templates)

    def keep(self, mask: BoolArray) -> None:
        """Drop the others."""
        self.ids, self.uv, self.sigma = self.ids[mask], self.uv[mask], self.sigma[mask]
        self.old_uv, self.warp = self.old_uv[mask], self.warp[mask]
        self.templates = self.templates.take(mask)

    def add(self, ids: IntArray, uv: FloatArray, templates: Templates, sigma_px: float) -> None:
        """Append new features."""
        count = len(ids)
        self.ids, self.uv = np.append(self.ids, ids), np.vstack([self.uv, uv])
        self.sigma = np.append(self.sigma, np.full(count, sigma_px))
        self.old_uv = np.vstack([self.old_uv, np.full(uv.shape, np.nan)])
        self.warp = np.concatenate([self.warp, np.broadcast_to(np.eye(2), (count, 2, 2))])
        self.templates = self.templates.joined(templates)


_VERTEX_PX = 3  # half the window in which edges are looked for; a corner of FAST lies a pixel or two beside
EPIPOLAR_EVERY = 5
"""Frames between the pictures that the epipolar check compares: enough parallax, little change."""
MIN_EPIPOLAR = 15  # features: five decide an essential matrix, the others show outliers


class FeatureTracker:
    """Follows natural features through the pictures of one camera.

    Args:
        options: Settings.
        predictor: Foretells flow from gyro rates; None: from the flow of the last frames only.
    """

    def __init__(self, options: TrackOptions | None = None, predictor: FlowPredictor | None = None) -> None:
        self.options = options or TrackOptions()
        self.predictor = predictor or FlowPredictor()
        self._features = _Features()
        self._last: _Picture | None = None
        self._frame = 0
        self._next_id = 0
        self._fast = cv2.FastFeatureDetector.create(self.options.fast_threshold, True)

    def detect(self, image: AnyImage, t_ns: int | None = None) -> Detection | None:
        """Track into a new picture and return every feature alive, or None where there is none.

        Args:
            image: Shape (height, width) uint8/uint16 or (height, width, 3) uint8 (BGR).
            t_ns: Stamp, ns, in the clock of the gyro samples given to the predictor.

        Returns:
            Ids (never used twice), pixels, and the stated sigma.

        Raises:
            ValueError: The picture has a shape or type that no camera of ours gives.
        """
        gray = as_gray(image)
        smooth: Float32 = np.asarray(cv2.sepFilter2D(gray, cv2.CV_32F, _KERNEL, _KERNEL), np.float32)
        now = _Picture.of(gray, t_ns)
        if self._last is not None and self._last.half.shape != now.half.shape:
            self._features, self._last = _Features(), None
        self._frame += 1
        if self._last is not None and len(self._features.ids):
            self._follow(self._last, now, gray.shape)
            self._align(smooth)
            self._check_epipolar()
        self._refill(gray, smooth)
        self._last = now
        if not len(self._features.ids):
            return None
        features = self._features
        sigma = np.hypot(features.sigma, self.options.sigma_floor_px)
        return Detection(features.ids.copy(), features.uv.copy(), sigma)

    def _follow(self, before: _Picture, now: _Picture, shape: tuple[int, int]) -> None:
        """Follow the features there and back; at half the size, as the alignment corrects a pixel or less."""
        features, options = self._features, self.options
        height, width = shape
        before, now = _equally_bright(before, now)
        guess = self.predictor.predict(features.uv, before.t_ns, now.t_ns)
        uv, good = self._flow(before, now, features.uv, guess, options.levels, options.window_px)
        border = options.border_px
        good &= ((uv > border) & (uv < np.array([width, height]) - 1 - border)).all(axis=1)
        good &= self._comes_back(before, now, features.uv, uv)
        self.predictor.learn(features.uv[good], uv[good], before.t_ns, now.t_ns)
        features.uv = uv
        features.keep(good)

    def _comes_back(
        self, before: _Picture, now: _Picture, uv_before: FloatArray, uv_now: FloatArray
    ) -> BoolArray:
        """Whether the way back ends where the feature came from."""
        back, good = self._flow(now, before, uv_now, uv_before, 0, self.options.back_window_px)
        near = np.linalg.norm(back - uv_before, axis=1) < self.options.back_px
        return np.asarray(good & near)

    def _flow(
        self,
        source: _Picture,
        goal: _Picture,
        points: FloatArray,
        guess: FloatArray,
        levels: int,
        window_px: int,
    ) -> tuple[FloatArray, BoolArray]:
        """Where points of one picture are in another, px, and which were found."""
        if not len(points):
            return points.copy(), np.zeros(0, bool)
        window = (window_px, window_px)
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            source.half,
            goal.half,
            np.ascontiguousarray(0.5 * points[:, None, :], np.float32),
            np.ascontiguousarray(0.5 * guess[:, None, :], np.float32),
            winSize=window,
            maxLevel=levels,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.02),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=1e-3,
        )
        uv = 2.0 * found.reshape(-1, 2).astype(np.float64)
        good = (status.ravel() > 0) & np.isfinite(uv).all(axis=1)
        return np.where(good[:, None], uv, points), np.asarray(good)

    def _align(self, smooth: Float32) -> None:
        """Pull each feature to where its first look matches; give up those that no longer look alike."""
        features = self._features
        features.warp = self.predictor.linear_flow() @ features.warp
        uv, warp, unlike, sigma = features.templates.align(smooth, features.uv, features.warp)
        near = np.linalg.norm(uv - features.uv, axis=1) < self.options.align_px
        features.uv, features.warp, features.sigma = uv, warp, sigma
        features.keep(near & (unlike < self.options.unlike))

    def _check_epipolar(self) -> None:
        """Compare with the picture of `EPIPOLAR_EVERY` frames ago; drop what moved against the rest."""
        features = self._features
        if self._frame % EPIPOLAR_EVERY:
            return
        known = np.isfinite(features.old_uv[:, 0])
        if known.sum() >= MIN_EPIPOLAR:
            a = self.predictor.undistort(features.old_uv[known])
            b = self.predictor.undistort(features.uv[known])
            cv2.setRNGSeed(self._frame)
            _, inlier = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, self.options.epipolar_px, 0.99, 200)
            if inlier is not None and inlier.sum() >= 0.5 * len(inlier):
                keep = np.ones(len(known), bool)
                keep[known] = inlier.ravel() > 0
                features.keep(keep)
        features.old_uv = features.uv.copy()

    def _refill(self, gray: Gray, smooth: Float32) -> None:
        """Begin features in empty cells, best corner of each."""
        options, features = self.options, self._features
        columns, rows = options.cells
        room = options.max_features - len(features.ids)
        height, width = gray.shape
        scale = np.array([columns / width, rows / height])
        taken = np.zeros((rows, columns), bool)
        cell = np.floor(features.uv * scale).astype(int)
        taken[np.clip(cell[:, 1], 0, rows - 1), np.clip(cell[:, 0], 0, columns - 1)] = True
        wanted = min(room, int(np.sum(~taken)))
        if wanted < 1 or (wanted < 0.2 * taken.size and self._frame % 3):
            return
        found = self._fast.detect(gray)
        if not found:
            return
        uv = np.asarray(cv2.KeyPoint.convert(found), np.float64)
        response = np.array([k.response for k in found])
        border = options.border_px
        inside = ((uv > border) & (uv < np.array([width, height]) - 1 - border)).all(axis=1)
        uv, response = uv[inside], response[inside]
        chosen = _best_of_empty_cells(uv, response, scale, taken)[:wanted]
        if len(chosen):
            begin = _vertices(gray, uv[chosen])
            same = (np.floor(begin * scale) == np.floor(uv[chosen] * scale)).all(axis=1)
            begin = begin[same]  # the vertex in another cell may be a feature already
            ids = np.arange(self._next_id, self._next_id + len(begin), dtype=np.int64)
            self._next_id += len(begin)
            features.add(ids, begin, Templates.cut(smooth, begin), options.sigma_floor_px)


def _equally_bright(one: _Picture, other: _Picture) -> tuple[_Picture, _Picture]:
    """Both as dark as the darker one: Lucas-Kanade takes light and exposure that change for motion."""
    gain = median(other.levels / one.levels)
    if gain > 1.0:
        return one, replace(other, half=np.asarray(cv2.convertScaleAbs(other.half, alpha=1.0 / gain)))
    return replace(one, half=np.asarray(cv2.convertScaleAbs(one.half, alpha=gain))), other


def _vertices(gray: Gray, uv: FloatArray) -> FloatArray:
    """Move corners, found to a pixel or two, to where their edges meet.

    A corner looks alike at every scale. A point beside it, held at one distance in the image, is no point of
    the scene when the camera comes nearer; the vertex is.
    """
    halves, stop = (_VERTEX_PX, _VERTEX_PX), (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
    start = np.ascontiguousarray(uv[:, None, :], np.float32)
    found = cv2.cornerSubPix(gray, start, halves, (-1, -1), stop).reshape(-1, 2).astype(np.float64)
    near = np.linalg.norm(found - uv, axis=1) < _VERTEX_PX
    return np.where(near[:, None], found, uv)


def _best_of_empty_cells(
    uv: FloatArray, response: FloatArray, scale: FloatArray, taken: BoolArray
) -> npt.NDArray[np.intp]:
    """Index of the strongest corner of each cell that is not taken, strongest first."""
    rows, columns = taken.shape
    cell = np.floor(uv * scale).astype(int)
    flat = np.clip(cell[:, 1], 0, rows - 1) * columns + np.clip(cell[:, 0], 0, columns - 1)
    order = np.argsort(-response, kind="stable")
    order = order[~taken.ravel()[flat[order]]]
    _, first = np.unique(flat[order], return_index=True)
    return np.asarray(order[np.sort(first)])
