"""The 36h11 code words, and reading them from a picture."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray, IntArray, sample
from vical_daemon.vision.target import TAG_FAMILY_SIZE

BITS = 6  # a side: the family 36h11
BORDER = 2  # modules of black around them, as Kalibr prints them
MODULES = BITS + 2 * BORDER
MAX_WRONG_BITS = 3
"""Corrected bits; the family keeps any two words at least 11 bits apart."""
MIN_CONTRAST_DN = 12.0  # grey levels between black and white; below, noise decides the bits


@lru_cache(maxsize=1)
def tag_bits() -> npt.NDArray[np.bool_]:
    """White bits of every tag, shape (587, 6, 6), first row on top, upright as Kalibr prints them.

    OpenCV stores the family turned by half a turn against the published words, whose most significant bit
    is at the upper left.
    """
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    words = [
        cv2.aruco.Dictionary.getBitsFromByteList(family.bytesList[i : i + 1], BITS)
        for i in range(TAG_FAMILY_SIZE)
    ]
    return np.asarray(np.rot90(np.array(words, bool), 2, axes=(1, 2)))


@lru_cache(maxsize=1)
def bit_centres() -> FloatArray:
    """Centres of the 36 bits in a tag's own frame (lower-left corner (0,0), size 1), shape (36, 2)."""
    row, col = np.divmod(np.arange(BITS * BITS), BITS)
    return np.stack([(col + BORDER + 0.5) / MODULES, 1 - (row + BORDER + 0.5) / MODULES], axis=1)


def bit_places(quads_px: FloatArray) -> FloatArray:
    """Pixels of the 36 bits of tags, by the homography of each: the unit square to a quadrilateral.

    P. Heckbert, "Fundamentals of Texture Mapping and Image Warping" (1989), section 2.2.3.

    Args:
        quads_px: Corners 0..3 of each tag, shape (n, 4, 2).

    Returns:
        Shape (n, 36, 2).
    """
    p0, p1, p2, p3 = quads_px.transpose(1, 2, 0)  # u and v of all tags, shape (2, n)
    uneven, d1, d2 = p0 - p1 + p2 - p3, p1 - p2, p3 - p2
    det = d1[0] * d2[1] - d1[1] * d2[0]
    det = np.where(np.abs(det) < 1e-9, 1e-9, det)
    g = (uneven[0] * d2[1] - uneven[1] * d2[0]) / det
    h = (d1[0] * uneven[1] - d1[1] * uneven[0]) / det
    right, up = p1 - p0 + g * p1, p3 - p0 + h * p3
    x, y = bit_centres().T
    depth = g[:, None] * x + h[:, None] * y + 1.0
    uv = (right[..., None] * x + up[..., None] * y + p0[..., None]) / np.maximum(depth, 1e-6)
    return np.asarray(uv.transpose(1, 2, 0))


def decode(
    image: npt.NDArray[np.float32], quads_px: FloatArray, tags: int, first: int = 0
) -> tuple[IntArray, FloatArray]:
    """Read the tags in quadrilaterals.

    Args:
        image: Grey picture, float32.
        quads_px: Corners of each candidate, counter-clockwise for the viewer, any first corner, (n, 4, 2).
        tags: How many ids are looked for.
        first: The smallest of them.

    Returns:
        Tag ids counted from `first`, shape (n,), -1 where there is none, and the corners turned so that
        corner 0 comes first.
    """
    if not len(quads_px):
        return np.zeros(0, np.int64), quads_px
    levels = sample(image, bit_places(quads_px))
    ordered = np.sort(levels, axis=1)
    dark, bright = ordered[:, 5], ordered[:, 30]  # 15 and 85 per cent
    signs = np.where(levels > ((dark + bright) / 2)[:, None], 1.0, -1.0)
    score = signs @ _turned_words(tags, first).T
    best = np.argmax(score, axis=1)
    wrong = (BITS * BITS - score[np.arange(len(best)), best]) / 2
    good = (wrong <= MAX_WRONG_BITS) & (bright - dark > MIN_CONTRAST_DN)
    ids, turn = best % tags, best // tags
    order = (np.arange(4)[None, :] - turn[:, None]) % 4
    return np.where(good, ids, -1), np.take_along_axis(quads_px, order[:, :, None], axis=1)


def agreement(levels: FloatArray, ids: IntArray) -> FloatArray:
    """Correlation of sampled bit levels (n, 36) with the words of `ids`: near 1 right, near 0 wrong tag."""
    a = levels - levels.mean(axis=1, keepdims=True)
    dots = np.einsum("ni,ni->n", a, _centred_words()[ids])
    return np.asarray(dots / np.maximum(np.sqrt(np.einsum("ni,ni->n", a, a)), 1e-9))


@lru_cache(maxsize=1)
def _centred_words() -> FloatArray:
    """Words as +-1 without their mean, of unit length, shape (587, 36)."""
    words = np.where(tag_bits().reshape(TAG_FAMILY_SIZE, -1), 1.0, -1.0)
    words -= words.mean(axis=1, keepdims=True)
    return np.asarray(words / np.linalg.norm(words, axis=1, keepdims=True))


@lru_cache(maxsize=8)
def _turned_words(tags: int, first: int) -> FloatArray:
    """Words as +-1 if the first quad corner is corner j, in row j * tags + id - first, (4 * tags, 36)."""
    bits = tag_bits()[first : first + tags]
    turned = [np.rot90(bits, -j, axes=(1, 2)).reshape(tags, -1) for j in range(4)]
    return np.where(np.concatenate(turned), 1.0, -1.0)
