"""The camera view: the newest image that has its points, points drawn in, as JPEG."""

from __future__ import annotations

import struct
import threading
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_daemon import topics
from vical_daemon.bus import Sample
from vical_daemon.messages import (
    MessageError,
    decode_compressed_image,
    decode_image,
    decode_points,
)

WIDTH_LIMIT = 800  # wider images are thinned: the page is for looking, not for measuring
PATIENCE_NS = 1_200_000_000  # an image without points is shown when nothing better came for so long
RESTART_NS = 5_000_000_000
KEPT_BYTES = 24 * 2**20  # images that wait for their points: about a second of them
_STAMP = struct.Struct("<4xiI")  # behind the four bytes that begin every CDR message
_RING = np.array([(x, y) for x in range(-5, 6) for y in range(-5, 6) if 10 <= x * x + y * y <= 26])
_PALETTE = np.array(
    [(0, 94, 213), (115, 158, 0), (178, 114, 0), (66, 228, 240), (167, 121, 204), (0, 159, 230)],
    dtype=np.uint8,
)


class CameraView:
    """Pairs images with their points by stamp. `take` may be called from any thread.

    Args:
        camera: Name of the camera.
    """

    def __init__(self, camera: str) -> None:
        self.camera = camera
        self._lock = threading.Lock()
        self._images: deque[Sample] = deque(maxlen=40)
        self._points: deque[Sample] = deque(maxlen=60)
        self._shown_ns = 0

    def take(self, sample: Sample) -> None:
        """Keep an image or points message."""
        parsed = topics.parse_key(sample.key)
        if parsed is None or parsed.name != self.camera:
            return
        is_image = parsed.topic in (topics.IMAGE, topics.COMPRESSED)
        with self._lock:
            if not is_image:
                self._points.append(sample)
                return
            self._images.append(sample)
            while len(self._images) > 2 and sum(len(s.payload) for s in self._images) > KEPT_BYTES:
                self._images.popleft()

    def jpeg(self) -> bytes | None:
        """Return the next picture as JPEG; None while there is nothing newer than the last one."""
        with self._lock:
            images, points = list(self._images), list(self._points)
        known = {_stamp_ns(sample): sample for sample in points}
        newest: tuple[int, Sample] | None = None
        for sample in reversed(images):
            stamp_ns = _stamp_ns(sample)
            if stamp_ns < self._shown_ns - RESTART_NS:
                self._shown_ns = 0  # the clock went back: a replay that began anew
            if stamp_ns <= self._shown_ns:
                break
            if stamp_ns in known:
                return self._encode(stamp_ns, sample, known[stamp_ns])
            newest = newest or (stamp_ns, sample)
        if newest is None or newest[0] - self._shown_ns < PATIENCE_NS:
            return None
        return self._encode(*newest, None)

    def _encode(self, stamp_ns: int, image: Sample, points_sample: Sample | None) -> bytes | None:
        from vical_daemon.vision.image_codec import encode_image

        self._shown_ns = stamp_ns
        try:
            pixels = _pixels(image)
            points = None if points_sample is None else decode_points(points_sample.payload)
        except MessageError:
            return None
        factor = -(-pixels.shape[1] // WIDTH_LIMIT)
        picture = colour(pixels[::factor, ::factor])
        if points is not None:
            draw_rings(picture, points.uv_px / factor, points.ids)
        return encode_image(picture, "jpeg", quality=80)


def _stamp_ns(sample: Sample) -> int:
    """Read the stamp of a message that begins with a std_msgs/Header; 0 where it is too short for one."""
    if len(sample.payload) < _STAMP.size:
        return 0
    seconds, nanoseconds = _STAMP.unpack_from(sample.payload)
    return int(seconds) * 10**9 + int(nanoseconds)


def _pixels(sample: Sample) -> npt.NDArray[Any]:
    parsed = topics.parse_key(sample.key)
    if parsed is not None and parsed.topic is topics.COMPRESSED:
        from vical_daemon.vision.image_codec import decode_image as decode_file

        return decode_file(np.frombuffer(decode_compressed_image(sample.payload).data, dtype=np.uint8))
    return decode_image(sample.payload).pixels()


def colour(pixels: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Return a writable BGR image, shape (h, w, 3), of a grey or colour image of 8 or 16 bits."""
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.ndim == 2:
        picture = np.empty((*pixels.shape, 3), dtype=np.uint8)
        for channel in range(3):  # three times as fast as np.repeat along the last axis
            picture[:, :, channel] = pixels
        return picture
    return np.array(pixels[:, :, :3], dtype=np.uint8, order="C")


def draw_rings(
    picture: npt.NDArray[np.uint8], uv_px: npt.NDArray[np.float64], ids: npt.NDArray[np.int64]
) -> None:
    """Draw a ring round every point, in place; the colour follows the id."""
    height, width = picture.shape[:2]
    if not len(ids):
        return
    centre = np.round(uv_px[:, None, :]).astype(np.int64) + _RING
    shade = np.broadcast_to(_PALETTE[ids % len(_PALETTE)][:, None, :], (len(ids), len(_RING), 3))
    x, y = centre[..., 0], centre[..., 1]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    picture[y[inside], x[inside]] = shade[inside]
