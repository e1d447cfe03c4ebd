"""What the acquiring roles have in common: devices with their threads, and a status until the end."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from vical_daemon.acquire.device_loop import DeviceLoop, Source
from vical_daemon.acquire.device_status import device_status
from vical_daemon.acquire.direct_queue import DirectOutbox, StandIn
from vical_daemon.acquire.publish_queue import Outbox
from vical_daemon.bus.interface import Bus
from vical_daemon.bus.messages import DiagnosticStatus
from vical_daemon.config.paths import make_private, runtime_directory
from vical_daemon.service.health import StatusSender
from vical_daemon.service.wall_clock import WallClock, shared_clock

JOIN_S = 3.0
T = TypeVar("T")
T_contra = TypeVar("T_contra", contravariant=True)


class MessageMaker(Protocol[T_contra]):
    """Turns what one device delivers into messages. No I/O."""

    @property
    def key(self) -> str:
        """Where they go."""
        ...

    def message(self, item: T_contra) -> bytes | None:
        """Return the message of one item; None: there is none to send."""
        ...

    def counters(self) -> dict[str, str]:
        """Return what the driver's counters do not say."""
        ...


@dataclass(frozen=True, slots=True)
class Line(Generic[T]):
    """One device on its way to the bus; make it with `start_line` or `start_direct_line`."""

    maker: MessageMaker[T]
    loop: DeviceLoop[T]
    outbox: Outbox | DirectOutbox
    rate_hz: float

    def status(self) -> DiagnosticStatus:
        """Return the status of the device."""
        loop = self.loop
        return device_status(loop.name, loop.health(), self.outbox, self.rate_hz, self.maker.counters())


def start_line(
    name: str,
    maker: MessageMaker[T],
    open_source: Callable[[], AbstractContextManager[Source[T]]],
    bus: Bus,
    stop: threading.Event,
    *,
    rate_hz: float,
    depth: int,
) -> Line[T]:
    """Start the threads of one device: blocking read -> stamp (in the driver) -> outbox -> bus.

    Args:
        name: For logs and status, e.g. ``imu/imu0``.
        maker: Makes its messages.
        open_source: Opens it.
        bus: Where the messages go.
        stop: Ends it.
        rate_hz: Nominal.
        depth: Messages that may wait for the bus.
    """
    outbox = Outbox(bus, depth, f"{name} out")
    loop = DeviceLoop(name, open_source, _delivery(maker, outbox), stop)
    loop.start()
    return Line(maker, loop, outbox, rate_hz)


def start_direct_line(
    name: str,
    maker: MessageMaker[T],
    open_source: Callable[[], AbstractContextManager[Source[T]]],
    bus: Bus,
    stop: threading.Event,
    *,
    rate_hz: float,
    depth: int,
) -> Line[T]:
    """As `start_line`, for small messages at a high rate: whoever reads publishes, see `direct_outbox`."""
    outbox = DirectOutbox(bus, depth)
    loop = DeviceLoop(name, open_source, _delivery(maker, outbox), stop, flush=outbox.flush)
    loop.start()
    StandIn(outbox, loop.read_on, stop, f"{name} stand-in").start()
    return Line(maker, loop, outbox, rate_hz)


def _delivery(maker: MessageMaker[T], outbox: Outbox | DirectOutbox) -> Callable[[T], None]:
    make, put, key = maker.message, outbox.put, maker.key

    def deliver(item: T) -> None:
        payload = make(item)
        if payload is not None:
            put(key, payload)

    return deliver


def run_lines(
    rig: str, role: str, lines: Sequence[Line[Any]], bus: Bus, stop: threading.Event, clock: WallClock
) -> None:
    """Publish the status of the devices until `stop`, then end their threads."""
    sender = StatusSender(rig, role, bus, clock)
    sender.run_until(
        stop, lambda: [line.status() for line in lines], lambda: sum(line.loop.openings for line in lines)
    )
    for line in lines:
        line.loop.join(JOIN_S)
        line.outbox.close()


def clock_of_the_service() -> WallClock:
    """Return the clock that all processes of the service share."""
    return shared_clock(make_private(runtime_directory()))
