"""Plays a recording in place of devices: `port: log:FILE` and `uri: log:FILE` of the settings.

Samples come when their time has come, with stamps of now on CLOCK_MONOTONIC. All devices of one recording
share one time base, so that the time shift between them is the recorded one. The recording is played once:
the same data once more would be counted as new ones, and make sigmas small that are not.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from vical_drivers.camera.statistics import FrameStatistics
from vical_drivers.closing import Closing
from vical_drivers.errors import DataEndedError, DeviceLostError, DeviceNotFoundError, DeviceRefusedError
from vical_drivers.samples import DeviceInfo, Frame, ImuSample, SourceStats

from vical_daemon.bus.messages import (
    MessageError,
    admit_stamp_sigma_s,
    decode_compressed_image,
    decode_diagnostics,
    decode_image,
    decode_imu,
)
from vical_daemon.bus.topics import STATUS
from vical_daemon.config.model import LOG_SCHEME
from vical_daemon.logs import Recording, RecordingError, Stream, open_recording, unfit_imus
from vical_daemon.logs.channel import stamp_of

_log = logging.getLogger(__name__)

_IMU_KINDS = ("imu",)
_IMAGE_KINDS = ("image", "compressed")
_MOST_SAMPLES = 1000  # per read; after a delay of the process, the next read returns the rest
_playbacks: dict[Path, _Playback] = {}
_playbacks_lock = threading.Lock()


class _Playback:
    """The playback of one recording; it starts when the first of its devices is read."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self._begin_ns = recording.begin_ns
        self._t_start_ns: int | None = None
        self._lock = threading.Lock()

    def items(self, stream: Stream) -> Iterator[tuple[int, str, bytes]]:
        """Yield (stamp on CLOCK_MONOTONIC in ns, key, message) of a stream, and of the status of its role.

        A later call joins at the present position of the recording.
        """
        also = [STATUS.key(self.recording.rig, "imu")] if stream.kind == "imu" else []
        now_ns = time.monotonic_ns()
        with self._lock:
            if self._t_start_ns is None:
                self._t_start_ns = now_ns
            offset_ns = self._t_start_ns - self._begin_ns
        for key, payload in self.recording.messages([stream], also):
            stamp_ns = stamp_of(payload)
            if stamp_ns is not None and stamp_ns + offset_ns >= now_ns:
                yield stamp_ns + offset_ns, key, payload


class _LogDevice(Closing):
    """Base of the played IMU and camera.

    Args:
        uri: ``log:FILE``, or ``log:FILE#NAME`` if the recording has several such devices.
        kinds: Accepted kinds of streams.
        what: imu or camera.

    Raises:
        DeviceNotFoundError: There is no such recording, or no such device in it.
        DeviceRefusedError: The recording has several, and the URI names none.
    """

    def __init__(self, uri: str, kinds: tuple[str, ...], what: str) -> None:
        path, _, name = uri.removeprefix(LOG_SCHEME).partition("#")
        self._playback = _playback_of(Path(path))
        self._stream = _choose(self._playback.recording, kinds, what, name)
        self.info = DeviceInfo(
            kind=what,
            model="recording",
            serial_number=f"log-{Path(path).stem}-{self._stream.name}",
            path=uri,
            protocol="log",
            details={"rate_hz": f"{self._stream.rate_hz:.3f}", "topic": self._stream.source},
        )
        self._statistics = FrameStatistics()
        self._items: Iterator[tuple[int, str, bytes]] | None = None
        self._next: tuple[int, str, bytes] | None = None

    def _due(self, end_ns: int) -> tuple[int, bytes] | None:
        """Wait for the next message until `end_ns` (CLOCK_MONOTONIC); returns its stamp and the message.

        Raises:
            DataEndedError: That was the last one.
            DeviceLostError: The recording cannot be read.
        """
        if self._items is None:
            self._items = self._playback.items(self._stream)
        if self._next is None:
            try:
                self._next = self._next_of_stream(self._items)
            except RecordingError as error:
                self._items = None  # the next read starts again
                raise DeviceLostError(str(error)) from None
            except StopIteration:
                recording = self._playback.recording
                ended = (
                    f"{recording.path} has ended after {recording.duration_s:.1f} s; start again to replay it"
                )
                raise DataEndedError(ended) from None
        t_host_ns, _, payload = self._next
        _sleep_until(min(t_host_ns, end_ns))
        if t_host_ns > end_ns:
            return None
        self._next = None
        self._statistics.add(t_host_ns, 0)
        return t_host_ns, payload

    def _next_of_stream(self, items: Iterator[tuple[int, str, bytes]]) -> tuple[int, str, bytes]:
        """Return the next message of the stream; statuses before it are noted."""
        while (item := next(items))[1] != self._stream.key:
            self._note_status(item[2])
        return item

    def _note_status(self, payload: bytes) -> None:
        """Take what the role of the device said of it when this was recorded."""

    def stats(self) -> SourceStats:
        """Counters since it was opened."""
        return self._statistics.snapshot()

    def close(self) -> None:
        """Stop this device; the recording continues for the others."""
        self._items = self._next = None


class LogImu(_LogDevice):
    """An `ImuSource`: the inertial samples of a recording, known to what the driver said of its stamps."""

    def __init__(self, uri: str) -> None:
        super().__init__(uri, _IMU_KINDS, "imu")
        self._sigma_ns = 0

    def _note_status(self, payload: bytes) -> None:
        with suppress(MessageError):
            for status in decode_diagnostics(payload).statuses:
                said_us = status.values.get("stamp_sigma_us")
                if status.name == f"imu/{self._stream.name}" and said_us is not None:
                    self._sigma_ns = round(1e9 * admit_stamp_sigma_s(said_us))

    def read(self, timeout_s: float) -> list[ImuSample]:
        """See `ImuSource.read`."""
        end_ns = time.monotonic_ns() + round(max(0.0, timeout_s) * 1e9)
        samples: list[ImuSample] = []
        while len(samples) < _MOST_SAMPLES:
            try:
                item = self._due(end_ns)
            except DataEndedError:
                if samples:
                    break  # the next call says it
                raise
            if item is None:
                break
            t_host_ns, payload = item
            end_ns = time.monotonic_ns()  # return what is due by now; do not wait for more
            try:
                message = decode_imu(payload)
            except MessageError:
                self._statistics.count("unreadable")
                continue
            samples.append(
                ImuSample(
                    t_host_ns,
                    end_ns,
                    message.stamp_ns // 1000,
                    message.gyro_rps,
                    message.specific_force_mps2,
                    t_sigma_ns=self._sigma_ns,
                )
            )
        return samples


class LogCamera(_LogDevice):
    """A `FrameSource`: the images of a recording."""

    def __init__(self, uri: str) -> None:
        super().__init__(uri, _IMAGE_KINDS, "camera")
        self._sequence = self._missing = 0

    def read(self, timeout_s: float) -> Frame | None:
        """See `FrameSource.read`."""
        item = self._due(time.monotonic_ns() + round(max(0.0, timeout_s) * 1e9))
        if item is None:
            return None
        t_host_ns, payload = item
        self._sequence += 1
        try:
            pixels, encoding = self._pixels(payload)
        except (MessageError, ValueError):
            self._statistics.count("unreadable")
            self._missing += 1
            return None
        missing, self._missing = self._missing, 0
        return Frame(
            t_exposure_mid_ns=t_host_ns,
            t_arrival_ns=time.monotonic_ns(),
            sequence=self._sequence - 1,
            image=pixels,
            encoding=encoding,
            stamp_rule="recorded",
            dropped_before=missing,
        )

    def _pixels(self, payload: bytes) -> tuple[npt.NDArray[Any], str]:
        if self._stream.kind == "compressed":
            from vical_daemon.vision import image_codec

            data = np.frombuffer(decode_compressed_image(payload).data, np.uint8)
            return image_codec.decode_image(data), "mono8"
        image = decode_image(payload)
        return image.pixels(), image.encoding


def _playback_of(path: Path) -> _Playback:
    """Open a recording, once in this process."""
    key = path.absolute()
    with _playbacks_lock:
        if key not in _playbacks:
            try:
                recording = open_recording(key, check=False, as_recorded=True)
            except RecordingError as error:
                raise DeviceNotFoundError(str(error)) from None
            for text in unfit_imus(recording):
                _log.warning("%s: %s", path, text)
            _playbacks[key] = _Playback(recording)
        return _playbacks[key]


def _choose(recording: Recording, kinds: tuple[str, ...], what: str, name: str) -> Stream:
    found = {stream.name: stream for stream in recording.streams if stream.kind in kinds}
    if not found:
        also = "; of points alone, `vical replay` plays them" if what == "camera" else ""
        raise DeviceNotFoundError(f"{recording.path}: no {' or '.join(kinds)} messages in it{also}")
    names = ", ".join(found)
    if name and name not in found:
        raise DeviceNotFoundError(f"{recording.path}: no {what} {name!r} in it (there: {names})")
    if not name and len(found) > 1:
        raise DeviceRefusedError(
            f"{recording.path} holds several: write log:{recording.path.name}#NAME with one of {names}"
        )
    return found[name] if name else next(iter(found.values()))


def _sleep_until(t_host_ns: int) -> None:
    time.sleep(max(0, t_host_ns - time.monotonic_ns()) * 1e-9)
