"""Listens to a daemon that is stalled and killed: estimates and statuses with the time they came."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from pathlib import Path

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import MessageError, decode_calibration, decode_diagnostics
from vical_daemon.bus.zenoh_bus import BusError, ZenohBus, open_bus
from vical_daemon.estimation.events import Event
from vical_daemon.estimation.result import CalibrationEstimate, Status

_LOOK_S = 0.2
_LONELY_S = 1.0  # without a router for so long: connect anew


class Watcher:
    """A client of the bus that comes back when its router does.

    Args:
        socket: Of the router.
        rig: Whose estimates.
    """

    def __init__(self, socket: Path, rig: str = "rig0") -> None:
        self._socket, self._rig = socket, rig
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._estimates: list[tuple[float, CalibrationEstimate]] = []
        self._spoke_s: dict[str, float] = {}
        self._thread = threading.Thread(target=self._run, name="watcher", daemon=True)

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(10.0)

    @property
    def last(self) -> CalibrationEstimate | None:
        """The newest estimate."""
        with self._lock:
            return self._estimates[-1][1] if self._estimates else None

    def converged_since(self, t_s: float) -> tuple[float, CalibrationEstimate] | None:
        """Return the first converged estimate of images after `t_s` (CLOCK_MONOTONIC), and when it came.

        One that repeats what was known at `t_s` does not count: who estimates may have noticed nothing.
        """
        with self._lock:
            known = next((e.frames for at_s, e in reversed(self._estimates) if at_s <= t_s), -1)
            for at_s, estimate in self._estimates:
                if at_s > t_s and estimate.status is Status.CONVERGED and estimate.frames != known:
                    return at_s, estimate
            return None

    def events_since(self, t_s: float) -> list[Event]:
        """Return what was announced after `t_s`."""
        with self._lock:
            return [event for at_s, estimate in self._estimates if at_s > t_s for event in estimate.events]

    def spoke_s(self, role: str) -> float:
        """When the last status of a role came; 0: never."""
        with self._lock:
            return self._spoke_s.get(role, 0.0)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                bus = open_bus(mode="client", socket=self._socket)
            except BusError:
                self._stop.wait(_LOOK_S)
                continue
            self._listen(bus)
            bus.close()

    def _listen(self, bus: ZenohBus) -> None:
        bus.subscribe(topics.CALIBRATION.key(self._rig, "cam0"), self._on_estimate)
        bus.subscribe(topics.STATUS.pattern.format(rig=self._rig, name="*"), self._on_status)
        lonely_s = 0.0
        while lonely_s < _LONELY_S and not self._stop.wait(_LOOK_S):
            lonely_s = 0.0 if bus.connected else lonely_s + _LOOK_S

    def _on_estimate(self, sample: Sample) -> None:
        with suppress(MessageError), self._lock:
            self._estimates.append((time.monotonic(), decode_calibration(sample.payload).estimate))

    def _on_status(self, sample: Sample) -> None:
        with suppress(MessageError), self._lock:
            self._spoke_s[decode_diagnostics(sample.payload).frame_id] = time.monotonic()
