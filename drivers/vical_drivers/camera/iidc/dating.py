"""When a FireWire frame was taken, and how many are missing before it."""

from __future__ import annotations

from vical_drivers.camera.iidc.cycle_clock import WRAP_NS, CycleClock, image_cycle_time_ns
from vical_drivers.camera.iidc.embedded import EmbeddedInfo
from vical_drivers.camera.losses import SequenceCounter
from vical_drivers.camera.stamps import SIGMA_NS, Anchor, RawStamp
from vical_drivers.camera.statistics import FrameStatistics

OLDEST_NS = 2_000_000_000
"""No frame waits longer in the ring, unless this process was stopped: then stamps go on from the last."""
PACKET_STAMP_SIGMA_NS = 36_000
"""The first packet is dated by its bus cycle of 125 us: a uniform error of 125 us / sqrt(12)."""


class FrameDating:
    """Stamps and numbers the frames of one opening of the camera.

    Args:
        forced: `CameraSettings.stamp`: overrides what the stamp marks.
        rate_hz: Of the mode; 0.0: unknown.
        statistics: Where stamps that cannot be right are counted.

    Attributes:
        clock: The bus clock, fitted; fed by the caller once a frame.
        sequence: Number of the frame that `missing` was last asked about.
    """

    def __init__(self, forced: str, rate_hz: float, statistics: FrameStatistics) -> None:
        self._anchor = None if forced in ("auto", "raw") else Anchor(forced)
        self._rate_hz = rate_hz
        self._statistics = statistics
        self._counter = SequenceCounter(32)
        self._t_last_ns: int | None = None
        self.clock = CycleClock()
        self.sequence = 0

    def raw_stamp(self, info: EmbeddedInfo, t_packet_ns: int, t_arrival_ns: int) -> RawStamp:
        """Return when a frame was taken: by the cycle time in the image, else by its first packet.

        Args:
            info: What the camera wrote into the image.
            t_packet_ns: First packet, CLOCK_MONOTONIC, ns.
            t_arrival_ns: When the frame reached this process, CLOCK_MONOTONIC, ns.
        """
        if info.cycle_time is not None:
            t_ns = self.clock.to_host_ns(image_cycle_time_ns(info.cycle_time))
            oldest_ns = t_arrival_ns - OLDEST_NS
            if self._t_last_ns is not None and t_arrival_ns - self._t_last_ns < WRAP_NS:
                oldest_ns = min(oldest_ns, self._t_last_ns)
            if not oldest_ns < t_ns <= t_arrival_ns:
                # exposed before a bus reset gave the bus another time, and read after it
                self._statistics.count("implausible_stamps")
                return RawStamp(t_arrival_ns, Anchor.ARRIVAL, None, SIGMA_NS[Anchor.ARRIVAL])
            sigma_ns = round(self.clock.sigma_ns) + 200  # and the masked bits
            return RawStamp(t_ns, self._anchor or Anchor.SHUTTER_CLOSED, "embedded-cycle-timer", sigma_ns)
        return RawStamp(t_packet_ns, self._anchor or Anchor.FIRST_PACKET, None, PACKET_STAMP_SIGMA_NS)

    def missing(self, info: EmbeddedInfo, t_raw_ns: int) -> int:
        """Return how many frames are missing before this one: by the camera's counter, else by the gap."""
        if info.frame_counter is not None:
            missing = self._counter.missing_before(info.frame_counter)
        elif self._t_last_ns is None or self._rate_hz <= 0:
            missing = 0
        else:
            missing = max(0, round((t_raw_ns - self._t_last_ns) * 1e-9 * self._rate_hz) - 1)
        self._t_last_ns = t_raw_ns
        self.sequence += missing + 1
        return missing
