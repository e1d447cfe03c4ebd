"""The exposure that was in force when a frame was taken. Pure arithmetic."""

from __future__ import annotations

from collections import deque

from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.stamps import ExposureStamp, RawStamp, exposure_middle

_CHANGES = 8
"""Changes that are remembered: automatic exposure makes one an image, and some images wait in the ring."""


class ExposureStamper:
    """Moves raw stamps to the middle of the exposure that was in force.

    Args:
        settings: Shutter, assumed exposure, and whether stamps stay raw.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self._shutter = settings.shutter
        self._raw = settings.stamp == "raw"
        assumed = settings.assume_exposure_s
        self._assumed_ns = None if assumed is None else round(assumed * 1e9)
        self._exposure_ns: int | None = None
        self._changes: deque[tuple[int, int | None]] = deque(maxlen=_CHANGES)  # when, and what was before

    @property
    def exposure_ns(self) -> int | None:
        """Exposure in force now, ns; None where unknown."""
        return self._exposure_ns if self._exposure_ns is not None else self._assumed_ns

    def set_exposure(self, exposure_ns: int | None, t_set_ns: int) -> None:
        """Take a new exposure; frames that began to expose before `t_set_ns` keep the old one."""
        if exposure_ns == self._exposure_ns:
            return
        self._changes.append((t_set_ns, self.exposure_ns))
        self._exposure_ns = exposure_ns

    def stamp(self, raw: RawStamp) -> tuple[ExposureStamp, int | None]:
        """Return the stamp of the middle of the exposure, and the exposure it was made with, ns."""
        exposure_ns = self.exposure_ns
        made = self._with(raw, exposure_ns)
        for changed_ns, before_ns in reversed(self._changes):
            if exposure_ns is None or made.t_exposure_mid_ns - exposure_ns // 2 >= changed_ns:
                break
            exposure_ns = before_ns
            made = self._with(raw, exposure_ns)
        return made, exposure_ns

    def _with(self, raw: RawStamp, exposure_ns: int | None) -> ExposureStamp:
        used = None if self._raw else exposure_ns
        return exposure_middle(raw.t_raw_ns, raw.anchor, used, self._shutter, origin=raw.origin)
