"""The last step of every camera driver: from an image and its raw stamp to a `Frame` with its losses."""

from __future__ import annotations

from vical_drivers.camera.exposure_stamper import ExposureStamper
from vical_drivers.camera.formats import Image
from vical_drivers.camera.losses import StampGaps
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.stamps import RawStamp
from vical_drivers.camera.statistics import FrameStatistics
from vical_drivers.samples import Frame


class FrameMaker:
    """Moves stamps to the middle of the exposure, and reports losses with the next good frame.

    Args:
        settings: Shutter, encoding and stamp rule.

    Attributes:
        stamper: Knows the exposure in force.
        statistics: Counters of the source, over all its openings.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self._settings = settings
        self.stamper = ExposureStamper(settings)
        self.statistics = FrameStatistics()
        self._lost = 0
        self._gaps = StampGaps()

    def reopened(self) -> None:
        """The camera came back: its numbers, stamps and rate start afresh."""
        self.statistics.restart()
        self._gaps.restart()

    def numbered(self, t_raw_ns: int, missing_before: int) -> None:
        """Note a frame that came, good or corrupt, and the frames that are missing before it.

        Args:
            t_raw_ns: When it was stamped, on a clock that nobody sets, ns.
            missing_before: Frames that the source's own numbers skip.
        """
        self.lost(missing_before)
        unnumbered = self._gaps.found(t_raw_ns, missing_before)
        if unnumbered:
            self.lost(unnumbered)
            self.statistics.lost_before_last(unnumbered)
            self.statistics.count("lost_in_camera", unnumbered)

    def lost(self, frames: int = 1) -> None:
        """Note frames that never came, or came corrupt: `Frame.dropped_before` of the next good frame."""
        self._lost += frames

    def count_corrupt(self, reason: str) -> None:
        """Count a corrupt frame under its reason."""
        self.statistics.count(reason)
        self.statistics.corrupt += 1

    def frame(self, image: Image, raw: RawStamp, *, sequence: int, t_arrival_ns: int) -> Frame:
        """Make the frame.

        Args:
            image: Pixels in the encoding of the settings.
            raw: When the driver says that it was taken.
            sequence: The source's own number.
            t_arrival_ns: When it reached this process, CLOCK_MONOTONIC, ns.
        """
        stamp, exposure_ns = self.stamper.stamp(raw)
        dropped, self._lost = self._lost, 0
        self.statistics.add(stamp.t_exposure_mid_ns, dropped)
        return Frame(
            t_exposure_mid_ns=stamp.t_exposure_mid_ns,
            t_arrival_ns=t_arrival_ns,
            sequence=sequence,
            image=image,
            encoding=self._settings.encoding,
            stamp_rule=stamp.rule,
            exposure_ns=exposure_ns,
            readout_ns=self._settings.shutter.row_spread_ns,
            t_sigma_ns=raw.t_sigma_ns,
            dropped_before=dropped,
        )
