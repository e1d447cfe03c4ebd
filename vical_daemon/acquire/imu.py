"""Role imu: one thread per IMU, blocking read -> stamp (in the driver) -> bounded queue -> bus.

The reading thread also publishes. While the bus blocks it, another thread reads (`direct_queue`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from vical_drivers.samples import ImuSample, ImuSource

from vical_daemon.acquire.pipeline import DevicePipeline, StampOrder, run_pipelines, start_pipeline
from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus
from vical_daemon.bus.messages import imu_encoder
from vical_daemon.config.model import LOG_SCHEME, Config, ImuConfig
from vical_daemon.service.wall_clock import WallClock, service_clock

QUEUE_DEPTH = 8192  # 8 s at 1000 Hz

OpenImu = Callable[[ImuConfig], ImuSource]


class ImuEncoder:
    """Turns the samples of one IMU into messages. No I/O.

    Args:
        rig: Name of the rig.
        name: Name of the IMU.
        clock: Monotonic to UNIX time.
    """

    def __init__(self, rig: str, name: str, clock: WallClock) -> None:
        self.key = topics.IMU.key(rig, name)
        self._encode, self._offset_ns = imu_encoder(name), clock.unix_ns(0)
        self._order = StampOrder()
        self._worst_sigma_ns: int | None = None  # None: no samples

    def message(self, sample: ImuSample) -> bytes | None:
        """Return the message of one sample; None if its stamp does not increase.

        The stamp is the instant of the measurement: the driver has subtracted wire time and filter delay.
        """
        t_host_ns = sample.t_host_ns
        if not self._order.admits(t_host_ns):  # the device clock restarted
            return None
        if self._worst_sigma_ns is None or sample.t_sigma_ns > self._worst_sigma_ns:
            self._worst_sigma_ns = sample.t_sigma_ns
        return self._encode(t_host_ns + self._offset_ns, sample.gyro_rps, sample.specific_force_mps2)

    def counters(self) -> dict[str, str]:
        """Return counters that the driver does not keep.

        The sigma of the stamps is the worst since the last call. Without samples there is none: a zero
        would say that stamps are exact, and errors of a new mapping of the clock would look like a drift.
        """
        sigma_ns, self._worst_sigma_ns = self._worst_sigma_ns, None
        counters = {"stamps_backwards": str(self._order.backwards)}
        return counters if sigma_ns is None else counters | {"stamp_sigma_us": f"{1e-3 * sigma_ns:.1f}"}


def open_imu(config: ImuConfig) -> ImuSource:
    """Open the device of the config, or play the recording that the config gives in its place (`playback`).

    Raises:
        DriverError: The device cannot be opened; one line.
    """
    if config.port.startswith(LOG_SCHEME):
        from vical_daemon.acquire.playback import LogImu

        return LogImu(config.port)
    from vical_drivers.microstrain import device

    return device.open_imu(
        config.port,
        protocol=config.protocol,
        rate_hz=config.rate_hz,
        filter_width=config.filter_samples,
        baud=config.baud,
        link=config.link,
    )


def run(
    config: Config,
    bus: Bus,
    stop: threading.Event,
    *,
    clock: WallClock | None = None,
    open_source: OpenImu = open_imu,
) -> None:
    """Acquire from every IMU of the config until `stop`.

    Args:
        config: The rig.
        bus: Where samples and status go.
        stop: Ends the role.
        clock: Monotonic to UNIX time; None: the clock that all processes of the service share.
        open_source: Opens a device; the demo uses the real driver on a pseudo terminal.
    """
    clock = clock or service_clock()

    def start(name: str, imu: ImuConfig) -> DevicePipeline[ImuSample]:
        return start_pipeline(
            f"imu/{name}", ImuEncoder(config.rig, name, clock), lambda: open_source(imu),
            bus, stop, rate_hz=imu.rate_hz, depth=QUEUE_DEPTH, direct=True,
        )  # fmt: skip

    run_pipelines(config.rig, "imu", (start(*item) for item in config.imus.items()), bus, stop, clock)
