"""Full search for an AprilGrid: black quadrilaterals, their codes, one consistent board.

Kalibr's boards join every tag to its neighbours by black squares at the corners, where most tag detectors
lose them. Eroding the black mask by a pixel or two cuts these joints; what the codes do not give (blurred,
cut off) is found afterwards from the board as a whole, see `guided`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray, Gray, IntArray
from vical_daemon.vision.saddle import SaddleImage
from vical_daemon.vision.tag_code import decode
from vical_daemon.vision.target import AprilGrid

MIN_EDGE_PX = 9.0  # of a tag: 0.9 px for each of its ten modules
MAX_CANDIDATES = 400  # the largest outlines: over ten times the tags of a usual board
FIRST_WIDTH_PX = 320
"""The first pass works on the picture halved until it is about this wide: most boards show there."""


@dataclass(frozen=True)
class Pass:
    """One way to make the black squares stand apart.

    Attributes:
        window_px: Of the local threshold, in the scaled picture.
        erosions: Of the black mask by a pixel, in the scaled picture.
        scale: Size of the scaled picture over that of the picture.
    """

    window_px: int
    erosions: int
    scale: float = 1.0


PASSES = (Pass(31, 1), Pass(31, 2), Pass(91, 2), Pass(31, 2, 2.0), Pass(15, 1))
"""Tried in turn until enough of the board is known, after passes over reduced pictures."""
ENOUGH_TAGS = 6  # 24 corners: enough for a model of the board that finds the others


def search_tags(
    image: SaddleImage, gray: Gray, target: AprilGrid, misses: int = 0
) -> tuple[IntArray, FloatArray]:
    """Find tags of `target`.

    Args:
        image: The picture, prepared.
        gray: The picture.
        target: The board.
        misses: Pictures before this one in which no board was found. The first gets every pass; each that
            follows gets the passes over reduced pictures and one of the others in turn.

    Returns:
        Tag ids counted from `target.first_tag`, shape (n,), each at most once, and the corners 0..3 of each,
        px, shape (n, 4, 2).
    """
    tags = target.tag_cols * target.tag_rows
    found: dict[int, FloatArray] = {}
    for attempt in _passes(gray.shape[1], misses):
        ids, ordered = decode(image.smooth, _find_quads(gray, attempt), tags, target.first_tag)
        known = np.flatnonzero(ids >= 0)
        known = known[np.bincount(ids[known], minlength=tags)[ids[known]] == 1]
        ids, quads = ids[known], ordered[known]
        edge = np.linalg.norm(quads - np.roll(quads, -1, axis=1), axis=2).min(axis=1, initial=np.inf)
        shift_px = 2.0 + 1.0 / attempt.scale
        corners = image.refine(quads.reshape(-1, 2), np.repeat(edge * 0.18, 4), shift_px)
        for tag, quad in zip(ids, corners.uv_px.reshape(-1, 4, 2), strict=True):
            found.setdefault(int(tag), quad)
        if len(found) >= min(ENOUGH_TAGS, tags):
            break
    order = sorted(found)
    return np.array(order, np.int64), np.array([found[i] for i in order]).reshape(-1, 4, 2)


def _passes(width_px: int, misses: int) -> list[Pass]:
    """The passes that a picture gets, reduced pictures first, the smallest before."""
    reduced: list[Pass] = []
    while width_px * 0.5 ** (len(reduced) + 1) >= FIRST_WIDTH_PX:
        reduced.insert(0, Pass(31, 1, 0.5 ** (len(reduced) + 1)))
    if misses:
        return [*reduced, PASSES[misses % len(PASSES)]]
    return [*reduced, *PASSES]


def _find_quads(gray: Gray, attempt: Pass) -> FloatArray:
    """Convex black quadrilaterals, counter-clockwise for the viewer, shape (n, 4, 2), px of `gray`."""
    scale, erosions = attempt.scale, attempt.erosions
    if scale != 1:
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        gray = np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=method), np.uint8)
    black = cv2.adaptiveThreshold(
        gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, attempt.window_px, 6
    )
    black = cv2.erode(black, np.ones((3, 3), np.uint8), iterations=erosions)
    contours, hierarchy = cv2.findContours(black, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    least = MIN_EDGE_PX * max(scale, 1.0) - 2 * erosions
    if hierarchy is None:
        return np.zeros((0, 4, 2))
    outer = np.flatnonzero(hierarchy[0][:, 3] < 0)
    found = [quad for k in outer if (quad := _as_quad(contours[k], least)) is not None]
    if not found:
        return np.zeros((0, 4, 2))
    quads = np.array(found, np.float64).reshape(-1, 4, 2)
    edge = np.roll(quads, -1, axis=1) - quads
    turning = edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]
    quads = np.where((turning < 0)[:, None, None], quads, quads[:, ::-1])
    length2 = np.sum(edge * edge, axis=2)
    large = length2.min(axis=1) >= (0.6 * least) ** 2
    if np.count_nonzero(large) > MAX_CANDIDATES:
        size = np.sort(length2.sum(axis=1)[large])[-MAX_CANDIDATES]
        large &= length2.sum(axis=1) >= size
    return (_grow(quads[large], erosions + 0.5) + 0.5) / scale - 0.5


def _as_quad(contour: npt.NDArray[np.int32], least_edge_px: float) -> npt.NDArray[np.int32] | None:
    """The four corners of a contour that looks like a square in perspective, shape (4, 1, 2)."""
    if len(contour) < 4:
        return None
    _, _, width, height = cv2.boundingRect(contour)
    if min(width, height) < least_edge_px or max(width, height) > 20 * min(width, height):
        return None
    hull = cv2.convexHull(contour)
    area = cv2.contourArea(hull)
    if cv2.contourArea(contour) < 0.7 * area:
        return None
    quad = cv2.approxPolyDP(hull, 0.06 * cv2.arcLength(hull, True), True)
    if len(quad) != 4 or abs(cv2.contourArea(quad) - area) > 0.2 * area:
        return None
    return np.asarray(quad, np.int32)


def _grow(quads: FloatArray, distance_px: float) -> FloatArray:
    """Move every edge outwards by `distance_px` and intersect the edges again."""
    edge = np.roll(quads, -1, axis=1) - quads
    edge /= np.maximum(np.linalg.norm(edge, axis=2, keepdims=True), 1e-9)
    # Counter-clockwise for a viewer whose v axis points down: the outside is on the right of the walk.
    normal = np.stack([-edge[..., 1], edge[..., 0]], axis=-1)
    offset = np.sum(normal * quads, axis=2) + distance_px
    before_n, before_o = np.roll(normal, 1, axis=1), np.roll(offset, 1, axis=1)
    det = before_n[..., 0] * normal[..., 1] - before_n[..., 1] * normal[..., 0]
    det = np.where(np.abs(det) < 1e-6, np.nan, det)
    u = (before_o * normal[..., 1] - offset * before_n[..., 1]) / det
    v = (before_n[..., 0] * offset - normal[..., 0] * before_o) / det
    grown = np.stack([u, v], axis=-1)
    return np.where(np.isfinite(grown), grown, quads)
