"""What the acquiring roles have in common: one pipeline per device, and their status until the role ends."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from vical_daemon.acquire.device_loop import DeviceLoop, Source
from vical_daemon.acquire.device_status import device_status
from vical_daemon.acquire.direct_queue import BackupReader, DirectQueue
from vical_daemon.acquire.publish_queue import PublishQueue
from vical_daemon.bus.interface import Bus
from vical_daemon.bus.messages import DiagnosticStatus
from vical_daemon.service.health import StatusSender
from vical_daemon.service.wall_clock import WallClock

JOIN_S = 3.0
SET_BACK_NS = 1_000_000_000
"""A stamp that lies further behind the last one is no disorder of a driver: a clock was set back, or the last
stamp was wrong. Without this limit one stamp of tomorrow would hold a device back until tomorrow."""
T = TypeVar("T")
T_contra = TypeVar("T_contra", contravariant=True)


class MessageEncoder(Protocol[T_contra]):
    """Turns the items of one device into messages. No I/O."""

    @property
    def key(self) -> str:
        """Bus key of the messages."""
        ...

    def message(self, item: T_contra) -> bytes | None:
        """Return the message of one item, or None if the item must not be sent."""
        ...

    def counters(self) -> dict[str, str]:
        """Return counters that the driver does not keep."""
        ...


class StampOrder:
    """Holds back the items of a device whose stamps do not increase.

    Attributes:
        backwards: How many stamps did not increase.
    """

    __slots__ = ("_last_ns", "backwards")

    def __init__(self) -> None:
        self._last_ns = -SET_BACK_NS
        self.backwards = 0

    def admits(self, stamp_ns: int) -> bool:
        """Whether an item with this stamp may pass; a clock that was set back passes."""
        if stamp_ns <= self._last_ns:
            self.backwards += 1
            if self._last_ns - stamp_ns < SET_BACK_NS:
                return False
        self._last_ns = stamp_ns
        return True


@dataclass(frozen=True, slots=True)
class DevicePipeline(Generic[T]):
    """The running threads of one device, from the device to the bus; see `start_pipeline`."""

    encoder: MessageEncoder[T]
    loop: DeviceLoop[T]
    queue: PublishQueue | DirectQueue
    rate_hz: float

    def status(self) -> DiagnosticStatus:
        """Return the status of the device."""
        loop = self.loop
        return device_status(loop.name, loop.health(), self.queue, self.rate_hz, self.encoder.counters())


def start_pipeline(
    name: str,
    encoder: MessageEncoder[T],
    open_source: Callable[[], AbstractContextManager[Source[T]]],
    bus: Bus,
    stop: threading.Event,
    *,
    rate_hz: float,
    depth: int,
    direct: bool = False,
) -> DevicePipeline[T]:
    """Start the threads of one device: blocking read -> stamp (in the driver) -> queue -> bus.

    Args:
        name: For logs and status, e.g. ``imu/imu0``.
        encoder: Makes the messages.
        open_source: Opens the device.
        bus: Where the messages go.
        stop: Ends the threads.
        rate_hz: Nominal rate.
        depth: Messages that may wait for the bus.
        direct: Publish in the reading thread, see `direct_queue`; for small messages at a high rate.
    """
    queue: PublishQueue | DirectQueue
    if direct:
        queue = DirectQueue(bus, depth)
        loop = DeviceLoop(name, open_source, _delivery(encoder, queue), stop, flush=queue.flush)
        BackupReader(queue, loop.read_on, stop, f"{name} backup").start()
    else:
        queue = PublishQueue(bus, depth, f"{name} out")
        loop = DeviceLoop(name, open_source, _delivery(encoder, queue), stop)
    loop.start()
    return DevicePipeline(encoder, loop, queue, rate_hz)


def _delivery(encoder: MessageEncoder[T], queue: PublishQueue | DirectQueue) -> Callable[[T], None]:
    encode, put, key = encoder.message, queue.put, encoder.key

    def deliver(item: T) -> None:
        payload = encode(item)
        if payload is not None:
            put(key, payload)

    return deliver


def run_pipelines(
    rig: str,
    role: str,
    pipelines: Iterable[DevicePipeline[Any]],
    bus: Bus,
    stop: threading.Event,
    clock: WallClock,
) -> None:
    """Publish the status of the devices until `stop`, then end their threads."""
    running = list(pipelines)
    StatusSender(rig, role, bus, clock).run_until(
        stop, lambda: [p.status() for p in running], lambda: sum(p.loop.openings for p in running)
    )
    for pipeline in running:
        pipeline.loop.join(JOIN_S)
        pipeline.queue.close()
