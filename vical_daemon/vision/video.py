"""Video files, read image by image in grey: stamps, size, and pixels as the sensor read them."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

_OPTIONS = (
    "format_whitelist;mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,asf,mpegts,mpeg|protocol_whitelist;file"
)
"""For FFmpeg: containers with stamps, and none that names other files or addresses (a playlist)."""
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET, read once: we say it in one line
_MOST_PX = 2**27  # as of an image of a folder (docs/logs.md): 134 Mpx


class VideoError(Exception):
    """A file that cannot be used as a video; the message says why, without the name of the file."""


class Video:
    """A video. Images are decoded one after the other and not kept.

    Args:
        path: Of the file.

    Attributes:
        t_ns: Of each image, from the video's own zero, ns, shape (n,).
        size: Width, height, px.
        announced: How many images the file says that it has; 0: it does not say.
        turned_deg: By how much players turn its images, clockwise, deg; here they are unturned.

    Raises:
        VideoError: It is no video that can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        capture = self._opened()
        stamps_ms = []
        while capture.grab():
            stamps_ms.append(capture.get(cv2.CAP_PROP_POS_MSEC))
        if not stamps_ms:
            raise VideoError("holds no image that can be read")
        self.t_ns: npt.NDArray[np.int64] = np.round(np.array(stamps_ms) * 1e6).astype(np.int64)
        if (np.diff(self.t_ns) <= 0).any():
            raise VideoError(
                "has images without stamps, or in disorder: write it anew (ffmpeg -i IN OUT.mp4)"
            )
        self.size = (
            int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        if self.size[0] * self.size[1] > _MOST_PX:
            raise VideoError(f"has images of {self.size[0]} x {self.size[1]} px, more than any camera")
        self.announced = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        self.turned_deg = int(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        self._capture, self._next = capture, len(stamps_ms)

    def image(self, number: int) -> npt.NDArray[np.uint8]:
        """Return one image, grey, shape (height, width); quick where they are asked for in their order.

        Raises:
            VideoError: It cannot be read any more.
        """
        if number < self._next:
            self._capture, self._next = self._opened(), 0
        while self._next <= number:
            if not self._capture.grab():
                raise VideoError("cannot be read any more: has it changed?")
            self._next += 1
        done, image = self._capture.retrieve()
        if not done:
            raise VideoError(f"has an image (number {number}) that cannot be read")
        return np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)

    def _opened(self) -> cv2.VideoCapture:
        before = os.environ.get("OPENCV_FFMPEG_CAPTURE_OPTIONS")
        level = cv2.utils.logging.getLogLevel()
        os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = _OPTIONS
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            capture = cv2.VideoCapture(str(self._path.absolute()), cv2.CAP_FFMPEG)
        except cv2.error as error:
            raise VideoError(f"cannot be opened: {error}") from error
        finally:
            cv2.utils.logging.setLogLevel(level)
            del os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"]
            if before is not None:
                os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = before
        if not capture.isOpened():
            raise VideoError(
                "is no video that OpenCV can read: not copied whole (an .mp4 has its index at the end), of "
                "another kind, or without the codec; convert it (ffmpeg -i IN -c:v libx264 -crf 10 OUT.mp4)"
            )
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return capture
