"""Role imu: one thread per IMU, blocking read -> stamp (in the driver) -> outbox -> bus."""

from __future__ import annotations

import threading
from collections.abc import Callable

from vical_drivers.samples import ImuSample, ImuSource

from vical_daemon import topics
from vical_daemon.bus import Bus
from vical_daemon.config import Config, ImuConfig
from vical_daemon.device_loop import DeviceLoop
from vical_daemon.health import StatusSender, device_status
from vical_daemon.messages import DiagnosticStatus, encode_imu
from vical_daemon.outbox import Outbox
from vical_daemon.places import make_private, runtime_directory
from vical_daemon.wall_clock import WallClock, shared_clock

QUEUE_DEPTH = 8192  # 8 s at 1000 Hz
JOIN_S = 3.0

OpenImu = Callable[[ImuConfig], ImuSource]


class ImuRole:
    """Turns the samples of one IMU into messages. No I/O.

    Args:
        rig: Name of the rig.
        name: Name of the IMU.
        clock: Monotonic to UNIX time.
    """

    def __init__(self, rig: str, name: str, clock: WallClock) -> None:
        self.key = topics.imu_key(rig, name)
        self._name, self._clock = name, clock
        self._t_last_ns = 0
        self._backwards = 0
        self._worst_sigma_ns = 0

    def message(self, sample: ImuSample) -> bytes | None:
        """Return the message of one sample; None if its stamp does not follow the one before.

        The stamp is that of the measurement: wire time and filter delay were taken off by the driver.
        """
        if sample.t_host_ns <= self._t_last_ns:  # the device clock restarted: wait until time goes on
            self._backwards += 1
            return None
        self._t_last_ns = sample.t_host_ns
        self._worst_sigma_ns = max(self._worst_sigma_ns, sample.t_sigma_ns)
        stamp_ns = self._clock.unix_ns(sample.t_host_ns)
        return encode_imu(stamp_ns, self._name, sample.gyro_rps, sample.specific_force_mps2)

    def counters(self) -> dict[str, str]:
        """Return what the driver's counters do not say; the worst sigma is that since the last call."""
        sigma_us, self._worst_sigma_ns = self._worst_sigma_ns * 1e-3, 0
        return {"stamps_backwards": str(self._backwards), "stamp_sigma_us": f"{sigma_us:.1f}"}


def open_imu(config: ImuConfig) -> ImuSource:
    """Open the device that the config names.

    Raises:
        DriverError: It cannot be opened; one line.
    """
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
        clock: Monotonic to UNIX time; None: the one that all processes of the service share.
        open_source: Opens a device (the demo's is the real one, on a pseudo terminal).
    """
    clock = clock or shared_clock(make_private(runtime_directory()))
    devices = [_start(config, name, bus, stop, clock, open_source) for name in config.imus]

    def statuses() -> list[DiagnosticStatus]:
        return [
            device_status(loop.name, loop.health(), outbox, config.imus[name].rate_hz, role.counters())
            for name, role, loop, outbox in devices
        ]

    StatusSender(config.rig, "imu", bus, clock).run_until(stop, statuses)
    for _, _, loop, outbox in devices:
        loop.join(JOIN_S)
        outbox.close()


def _start(
    config: Config, name: str, bus: Bus, stop: threading.Event, clock: WallClock, open_source: OpenImu
) -> tuple[str, ImuRole, DeviceLoop[ImuSample], Outbox]:
    role = ImuRole(config.rig, name, clock)
    outbox = Outbox(bus, QUEUE_DEPTH, f"imu/{name} out", inline=True)

    def deliver(sample: ImuSample) -> None:
        payload = role.message(sample)
        if payload is not None:
            outbox.put(role.key, payload)

    loop = DeviceLoop(f"imu/{name}", lambda: open_source(config.imus[name]), deliver, stop)
    loop.start()
    return name, role, loop, outbox
