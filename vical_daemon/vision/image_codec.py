"""JPEG and PNG, decompressed and compressed: what drivers are given as their `ImageDecoder`."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


def decode_image(data: npt.NDArray[np.uint8], *, colour: bool = False) -> npt.NDArray[np.uint8]:
    """Decompress one JPEG or PNG, as the sensor read it: a tag that asks for a turned display is ignored.

    Args:
        data: The file's bytes, shape (n,), uint8.
        colour: Return BGR instead of grey.

    Returns:
        Shape (h, w), or (h, w, 3) BGR if `colour`, uint8.

    Raises:
        ValueError: The bytes are no image, or a damaged one.
    """
    try:
        flags = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
        image = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ValueError(f"no image: {error}") from error
    if image is None:
        raise ValueError("the bytes are no image")
    return np.asarray(image, dtype=np.uint8)


def encode_image(image: Image, kind: str = "png", *, quality: int = 90) -> bytes:
    """Compress an image, shape (h, w) or (h, w, 3) BGR.

    Args:
        image: uint8, or uint16 for PNG.
        kind: "png" (lossless) or "jpeg".
        quality: Of a JPEG, 1 to 100.

    Raises:
        ValueError: Unknown kind, or an image that it cannot hold.
    """
    if kind not in ("png", "jpeg"):
        raise ValueError(f"unknown image kind {kind!r}: png or jpeg")
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if kind == "jpeg" else [cv2.IMWRITE_PNG_COMPRESSION, 1]
    done, data = cv2.imencode(".jpg" if kind == "jpeg" else ".png", image, options)
    if not done:
        raise ValueError(f"an image of shape {image.shape} and type {image.dtype} does not fit a {kind}")
    return bytes(data.tobytes())
