"""Python API for other programs: the current calibration of a robot, its updates, and its convergence.

>>> from vical_daemon import client                                    # doctest: +SKIP
>>> with client.connect() as robot:                                    # doctest: +SKIP
...     update = robot.wait_converged(timeout_s=120)
...     print(update.camera, update.known.T_imu_cam.p_m)
"""

from __future__ import annotations

import asyncio
import queue
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from vical_drivers.closing import Closing

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, Sample, Subscription
from vical_daemon.bus.messages import MessageError, admit_calibration
from vical_daemon.bus.topics import parse_key
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, Status
from vical_daemon.estimation.wording import event_text

_DEPTH = 256


class ClientError(Exception):
    """A request failed or timed out; the message is one line for the user."""


@dataclass(frozen=True, slots=True)
class Update:
    """One estimate of one camera.

    Attributes:
        rig: Name of the robot.
        camera: Name of the camera.
        estimate: The complete estimate, of this camera alone.
    """

    rig: str
    camera: str
    estimate: CalibrationEstimate

    @property
    def known(self) -> CameraEstimate:
        """The calibration of the camera.

        Raises:
            ClientError: There is no solution yet.
        """
        known = self.estimate.cameras.get(self.camera)
        if known is None:
            raise ClientError(
                f"{self.camera} is {self.estimate.status}: {self.estimate.reason or 'no solution yet'}"
            )
        return known

    @property
    def announcements(self) -> list[str]:
        """The events since the last estimate, as text; as data: `estimate.events`."""
        return [event_text(event) for event in self.estimate.events]

    @property
    def converged(self) -> bool:
        """Whether the calibration has converged."""
        return self.estimate.status is Status.CONVERGED and self.camera in self.estimate.cameras


class Client(Closing):
    """The calibrations on a bus, for threads; made by `connect`."""

    def __init__(self, bus: Bus, rig: str = "*", *, owns_bus: bool = True) -> None:
        """Wrap a bus.

        Args:
            bus: An open bus.
            rig: Name of the robot, or ``*`` for all.
            owns_bus: `close` closes it.
        """
        self._bus = bus
        self._rig = rig if rig == "*" else topics.check_name(rig)
        self._owns_bus = owns_bus

    def latest(self, camera: str = "*", timeout_s: float = 1.0) -> list[Update]:
        """Return the last estimate of each camera (of one); [] if there is no estimator.

        Args:
            camera: Name of a camera, or ``*``.
            timeout_s: How long to wait for answers.
        """
        samples = self._bus.latest(self._expression(camera), timeout_s)
        return [update for sample in samples if (update := _read(sample)) is not None]

    def subscribe(self, callback: Callable[[Update], None], camera: str = "*") -> Subscription:
        """Call back for every estimate, starting with the last one published.

        Args:
            callback: Called in a thread of the bus; keep it short.
            camera: Name of a camera, or ``*``.

        Returns:
            The subscription; close it to stop.
        """

        def handler(sample: Sample) -> None:
            update = _read(sample)
            if update is not None:
                callback(update)

        subscription = self._bus.subscribe(self._expression(camera), handler)
        for update in self.latest(camera):
            callback(update)
        return subscription

    def updates(self, camera: str = "*", timeout_s: float | None = None) -> Iterator[Update]:
        """Yield estimates, starting with the last one, until none has come for `timeout_s`."""
        waiting: queue.Queue[Update] = queue.Queue(_DEPTH)

        def keep(update: Update) -> None:
            if waiting.full():  # a slow reader skips to the newest
                with suppress(queue.Empty):
                    waiting.get_nowait()
            with suppress(queue.Full):
                waiting.put_nowait(update)

        subscription = self.subscribe(keep, camera)
        try:
            while True:
                try:
                    yield waiting.get(timeout=timeout_s)
                except queue.Empty:
                    return
        finally:
            subscription.close()

    def wait_converged(self, timeout_s: float | None = None, camera: str = "*") -> Update:
        """Return the first estimate that has converged.

        Args:
            timeout_s: Give up after so long; None: never.
            camera: Name of a camera, or ``*`` for whichever is first.

        Raises:
            ClientError: None in that time; the message says where it stands.
        """
        end_s = float("inf") if timeout_s is None else time.monotonic() + timeout_s
        last: Update | None = None
        while (left_s := end_s - time.monotonic()) > 0:
            for update in self.updates(camera, min(left_s, 1.0)):
                last = update
                if update.converged:
                    return update
                if time.monotonic() > end_s:
                    break
        raise ClientError(_why_not(last, timeout_s))

    def _expression(self, camera: str) -> str:
        name = camera if camera == "*" else topics.check_name(camera)
        return topics.CALIBRATION.pattern.format(rig=self._rig, name=name)

    def close(self) -> None:
        """Close the connection; may be called twice."""
        if self._owns_bus:
            self._bus.close()


class AsyncClient:
    """The same for asyncio; made by `connect_async`."""

    def __init__(self, client: Client) -> None:
        self._client = client

    async def latest(self, camera: str = "*", timeout_s: float = 1.0) -> list[Update]:
        """See `Client.latest`."""
        return await asyncio.to_thread(self._client.latest, camera, timeout_s)

    async def updates(self, camera: str = "*") -> AsyncIterator[Update]:
        """Yield estimates, starting with the last one; a slow reader skips to the newest."""
        loop = asyncio.get_running_loop()
        waiting: asyncio.Queue[Update] = asyncio.Queue(_DEPTH)

        def keep(update: Update) -> None:
            if waiting.full():
                waiting.get_nowait()
            waiting.put_nowait(update)

        def hand_over(update: Update) -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(keep, update)

        subscription = await asyncio.to_thread(self._client.subscribe, hand_over, camera)
        try:
            while True:
                yield await waiting.get()
        finally:
            subscription.close()

    async def wait_converged(self, timeout_s: float | None = None, camera: str = "*") -> Update:
        """See `Client.wait_converged`."""
        last: Update | None = None
        updates = self.updates(camera)
        try:
            async with asyncio.timeout(timeout_s):
                async for update in updates:
                    last = update
                    if update.converged:
                        return update
        except TimeoutError:
            pass  # the last update gives the reason, below
        finally:
            await updates.aclose()  # type: ignore[attr-defined]
        raise ClientError(_why_not(last, timeout_s))

    async def close(self) -> None:
        """Close the connection; may be called twice."""
        await asyncio.to_thread(self._client.close)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()


def connect(
    endpoint: str | None = None, *, rig: str = "*", socket: Path | str | None = None, **security: Any
) -> Client:
    """Connect to the bus of a robot, or to the router of a site.

    Args:
        endpoint: zenoh endpoint, e.g. ``tls/robot7:7447``; None: the bus of this computer.
        rig: Name of the robot, or ``*`` for all that are heard.
        socket: Unix socket of a router on this computer instead, in an unusual place.
        **security: As in `zenoh_bus.open_bus`: ``tls_ca``, ``tls_certificate``, ``tls_key``, ``user``,
            ``password``.

    Raises:
        BusError: Nobody there, or not admitted.
    """
    from vical_daemon.bus.local_bus import open_local_bus
    from vical_daemon.bus.zenoh_bus import open_bus

    if endpoint:
        return Client(open_bus(mode="client", connect=[endpoint], **security), rig)
    return Client(open_local_bus([Path(socket)] if socket else [], **security), rig)


async def connect_async(
    endpoint: str | None = None, *, rig: str = "*", socket: Path | str | None = None, **security: Any
) -> AsyncClient:
    """Connect from asyncio; see `connect`."""
    return AsyncClient(await asyncio.to_thread(connect, endpoint, rig=rig, socket=socket, **security))


def _read(sample: Sample) -> Update | None:
    """Return the update in a sample; None if it is malformed."""
    parsed = parse_key(sample.key)
    if parsed is None or parsed.topic is not topics.CALIBRATION:
        return None
    try:
        message = admit_calibration(sample.payload)
    except MessageError:
        return None
    return Update(parsed.rig, message.camera, message.estimate)


def _why_not(last: Update | None, timeout_s: float | None) -> str:
    if last is None:
        return f"no calibration heard within {timeout_s} s; is `vical run` (vical-calibrate) up?"
    estimate = last.estimate
    hint = estimate.guidance or estimate.reason
    stands = f"{estimate.status}: {hint}" if hint else str(estimate.status)
    return f"{last.camera} has not converged within {timeout_s} s: {stands}"
