"""Planar textures at several scales, band-limited, so that bilinear look-ups do not alias."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from vical_mocks.board_art import BoardArt

FloatArray = npt.NDArray[np.float64]
Texture = tuple[npt.NDArray[np.uint16], FloatArray]

TEXELS_PER_SIGMA = 2.0
LEVELS_PER_OCTAVE = 2
MAX_TEXELS = 3600
FULL_SCALE = 65535.0


class BoardTexture:
    """A board's ink as reflectance, drawn by exact area coverage and blurred by a symmetric Gaussian.

    A kernel that is symmetric on the board stays symmetric in the image (but for perspective within its own
    two pixels, < 0.002 px), so a rendered corner has no bias; its width plays the part of the lens' blur.

    Args:
        art: What is printed.
        white: Reflectance of the paper, 0 to 1.
        black: Reflectance of the ink.
        surround: Reflectance beyond the paper (returned by `remap`'s border too, see `surround_level`).
    """

    def __init__(
        self, art: BoardArt, white: float = 0.85, black: float = 0.08, surround: float = 0.35
    ) -> None:
        self.art = art
        self._white, self._black, self._surround = white, black, surround
        self._levels: dict[int, Texture] = {}

    @property
    def surround_level(self) -> float:
        """Texture value beyond the paper, 0 to FULL_SCALE."""
        return self._surround * FULL_SCALE

    def at_scale(self, sigma_m: float) -> Texture:
        """Texture whose blur is about `sigma_m` on the board, and the map from board to texels.

        Returns:
            Reflectance times FULL_SCALE, shape (rows, cols) uint16, and the matrix (3, 3) that maps
            homogeneous board coordinates (m) to texel coordinates (centres at integers).
        """
        level = round(LEVELS_PER_OCTAVE * math.log2(max(sigma_m, self._finest_sigma_m())))
        if level not in self._levels:
            self._levels[level] = self._draw(2.0 ** (level / LEVELS_PER_OCTAVE))
        return self._levels[level]

    def _finest_sigma_m(self) -> float:
        x0, y0, x1, y1 = self.art.paper_m
        return max(x1 - x0, y1 - y0) / MAX_TEXELS * TEXELS_PER_SIGMA

    def _draw(self, sigma_m: float) -> Texture:
        texel_m = sigma_m / TEXELS_PER_SIGMA
        x0, y0, x1, y1 = self.art.paper_m
        pad = int(4 * TEXELS_PER_SIGMA) + 1
        shape = (math.ceil((y1 - y0) / texel_m) + 2 * pad, math.ceil((x1 - x0) / texel_m) + 2 * pad)
        # Texel index i covers [i - 0.5, i + 0.5]; board coordinate x0 falls on the left edge of texel `pad`.
        to_texel = np.array(
            [
                [1 / texel_m, 0, pad - 0.5 - x0 / texel_m],
                [0, 1 / texel_m, pad - 0.5 - y0 / texel_m],
                [0, 0, 1],
            ]
        )
        reflectance = np.full(shape, self._surround, np.float32)
        _cover(reflectance, np.array(self.art.paper_m), to_texel, self._white - self._surround)
        for rectangle in self.art.black_m:
            _cover(reflectance, rectangle, to_texel, self._black - self._white)
        size = 2 * int(4 * TEXELS_PER_SIGMA) + 1
        blurred = cv2.GaussianBlur(reflectance, (size, size), TEXELS_PER_SIGMA)
        return np.round(blurred * FULL_SCALE).astype(np.uint16), to_texel


def _cover(
    image: npt.NDArray[np.float32], rectangle: FloatArray, to_texel: FloatArray, change: float
) -> None:
    """Add `change` times the covered share of each texel."""
    x0, y0, x1, y1 = rectangle
    cols, along_x = _overlap(to_texel[0, 0] * x0 + to_texel[0, 2], to_texel[0, 0] * x1 + to_texel[0, 2])
    rows, along_y = _overlap(to_texel[1, 1] * y0 + to_texel[1, 2], to_texel[1, 1] * y1 + to_texel[1, 2])
    image[rows, cols] += (change * np.outer(along_y, along_x)).astype(np.float32)


def _overlap(low: float, high: float) -> tuple[slice, FloatArray]:
    """Share of each texel [i - 0.5, i + 0.5] that lies in [low, high]."""
    first, last = math.floor(low + 0.5), math.floor(high + 0.5)
    index = np.arange(first, last + 1)
    share = np.minimum(index + 0.5, high) - np.maximum(index - 0.5, low)
    return slice(first, last + 1), np.clip(share, 0.0, 1.0)
