"""The loop that keeps one device streaming; used by the imu and camera roles."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, Self, TypeVar

from vical_drivers.errors import DataEndedError, DeviceReplacedError, DriverError
from vical_drivers.samples import DeviceInfo, Frame, FrameSource, SourceStats

from vical_daemon.service import notify

_log = logging.getLogger(__name__)
T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Source(Protocol[T_co]):
    """What the loop needs from a source (see `ImuSource`); `read` returns the items that arrived."""

    @property
    def info(self) -> DeviceInfo:
        """Identity of the device."""
        ...

    def read(self, timeout_s: float) -> Sequence[T_co]:
        """Return what arrived, [] after the timeout; after a `DriverError` it may be called again."""
        ...

    def stats(self) -> SourceStats:
        """Counters since it was opened."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *args: Any) -> None: ...


class FrameReader:
    """Adapts a `FrameSource` to the loop: `read` returns a list."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source

    @property
    def info(self) -> DeviceInfo:
        """See `Source.info`."""
        return self._source.info

    def read(self, timeout_s: float) -> list[Frame]:
        """See `Source.read`."""
        frame = self._source.read(timeout_s)
        return [] if frame is None else [frame]

    def stats(self) -> SourceStats:
        """See `Source.stats`."""
        return self._source.stats()

    def __enter__(self) -> Self:
        self._source.__enter__()
        return self

    def __exit__(self, *args: Any) -> None:
        self._source.__exit__(*args)


@dataclass(frozen=True, slots=True)
class DeviceHealth:
    """State of a device at one moment.

    Attributes:
        state: opening, streaming, silent (open, but nothing comes), lost, or ended (a recording, played).
        problem: One line, empty when streaming.
        info: Identity of the device; None before it was first opened.
        stats: The source's counters since the device was last opened.
        data_age_s: Since the last item; infinite before the first.
        loop_age_s: Since the loop last turned; large when the thread is stuck in the driver.
        openings: How often the device was opened.
    """

    state: str = "opening"
    problem: str = ""
    info: DeviceInfo | None = None
    stats: SourceStats = field(default_factory=SourceStats)
    data_age_s: float = float("inf")
    loop_age_s: float = 0.0
    openings: int = 0


class DeviceLoop(Generic[T]):
    """One thread per device: blocking read, delivery, and recovery without a restart.

    A source that was opened reconnects by itself; that is its contract. The loop opens the device if it was
    absent at the start, and again if it stays silent for `silence_s` or another device took its place.

    Args:
        name: For logs and the thread, e.g. ``imu/imu0``.
        open_source: Opens the device; raises `DriverError` when it cannot.
        deliver: Called with each item, in this thread; must return at once.
        stop: Ends the loop.
        flush: Called after each read, in this thread; may block if a `BackupReader` calls `read_on`.
        read_timeout_s: Longest blocking read; the loop notices `stop` this fast.
        silence_s: The device is closed and opened again after this long without data.
        first_pause_s: Before the second attempt to open.
        longest_pause_s: The pauses double up to this.
    """

    def __init__(
        self,
        name: str,
        open_source: Callable[[], AbstractContextManager[Source[T]]],
        deliver: Callable[[T], None],
        stop: threading.Event,
        *,
        flush: Callable[[], None] | None = None,
        read_timeout_s: float = 0.2,
        silence_s: float = 20.0,
        first_pause_s: float = 0.2,
        longest_pause_s: float = 1.0,
    ) -> None:
        self.name = name
        self._open_source, self._deliver, self._stop = open_source, deliver, stop
        self._flush = flush or (lambda: None)
        self._read_timeout_s, self._silence_s = read_timeout_s, silence_s
        self._first_pause_s, self._longest_pause_s = first_pause_s, longest_pause_s
        self._health = DeviceHealth()
        self._source: Source[T] | None = None
        self._broken = False  # the source raised an unexpected error: close it
        self._fails_at_once = False  # opened, it failed before any data came
        self._logged = ""  # the last problem, until there are data again
        self._turn = (
            threading.Lock()
        )  # held while reading: samples are delivered in the order in which they were read
        self._t_data_s = -float("inf")
        self._t_loop_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait for the end of the thread (after `stop`); False if it is stuck."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @property
    def openings(self) -> int:
        """How often the device was opened."""
        return self._health.openings

    def health(self) -> DeviceHealth:
        """Return the state of the device now."""
        now_s, source = time.monotonic(), self._source
        stats = source.stats() if source is not None else self._health.stats
        return replace(
            self._health, stats=stats, data_age_s=now_s - self._t_data_s, loop_age_s=now_s - self._t_loop_s
        )

    def _run(self) -> None:
        pause_s = self._first_pause_s
        while not self._stop.is_set():
            self._t_loop_s = time.monotonic()
            try:
                with self._open_source() as source:
                    self._opened(source)
                    self._fails_at_once = not self._stream()
                    if not self._fails_at_once:
                        pause_s = self._first_pause_s
            except Exception as error:  # libraries raise anything when a device is gone
                self._failed(error)
            self._pause(pause_s)
            pause_s = min(2 * pause_s, self._longest_pause_s)

    def _pause(self, pause_s: float) -> None:
        """Wait in short steps, so that a loop that waits for its device does not count as stuck."""
        end_s = time.monotonic() + pause_s
        while not self._stop.is_set() and (left_s := end_s - time.monotonic()) > 0:
            self._t_loop_s = time.monotonic()
            self._stop.wait(min(left_s, self._read_timeout_s))

    def _stream(self) -> bool:
        """Read until `stop`, or until no data came for `silence_s`; True if there were any data."""
        t_open_s = time.monotonic()
        self._broken = False
        try:
            while not self._stop.is_set():
                self.read_on()
                self._flush()
                if self._broken:
                    break
                silent_s = self._t_loop_s - max(self._t_data_s, t_open_s)
                if silent_s > self._silence_s and self._health.state != "ended":
                    self._failed(DriverError(f"no data for {self._silence_s:g} s, opening it again"))
                    break
        finally:
            with self._turn:
                self._source = None
        return self._t_data_s > t_open_s

    def read_on(self) -> None:
        """Read once and deliver; for another thread while the loop's own is held up in `flush`."""
        if self._health.state == "ended":
            self._pause(self._read_timeout_s)
            return
        with self._turn:
            source = self._source
            if source is None:  # closed while another thread waited for the lock
                return
            try:
                items = source.read(self._read_timeout_s)
            except DataEndedError as error:
                self._ended(str(error))
                items = []
            except Exception as error:  # in whatever thread this is
                # the source cannot tell what is left of it, or has closed itself
                self._broken = isinstance(error, DeviceReplacedError) or not isinstance(error, DriverError)
                self._failed(error)
                items = []
            self._t_loop_s = time.monotonic()
            if items:
                for item in items:
                    self._deliver(item)
                self._t_data_s = self._t_loop_s
                if self._health.state != "streaming":
                    self._streams(source)

    def _opened(self, source: Source[T]) -> None:
        info = source.info
        known = self._health.info
        if not (self._fails_at_once and known == info):
            _log.info("%s: open: %s %s serial %s", self.name, info.kind, info.model, info.serial_number)
        if known is not None and known.serial_number and info.serial_number not in ("", known.serial_number):
            text = (
                f"{self.name} is another device now: {info.model} serial {info.serial_number}, "
                f"not {known.model} serial {known.serial_number}"
            )
            _log.warning("%s", text)
            serials = {"serial": info.serial_number, "serial_before": known.serial_number}
            notify.event("device_replaced", text, level="warning", device=self.name, **serials)
        openings = self._health.openings + 1
        self._health = replace(self._health, state="silent", problem="", info=info, openings=openings)
        self._source = source

    def _streams(self, source: Source[T]) -> None:
        if self._health.state == "lost" or self._fails_at_once:
            self._fails_at_once = False
            _log.info("%s: back", self.name)
            notify.event("device_back", f"{self.name} is back", device=self.name)
        self._health = replace(self._health, state="streaming", problem="", info=source.info)
        self._logged = ""

    def _ended(self, text: str) -> None:
        _log.info("%s: %s", self.name, text)
        notify.event("recording_ended", f"{self.name}: {text}", device=self.name)
        self._health = replace(self._health, state="ended", problem=text)

    def _failed(self, error: Exception) -> None:
        text = str(error) if isinstance(error, DriverError) else f"{type(error).__name__}: {error}"
        problem = " ".join(text.split())
        _log.debug("%s failed", self.name, exc_info=error)
        if problem != self._logged:  # once, not at each attempt
            _log.warning("%s: %s", self.name, problem)
            if self._health.state in ("streaming", "silent"):
                notify.event("device_lost", f"{self.name}: {problem}", level="warning", device=self.name)
        self._logged = problem
        self._health = replace(self._health, state="lost", problem=problem)
