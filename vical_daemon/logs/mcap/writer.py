"""Writes MCAP logs that ROS tools open unmodified: profile ros2, CDR, ros2msg schemas, lz4, 1 MB chunks."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vical_drivers.closing import Closing

from vical_daemon.bus.messages import ros2_schema
from vical_daemon.bus.topics import parse_key
from vical_daemon.logs.mcap.files import PART_SUFFIX, LockedFile, LogError, describe

CHUNK_BYTES = 1_048_576
_ROS_TOPIC = re.compile(r"/[A-Za-z0-9_/]+")
_SDK_LOG = logging.getLogger("foxglove.log_sink_set")


def _not_of_the_file(record: logging.LogRecord) -> bool:
    """Whether a line of the SDK is news: that a write failed, with a traceback, is what `LogError` says."""
    return "McapError(Io" not in record.getMessage()


class LogWriter(Closing):
    """One MCAP file; not thread-safe but for `sync`.

    While open it is called ``NAME.mcap.part``; `close` renames it. A crash leaves the part,
    of which everything up to the last `flush` can be recovered.
    """

    def __init__(self, path: Path, metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
        """Create the file and write the metadata records first, so that a crash cannot lose them.

        Args:
            path: Final name, ``*.mcap``.
            metadata: Records (name -> text values), e.g. config hash, versions, serial numbers.

        Raises:
            LogError: The file cannot be created.
        """
        import foxglove
        from foxglove.mcap import MCAPCompression, MCAPWriteOptions

        if path.exists():
            raise LogError(f"{path} exists already; remove it or choose another name")
        self.path = path
        _SDK_LOG.addFilter(_not_of_the_file)  # once, however often
        self._file = LockedFile(path.with_name(path.name + PART_SUFFIX))
        self._context = foxglove.Context()
        options = MCAPWriteOptions(
            compression=MCAPCompression.Lz4, profile="ros2", chunk_size=CHUNK_BYTES, compression_threads=0
        )
        self._writer = foxglove.open_mcap(self._file, context=self._context, writer_options=options)
        self._channels: dict[str, Any] = {}
        self.messages = 0
        try:
            for name, values in (metadata or {}).items():
                self.add_metadata(name, values)
            self.flush()
        except LogError:
            self._writer = None
            self._file.close()
            self.part_path.unlink(missing_ok=True)
            raise

    @property
    def part_path(self) -> Path:
        """Name of the file while it is open."""
        return self._file.path

    @property
    def bytes_written(self) -> int:
        """Size of the file on disk (the open chunk not counted)."""
        return self._file.size

    def write(self, key: str, payload: bytes, log_time_ns: int, type_name: str | None = None) -> None:
        """Append one message.

        Args:
            key: Bus key, becomes the topic ``/key``.
            payload: CDR bytes.
            log_time_ns: When it was received, UNIX ns.
            type_name: ROS 2 type; None: that of the topics table.

        Raises:
            LogError: The disk refuses, or the type of this key is unknown.
        """
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._open_channel(key, type_name)
        channel.log(payload, log_time=log_time_ns)
        self.messages += 1
        if self._file.error is not None:
            self._raise()

    def _open_channel(self, key: str, type_name: str | None) -> Any:
        from foxglove import Channel, Schema

        parsed = parse_key(key)
        name = type_name or (parsed.topic.type_name if parsed else None)
        topic = "/" + key
        if name is None or not _ROS_TOPIC.fullmatch(topic):
            raise LogError(f"'{key[:200]}' is no key that can be recorded (see topics.py)")
        schema = Schema(name=name, encoding="ros2msg", data=ros2_schema(name).encode())
        return Channel(topic, schema=schema, message_encoding="cdr", context=self._context)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a metadata record."""
        self._guard(self._writer.write_metadata, name, dict(values))

    def attach(self, name: str, media_type: str, data: bytes, log_time_ns: int) -> None:
        """Append an attachment (a config or calibration file); JSON belongs here, never into a channel."""
        self._guard(
            self._writer.attach,
            log_time=log_time_ns,
            create_time=log_time_ns,
            name=name,
            media_type=media_type,
            data=data,
        )

    def flush(self) -> None:
        """Finish the open chunk: earlier messages survive a killed process.

        Raises:
            LogError: The disk refuses.
        """
        self._guard(self._writer.flush)

    def sync(self) -> None:
        """Force what was flushed to the disk (any thread; takes 20 ms and more)."""
        self._file.sync()

    def _guard(self, call: Callable[..., None], *args: Any, **kwargs: Any) -> None:
        """Call the native writer; the file has the true reason of any error."""
        try:
            call(*args, **kwargs)
        except Exception as error:
            self._file.error = self._file.error or OSError(str(error))
        if self._file.error is not None:
            self._raise()

    def _raise(self) -> None:
        error = self._file.error
        assert error is not None
        raise LogError(f"cannot write {self.part_path}: {describe(error)}")

    def close(self) -> None:
        """Write summary and footer, sync, and give the file its name; may be called twice.

        Raises:
            LogError: The disk refuses; the part stays and can be recovered.
        """
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        self._channels.clear()
        try:
            writer.close()
        except Exception as error:
            self._file.error = self._file.error or OSError(str(error))
        if self._file.error is None:
            self._file.sync()
        try:
            if self._file.error is not None:
                self._raise()
            self._file.publish(self.path.name)
        finally:
            self._file.close()
