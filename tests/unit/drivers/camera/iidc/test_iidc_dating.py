"""Stamps of FireWire images: by the cycle time in the image, also if they waited in the ring."""

from __future__ import annotations

from vical_drivers.camera.iidc.cycle_clock import CYCLE_NS
from vical_drivers.camera.iidc.dating import FrameDating
from vical_drivers.camera.iidc.embedded import EmbeddedInfo
from vical_drivers.camera.statistics import FrameStatistics

S = 1_000_000_000
T0 = 5_000 * S  # CLOCK_MONOTONIC when the bus clock is zero


def cycle_time(t_host_ns: int) -> int:
    """CYCLE_TIME of that moment."""
    seconds, rest = divmod(t_host_ns - T0, S)
    return (seconds % 128) << 25 | (rest // CYCLE_NS) << 12


class Camera:
    """Images at 10 Hz, each read when the process comes to it."""

    def __init__(self) -> None:
        self.statistics = FrameStatistics()
        self.dating = FrameDating("auto", 10.0, self.statistics)

    def off_s(self, t_taken_ns: int, t_read_ns: int, embedded_ns: int | None = None) -> float:
        """By how much the stamp of one image misses the truth, s; `embedded_ns`: what the image says."""
        self.dating.clock.add(cycle_time(t_read_ns), t_read_ns)
        said = cycle_time(t_taken_ns if embedded_ns is None else embedded_ns)
        info = EmbeddedInfo(said, None, None)
        raw = self.dating.raw_stamp(info, t_taken_ns, t_read_ns)
        self.dating.missing(info, raw.t_raw_ns)
        return 1e-9 * (raw.t_raw_ns - t_taken_ns)


def test_images_that_waited_while_the_process_was_stopped_keep_their_stamps() -> None:
    """Read 2 s late and dated by their arrival, they were images of long ago under stamps of now."""
    camera, t_ns = Camera(), T0
    for _ in range(30):
        t_ns += S // 10
        assert abs(camera.off_s(t_ns, t_ns + 2_000_000)) < 1e-3
    resumes_ns = t_ns + 15 * S
    for k in range(1, 7):  # as many as the ring holds
        assert abs(camera.off_s(t_ns + k * S // 10, resumes_ns + k * 1_000_000)) < 1e-3
    for k in range(1, 10):
        now_ns = resumes_ns + k * S // 10
        assert abs(camera.off_s(now_ns, now_ns + 2_000_000)) < 1e-3


def test_the_time_of_another_bus_clock_is_not_used() -> None:
    camera, t_ns = Camera(), T0
    for _ in range(30):
        t_ns += S // 10
        camera.off_s(t_ns, t_ns + 2_000_000)
    t_ns += S // 10
    assert 0.0 < camera.off_s(t_ns, t_ns + 2_000_000, embedded_ns=t_ns - 40 * S) < 3e-3  # its arrival
    assert camera.statistics.snapshot().extra["implausible_stamps"] == 1
