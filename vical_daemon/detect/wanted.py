"""With `mode: verify`: how many images per second the role that verifies asks for now."""

from __future__ import annotations

import time

from vical_daemon.bus.interface import Bus, Sample
from vical_daemon.bus.messages import MessageError, admit_verification
from vical_daemon.service.liveness import FRESH_S


class WantedImages:
    """Follows the `VerifyResult` of one camera. A wish that is not repeated within `FRESH_S` has ended.

    Args:
        bus: Where it is published.
        key: Its key.
    """

    def __init__(self, bus: Bus, key: str) -> None:
        self._wish = (0.0, -float("inf"))  # images per second, when
        self._subscription = bus.subscribe(key, self._take)

    @property
    def rate_hz(self) -> float:
        """Images per second that are wanted now; 0: none."""
        rate_hz, at_s = self._wish
        return rate_hz if time.monotonic() - at_s < FRESH_S else 0.0

    def close(self) -> None:
        """Stop following."""
        self._subscription.close()

    def _take(self, sample: Sample) -> None:
        try:
            rate_hz = admit_verification(sample.payload).image_rate_hz
        except MessageError:
            return
        self._wish = rate_hz, time.monotonic()
