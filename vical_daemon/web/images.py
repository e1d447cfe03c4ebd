"""The camera view: the newest image with the points found in it and where the filter expected them."""

from __future__ import annotations

import base64
import struct
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import (
    MessageError,
    PointsMessage,
    decode_compressed_image,
    decode_image,
    decode_points,
)
from vical_daemon.web.meters import light

WIDTH_LIMIT = 800  # px; wider images are thinned for display
QUALITY = 70
PATIENCE_NS = 1_200_000_000  # an image without points is shown after this time without a better one
RESTART_NS = 5_000_000_000
SIDE_LIMIT = 10_000  # px: bounds memory for an image size that a message states
KEPT_BYTES = 24 * 2**20  # images that wait for their points: about 1 s
_STAMP = struct.Struct("<4xiI")  # behind the four bytes that begin every CDR message
_RING = np.array([(x, y) for x in range(-5, 6) for y in range(-5, 6) if 10 <= x * x + y * y <= 26])
_CROSS = np.array([(d, s * d) for d in range(-3, 4) for s in (-1, 1)])
_DETECTED, _PREDICTED = (115, 158, 0), (0, 94, 213)  # BGR: green and orange, distinct to the colour-blind


@dataclass(frozen=True, slots=True)
class Sight:
    """An image with the points found and the points predicted.

    Attributes:
        stamp_ns: Stamp of all three, UNIX ns.
        image: Image or compressed image message; None: only points arrive (a log without images).
        points: Points message of the same stamp; None: none came.
        predicted: Predicted points of the same stamp; None: none came.
    """

    stamp_ns: int
    image: Sample | None
    points: Sample | None = None
    predicted: Sample | None = None


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
        self._predicted: deque[Sample] = deque(maxlen=20)
        self._shown_ns = 0
        self._since_ns = 0  # stamp of the newest image, or of the first points while there is none

    def take(self, sample: Sample) -> None:
        """Keep an image or a message with points."""
        parsed = topics.parse_key(sample.key)
        if parsed is None or parsed.name != self.camera:
            return
        with self._lock:
            if parsed.topic is topics.PREDICTED:
                self._predicted.append(sample)
            elif parsed.topic in (topics.IMAGE, topics.COMPRESSED):
                if self._images and _stamp_ns(sample) < _stamp_ns(self._images[-1]) - RESTART_NS:
                    self._begin_anew()
                self._images.append(sample)
                self._since_ns = _stamp_ns(sample)
                while len(self._images) > 2 and sum(len(s.payload) for s in self._images) > KEPT_BYTES:
                    self._images.popleft()
            else:
                self._take_points(sample)

    def _take_points(self, sample: Sample) -> None:
        stamp_ns = _stamp_ns(sample)
        last_ns = _stamp_ns(self._points[-1]) if self._points else 0
        if stamp_ns < last_ns - RESTART_NS:
            self._begin_anew()
            last_ns = 0
        if not self._since_ns or stamp_ns > last_ns + PATIENCE_NS:
            self._since_ns = max(self._since_ns, stamp_ns)
        self._points.append(sample)

    def _begin_anew(self) -> None:
        """Forget all messages: the stamps went back, as when a replay repeats."""
        for queue in (self._images, self._points, self._predicted):
            queue.clear()
        self._shown_ns = self._since_ns = 0

    def next(self) -> Sight | None:
        """Return the next sight to show; None if there is nothing newer.

        The newest image that has both its points and a prediction; while nothing is predicted, one that
        has its points; while nothing is detected, an image alone; while no images come, points alone.
        """
        with self._lock:
            images, predicted = list(self._images), {_stamp_ns(s): s for s in self._predicted}
            points = {_stamp_ns(sample): sample for sample in self._points}
        stamps = {_stamp_ns(sample): sample for sample in images}
        newest_ns = max(stamps, default=0)
        fresh = [stamp_ns for stamp_ns in sorted(stamps, reverse=True) if stamp_ns > self._shown_ns]
        full = [stamp_ns for stamp_ns in fresh if stamp_ns in points and stamp_ns in predicted]
        found = [stamp_ns for stamp_ns in fresh if stamp_ns in points]
        if full:
            chosen = full[0]
        elif found and max(predicted, default=0) < max(points) - PATIENCE_NS:
            chosen = found[0]
        elif fresh and newest_ns - self._shown_ns > PATIENCE_NS:
            chosen = (found or fresh)[0]
        elif max(points, default=0) - self._since_ns > PATIENCE_NS:
            return self._points_alone(points, predicted)
        else:
            return None
        self._shown_ns = chosen
        return Sight(chosen, stamps[chosen], points.get(chosen), predicted.get(chosen))

    def _points_alone(self, points: dict[int, Sample], predicted: dict[int, Sample]) -> Sight | None:
        """Return the newest points, if possible with a prediction; None if they have been shown."""
        fresh = [stamp_ns for stamp_ns in sorted(points, reverse=True) if stamp_ns > self._shown_ns]
        if not fresh:
            return None
        chosen = next((stamp_ns for stamp_ns in fresh if stamp_ns in predicted), fresh[0])
        self._shown_ns = chosen
        return Sight(chosen, None, points[chosen], predicted.get(chosen))


def picture_event(sight: Sight) -> bytes | None:
    """Return a server-sent event with the picture and its points for the browser to draw; None: unreadable.

    Without an image the picture is empty.

    The points travel as numbers, in pixels of the full image, so that they stay sharp on a small picture.
    """
    try:
        pixels, points, predicted = _contents(sight)
    except MessageError:
        return None
    jpeg, brightness = b"", None
    if sight.image is not None:
        from vical_daemon.vision.image_codec import encode_image

        small, _ = thinned(pixels)
        jpeg, brightness = encode_image(small, "jpeg", quality=QUALITY), light(small)
    document = {
        "stamp_s": round(sight.stamp_ns * 1e-9, 3),
        "size": [pixels.shape[1], pixels.shape[0]],
        "searched": points is not None,
        "detected": _rows(points),
        "predicted": _rows(predicted),
        "light": brightness,
        "jpeg": base64.b64encode(jpeg).decode(),
    }
    return b"event: picture\ndata: " + msgspec.json.encode(document) + b"\n\n"


def drawn_jpeg(sight: Sight) -> bytes | None:
    """Return the picture as JPEG with the points drawn in; None: unreadable."""
    try:
        pixels, points, predicted = _contents(sight)
    except MessageError:
        return None
    from vical_daemon.vision.image_codec import encode_image

    small, factor = thinned(pixels)
    picture = colour(small)
    for marks, shape, shade in ((points, _RING, _DETECTED), (predicted, _CROSS, _PREDICTED)):
        if marks is not None:
            draw(picture, marks.uv_px / factor, shape, shade)
    return encode_image(picture, "jpeg", quality=QUALITY)


def _contents(sight: Sight) -> tuple[npt.NDArray[Any], PointsMessage | None, PointsMessage | None]:
    """Decode a sight; without an image the picture is black.

    Raises:
        MessageError: One of its messages is malformed.
    """
    read = [None if s is None else decode_points(s.payload) for s in (sight.points, sight.predicted)]
    pixels = np.zeros(_size(read[0]), np.uint8) if sight.image is None else pixels_of(sight.image)
    return pixels, read[0], read[1]


def _size(points: PointsMessage | None) -> tuple[int, int]:
    """Height and width of the image in which points were found; of a smallest one if it is unknown."""
    if points is None:
        return 480, 640
    width, height = points.image_size
    if width and height:
        return min(height, SIDE_LIMIT), min(width, SIDE_LIMIT)
    far = (
        np.nanmax(points.uv_px, axis=0, initial=1.0) + 2.0 if len(points.uv_px) else np.array([640.0, 480.0])
    )
    width, height = np.clip(np.nan_to_num(far), 2, SIDE_LIMIT).astype(int).tolist()
    return height, width


def _rows(points: PointsMessage | None) -> list[list[float]]:
    """Return id, u, v of each point, rounded for display."""
    if points is None:
        return []
    uv = np.round(points.uv_px, 2).tolist()
    return [[number, u, v] for number, (u, v) in zip(points.ids.tolist(), uv, strict=True)]


def thinned(pixels: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], int]:
    """Return an image of at most `WIDTH_LIMIT` columns and 8 bits, and the step between the pixels taken."""
    factor = -(-pixels.shape[1] // WIDTH_LIMIT)
    small = np.ascontiguousarray(pixels[::factor, ::factor])
    if small.dtype == np.uint16:
        from vical_daemon.vision.detection import stretched

        small = stretched(small)
    return small, factor


def _stamp_ns(sample: Sample) -> int:
    """Read the stamp of a message that begins with a std_msgs/Header; 0 if it is too short."""
    if len(sample.payload) < _STAMP.size:
        return 0
    seconds, nanoseconds = _STAMP.unpack_from(sample.payload)
    return int(seconds) * 10**9 + int(nanoseconds)


def pixels_of(sample: Sample) -> npt.NDArray[Any]:
    """Return the pixels of an image message, plain or compressed: grey (h, w) or BGR (h, w, 3).

    Raises:
        MessageError: It is malformed.
    """
    parsed = topics.parse_key(sample.key)
    if parsed is not None and parsed.topic is topics.COMPRESSED:
        from vical_daemon.vision.image_codec import decode_image as decode_file

        return decode_file(np.frombuffer(decode_compressed_image(sample.payload).data, dtype=np.uint8))
    message = decode_image(sample.payload)
    pixels = message.pixels()
    if pixels.ndim == 3:  # BGR, as the encoder takes it, without alpha
        return pixels[:, :, 2::-1] if message.encoding.startswith("rgb") else pixels[:, :, :3]
    return pixels


def colour(pixels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return a writable BGR image, shape (h, w, 3), of a grey or colour one."""
    if pixels.ndim == 2:
        picture = np.empty((*pixels.shape, 3), dtype=np.uint8)
        for channel in range(3):  # three times as fast as np.repeat along the last axis
            picture[:, :, channel] = pixels
        return picture
    return np.array(pixels[:, :, :3], dtype=np.uint8, order="C")


def draw(
    picture: npt.NDArray[np.uint8],
    uv_px: npt.NDArray[np.float64],
    shape: npt.NDArray[np.int64],
    shade: tuple[int, int, int],
) -> None:
    """Draw a mark (offsets of its pixels, shape (k, 2)) round every point, in place."""
    height, width = picture.shape[:2]
    if not len(uv_px):
        return
    near = np.clip(uv_px, -1e4, 1e4)  # a prediction may lie anywhere
    at = np.round(near[:, None, :]).astype(np.int64) + shape
    x, y = at[..., 0].ravel(), at[..., 1].ravel()
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    picture[y[inside], x[inside]] = shade
