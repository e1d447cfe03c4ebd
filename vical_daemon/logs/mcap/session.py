"""One run of the recorder: consecutive segments without a gap, each readable alone."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from vical_daemon.logs.mcap.files import LogError
from vical_daemon.logs.mcap.folder import LogFolder
from vical_daemon.logs.mcap.writer import LogWriter

_log = logging.getLogger(__name__)
FLUSH_S = 0.8  # the recorder ticks every 0.1 s, so a crash costs less than 1 s
SYNC_S = 2.0


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside the log, e.g. the config."""

    name: str
    media_type: str
    data: bytes


Metadata = Callable[[], Mapping[str, Mapping[str, str]]]
Attachments = Callable[[], list[Attachment]]


class LogSession:
    """Writes messages into segments; flushes within each second, syncs off the writing thread."""

    def __init__(
        self,
        folder: LogFolder,
        rig: str,
        now_ns: int,
        *,
        rotate_s: float,
        rotate_bytes: int,
        metadata: Metadata,
        attachments: Attachments,
    ) -> None:
        """Open the first segment.

        Args:
            folder: The folder, locked.
            rig: First part of the names.
            now_ns: UNIX time, second part of the names.
            rotate_s: A new segment after so many seconds.
            rotate_bytes: A new segment after so many bytes.
            metadata: Returns the metadata of a segment at its start.
            attachments: Returns the attachments of a segment at its end.

        Raises:
            LogError: The disk refuses.
        """
        self._folder = folder
        self._run = folder.begin_run(rig, now_ns)
        self._rotate_s, self._rotate_bytes = rotate_s, rotate_bytes
        self._metadata, self._attachments = metadata, attachments
        self._segment = 0
        self._latched: dict[str, bytes] = {}
        self.messages = 0
        self._syncing: threading.Thread | None = None
        self._writer = self._open()

    @property
    def path(self) -> Path:
        """The segment being written (its final name)."""
        return self._writer.path

    @property
    def run(self) -> str:
        """Name of the run: the segments' names without their number."""
        return self._run

    @property
    def segment_bytes(self) -> int:
        """Size of the open segment on disk."""
        return self._writer.bytes_written

    def _open(self) -> LogWriter:
        about = {name: dict(values) for name, values in self._metadata().items()}
        about.setdefault("vical", {}).update({"run": self._run, "segment": str(self._segment)})
        writer = LogWriter(self._folder.path / f"{self._run}_{self._segment:04d}.mcap", about)
        now_s = time.monotonic()
        self._opened_s, self._flushed_s, self._synced_s = now_s, now_s, now_s
        return writer

    def write(self, key: str, payload: bytes, log_time_ns: int, *, latched: bool = False) -> None:
        """Append a message.

        Args:
            key: Bus key.
            payload: CDR bytes.
            log_time_ns: When it arrived, UNIX ns.
            latched: Written again at the beginning of every segment (camera info, transforms).

        Raises:
            LogError: The disk refuses.
        """
        self._writer.write(key, payload, log_time_ns)
        if latched:
            self._latched[key] = payload
        self.messages += 1

    def tick(self, now_ns: int) -> None:
        """Flush each second, sync every few, rotate when due; call it often.

        Raises:
            LogError: The disk refuses.
        """
        now_s = time.monotonic()
        if now_s - self._flushed_s >= FLUSH_S:
            self._flushed_s = now_s
            self._writer.flush()
        if now_s - self._synced_s >= SYNC_S and (self._syncing is None or not self._syncing.is_alive()):
            self._synced_s = now_s  # a disk that takes longer gets its next one when it is done
            self._syncing = threading.Thread(target=self._writer.sync, name="log sync", daemon=True)
            self._syncing.start()
        if now_s - self._opened_s >= self._rotate_s or self.segment_bytes >= self._rotate_bytes:
            self.rotate(now_ns)

    def rotate(self, now_ns: int) -> None:
        """Start a new segment, then close the old one: messages in between are not lost.

        Raises:
            LogError: The disk refuses.
        """
        old, self._segment = self._writer, self._segment + 1
        self._writer = self._open()
        for key, payload in self._latched.items():
            self._writer.write(key, payload, now_ns)
        self._finish(old, now_ns)

    def close(self, now_ns: int) -> None:
        """Finish the last segment.

        Raises:
            LogError: The disk refuses; the part stays and is recovered at the next start.
        """
        self._finish(self._writer, now_ns)

    def _finish(self, writer: LogWriter, now_ns: int) -> None:
        try:
            for item in self._attachments():
                writer.attach(item.name, item.media_type, item.data, now_ns)
        except LogError:
            _log.warning("attachments of %s are missing", writer.path.name)
        writer.close()
