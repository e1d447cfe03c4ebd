"""What a detector returns, and the grey picture it works on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Gray = npt.NDArray[np.uint8]
AnyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Detection:
    """Target points found in one image.

    Attributes:
        ids: Point ids, ascending, shape (n,), int64.
        uv_px: Pixel coordinates (u right, v down, pixel centres at integers), shape (n, 2).
        sigma_px: One-sigma per axis from pixel noise, contrast and blur at each point, shape (n,);
            errors that a whole frame shares are not in it. None where the detector cannot tell.
    """

    ids: IntArray
    uv_px: FloatArray
    sigma_px: FloatArray | None = None


_TO_GRAY = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}  # by channels
_CLIPPED = 0.002
"""Share of the pixels: 600 of 640 x 480. A lamp is smaller, the white of a board is larger."""
_EVERY = 4  # rows and columns: 19 200 pixels of 640 x 480 tell the brightness


def as_gray(image: AnyImage) -> Gray:
    """Return the picture as 8-bit grey: BGR is mixed, an alpha channel is left out, 16 bit is `stretched`.

    Raises:
        ValueError: The shape is neither (h, w) nor (h, w, 3 or 4), or the type is not uint8 or uint16.
    """
    if image.ndim == 3 and image.shape[2] in _TO_GRAY:
        image = cv2.cvtColor(image, _TO_GRAY[image.shape[2]])
    if image.ndim != 2:
        raise ValueError(f"image of shape {image.shape}: expected (height, width) or (height, width, 3 or 4)")
    if image.dtype == np.uint16:
        return stretched(np.asarray(image, np.uint16))
    if image.dtype != np.uint8:
        raise ValueError(f"image of type {image.dtype}: expected uint8 or uint16")
    return np.ascontiguousarray(image, np.uint8)


def stretched(image: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint8]:
    """Return a picture of 16 bit in 8, shape as given.

    The darkest and the brightest share of `_CLIPPED` become black and white: a lamp, a reflection or a hot
    pixel would leave a board a few grey levels, as would the offset of a thermal camera.
    """
    some = image[::_EVERY, ::_EVERY]
    low, high = np.quantile(some, [_CLIPPED, 1.0 - _CLIPPED], method="nearest").tolist()
    levels = np.clip(image, low, high) - np.uint16(low)
    return np.asarray(cv2.convertScaleAbs(levels, alpha=255.0 / max(high - low, 1)), np.uint8)


def sample(image: npt.NDArray[np.float32], uv_px: FloatArray) -> FloatArray:
    """Bilinear grey levels at (finite) pixels, shape (...,); points outside repeat the edge."""
    flat = uv_px.reshape(-1, 2).astype(np.float32)
    rows = 16384
    parts = [
        cv2.remap(image, flat[i : i + rows, None, :], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for i in range(0, len(flat), rows)
    ]
    return np.concatenate(parts).reshape(uv_px.shape[:-1]).astype(np.float64)


def median(values: FloatArray) -> float:
    """The middle one of some numbers (the upper of two), shape (n,), n > 0: a tenth of np.median's time."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])
