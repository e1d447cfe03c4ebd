"""What the page shows of one camera besides its estimate: coverage, wanted place, motion, board."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import PointsMessage, decode_points
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.result import CameraEstimate
from vical_daemon.results.report.board_views import BoardView, view_of
from vical_daemon.results.report.scene import board, camera_pose
from vical_daemon.web.coverage import Coverage, Wanted, gain, tilt_name, wanted
from vical_daemon.web.meters import Motion, blur

PATH = 60
"""Poses kept: 24 s at one each tick."""
_DONE = 0.5  # of what a place was to add: when less is left, the next one is asked for
_LOOK_AGAIN = 5  # ticks until a next place is looked for where there was none


class CameraWatch:
    """Follows the corners of one camera. No I/O; `take` is called in the order of arrival.

    Args:
        target_m: Points of the board by id, m, shape (n, 3); None: not known, or target-free.
        size: width, height of the images where the messages do not have it; (0, 0): not known.
    """

    def __init__(self, target_m: FloatArray | None, size: tuple[int, int] = (0, 0)) -> None:
        self.target_m = target_m
        self.size = size
        self._coverage: Coverage | None = None
        self._motion = Motion()
        self._tilts: set[str] = set()
        self._path: deque[dict[str, Any]] = deque(maxlen=PATH)
        self._points: deque[PointsMessage] = deque(maxlen=60)
        self._viewed_ns = 0
        self._place: Wanted | None = None
        self._ticks = 0
        self.exposure_s: float | None = None

    def begin_again(self) -> None:
        """The calibration begins anew: forget what was seen."""
        self._coverage, self._tilts, self._place = None, set(), None
        self._motion = Motion()
        self._path.clear()

    def take(self, sample: Sample, topic: topics.Topic) -> None:
        """Take corners or predictions.

        Raises:
            MessageError: Malformed.
        """
        message = decode_points(sample.payload)
        if topic is topics.PREDICTED:
            self._compare(message)
            return
        self._points.append(message)
        self._motion.add(message.stamp_ns * 1e-9, message.ids, message.uv_px)
        if all(message.image_size):
            self.size = message.image_size
        if all(self.size) and (self._coverage is None or self._coverage.size != self.size):
            self._coverage = Coverage(self.size)
        if self._coverage is not None and len(message.uv_px):
            self._coverage.add(message.uv_px)

    def _compare(self, predicted: PointsMessage) -> None:
        found = next((p for p in reversed(self._points) if p.stamp_ns == predicted.stamp_ns), None)
        if found is None or self._coverage is None:
            return
        _, a, b = np.intersect1d(found.ids, predicted.ids, return_indices=True)
        if len(a):
            self._coverage.add_misfit(found.uv_px[a], predicted.uv_px[b] - found.uv_px[a])

    def document(self, camera: CameraEstimate | None, *, full: bool) -> dict[str, Any]:
        """Return what the page shows now.

        Args:
            camera: The estimate, for the lens; None: none yet.
            full: With the whole path, for a new viewer; otherwise with the newest pose alone.
        """
        view = self._look(camera)
        if view is not None:
            self._tilts.add(tilt_name(view.normal_cam))
            self._path.append(camera_pose(view))
        share = self._motion.board_share(0 if self.target_m is None else len(self.target_m))
        document: dict[str, Any] = {
            "coverage": None if self._coverage is None else self._coverage.document(),
            "wanted": self._wanted(camera),
            "rate_hz": _rounded(self._motion.rate_hz, 1),
            "board_share": _rounded(share, 3),
            "blur": blur(self._motion.speed_px_s, self.exposure_s),
            "board": None if self.target_m is None else board(self.target_m),
        }
        if full:
            document["path"] = list(self._path)
        else:
            document["pose"] = self._path[-1] if view is not None else None
        return document

    def _look(self, camera: CameraEstimate | None) -> BoardView | None:
        """Return the pose of the board in the newest image that has not been looked at."""
        if camera is None or self.target_m is None or not self._points:
            return None
        newest = self._points[-1]
        if newest.stamp_ns == self._viewed_ns:
            return None
        self._viewed_ns = newest.stamp_ns
        good = newest.ids < len(self.target_m)
        return view_of(
            newest.stamp_ns, self.target_m[newest.ids[good]], newest.uv_px[good].astype(np.float64),
            np.asarray(camera.intrinsics), np.asarray(camera.distortion), camera.distortion_model,
        )  # fmt: skip

    def _wanted(self, camera: CameraEstimate | None) -> dict[str, Any] | None:
        if camera is None or self.target_m is None or self._coverage is None:
            return None
        if not any(camera.intrinsics_sigma):
            return None  # the lens is held: coverage adds nothing
        place, self._ticks = self._place, self._ticks + 1
        left = 0.0 if place is None else gain(self._coverage, self._tilts, place.outline_px, place.tilt)
        done = place is not None and left < _DONE * place.gain
        if done or (place is None and self._ticks % _LOOK_AGAIN == 1):
            width, height = np.ptp(self.target_m[:, :2], axis=0).tolist()
            place = self._place = wanted(
                self._coverage, self._tilts, (width, height),
                np.asarray(camera.intrinsics), np.asarray(camera.distortion), camera.distortion_model,
            )  # fmt: skip
        if place is None:
            return None
        return {"outline": np.round(place.outline_px, 1).tolist(), "text": place.text}


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
