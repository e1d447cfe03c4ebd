"""Full search for an AprilGrid: black quadrilaterals, their codes, one consistent board.

Kalibr's boards join every tag to its neighbours by black squares at the corners, where most tag detectors
lose them. Eroding the black mask by a pixel or two cuts these joints; what the codes do not give (blurred,
cut off) is found afterwards from the board as a whole, see `guided`.
"""

from __future__ import annotations

import cv2
import numpy as np

from vical_daemon.vision.detection import FloatArray, Gray, IntArray
from vical_daemon.vision.saddle import SaddleImage
from vical_daemon.vision.tag_code import decode
from vical_daemon.vision.target import AprilGrid

MIN_EDGE_PX = 9.0
MAX_CANDIDATES = 400
PASSES: tuple[tuple[int, int, int], ...] = ((31, 1, 1), (31, 2, 1), (91, 2, 1), (31, 2, 2), (15, 1, 1))
"""(threshold window px, erosions, enlargement): tried in turn until enough of the board is known."""
ENOUGH_TAGS = 6


def search_tags(image: SaddleImage, gray: Gray, target: AprilGrid) -> tuple[IntArray, FloatArray]:
    """Find tags of `target`.

    Returns:
        Tag ids, shape (n,), each at most once, and the corners 0..3 of each, px, shape (n, 4, 2).
    """
    tags = target.tag_cols * target.tag_rows
    found: dict[int, FloatArray] = {}
    for window, erosions, enlargement in PASSES:
        quads = _find_quads(gray, window, erosions, enlargement)
        edge = np.linalg.norm(quads - np.roll(quads, -1, axis=1), axis=2).min(axis=1, initial=np.inf)
        corners = image.refine(quads.reshape(-1, 2), np.repeat(edge * 0.18, 4), max_shift_px=3.0)
        ids, ordered = decode(image.smooth, corners.uv_px.reshape(-1, 4, 2), tags)
        doubled = {int(i) for i in ids if np.sum(ids == i) > 1}
        for tag, quad in zip(ids, ordered, strict=True):
            if tag >= 0 and int(tag) not in doubled:
                found.setdefault(int(tag), quad)
        if len(found) >= min(ENOUGH_TAGS, tags):
            break
    order = sorted(found)
    return np.array(order, np.int64), np.array([found[i] for i in order]).reshape(-1, 4, 2)


def _find_quads(gray: Gray, window: int, erosions: int, enlargement: int) -> FloatArray:
    """Convex black quadrilaterals, counter-clockwise for the viewer, shape (n, 4, 2), px of `gray`."""
    if enlargement > 1:
        gray = np.asarray(cv2.resize(gray, None, fx=enlargement, fy=enlargement), np.uint8)
    black = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, 6)
    black = cv2.erode(black, np.ones((3, 3), np.uint8), iterations=erosions)
    contours, hierarchy = cv2.findContours(black, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    quads = []
    least = MIN_EDGE_PX * enlargement - 2 * erosions
    for contour, links in zip(contours, hierarchy[0] if hierarchy is not None else [], strict=True):
        if links[3] < 0 and len(contour) >= 4:
            quad = _as_quad(contour, least)
            if quad is not None:
                quads.append(quad)
    if not quads:
        return np.zeros((0, 4, 2))
    quads.sort(key=lambda q: -float(cv2.contourArea(q.astype(np.float32))))
    grown = _grow(np.array(quads[:MAX_CANDIDATES]), erosions + 0.5)
    return (grown + 0.5) / enlargement - 0.5


def _as_quad(contour: IntArray, least_edge_px: float) -> FloatArray | None:
    _, _, width, height = cv2.boundingRect(contour)
    if min(width, height) < least_edge_px or max(width, height) > 20 * min(width, height):
        return None
    hull = cv2.convexHull(contour)
    area = cv2.contourArea(hull)
    if cv2.contourArea(contour) < 0.7 * area:
        return None
    quad = cv2.approxPolyDP(hull, 0.06 * cv2.arcLength(hull, True), True)
    if len(quad) != 4:
        return None
    corners = quad.reshape(4, 2).astype(np.float64)
    if np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).min() < 0.6 * least_edge_px:
        return None
    if abs(cv2.contourArea(quad) - area) > 0.2 * area:
        return None
    edge = np.roll(corners, -1, axis=0) - corners
    turning = edge[0, 0] * edge[1, 1] - edge[0, 1] * edge[1, 0]
    return np.ascontiguousarray(corners if turning < 0 else corners[::-1])


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
