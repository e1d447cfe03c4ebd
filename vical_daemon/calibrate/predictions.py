"""Publishes where the filter expected the points of an image, before it used them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vical_daemon.bus import topics
from vical_daemon.bus.messages import encode_points
from vical_daemon.bus.outgoing import Message


class Predictions:
    """Keeps the report on the newest image of each camera until it is published.

    Args:
        rig: Name of the rig.
    """

    def __init__(self, rig: str) -> None:
        self._rig = rig
        self._newest: dict[str, Any] = {}

    def take(self, frames: Sequence[Any]) -> None:
        """Take the reports on some images; ignores those without a prediction."""
        for frame in frames:
            if len(getattr(frame, "predicted_px", ())):
                self._newest[frame.camera] = frame

    def messages(self) -> list[Message]:
        """Return the prediction of the newest image of each camera; each once."""
        found = []
        for camera, frame in self._newest.items():
            good = np.isfinite(frame.predicted_px).all(axis=1)
            payload = encode_points(frame.t_ns, camera, frame.ids[good], frame.predicted_px[good])
            found.append((topics.PREDICTED.key(self._rig, camera), payload))
        self._newest.clear()
        return found
