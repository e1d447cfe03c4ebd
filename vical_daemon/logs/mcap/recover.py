"""Recovers unfinished or damaged MCAP files."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import CompressionType, Writer

from vical_daemon.logs.mcap.files import (
    PART_SUFFIX,
    LogError,
    describe,
    holds_data,
    is_being_written,
    publish,
)
from vical_daemon.logs.mcap.reader import LogChannel, LogReader
from vical_daemon.service.atomic_file import sync_folder

_TEMPORARY = ".recovering"


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of a recovery; `output` is `source` itself if nothing was missing."""

    source: Path
    output: Path
    messages: int
    warnings: tuple[str, ...]

    @property
    def was_complete(self) -> bool:
        """Whether there was nothing to recover."""
        return self.output == self.source


def recover(source: Path, output: Path | None = None, *, even_empty: bool = False) -> Recovery:
    """Rewrite every intact message, schema, metadata record and attachment into a valid file.

    A file that is complete, under its final name, is left alone: there is no copy.

    The result appears under its name only when it is complete and on the disk; a second crash in the
    middle of the recovery costs nothing.

    Args:
        source: Damaged file; not changed.
        output: Name of the result; None: ``NAME.mcap`` for ``NAME.mcap.part``, else ``NAME.recovered.mcap``.
        even_empty: Write a log without a message, too.

    Raises:
        LogError: It is still being written, is no MCAP, holds no whole message, or the disk refuses.
    """
    if is_being_written(source):
        raise LogError(f"{source} is still being written; stop the recorder first")
    reader = LogReader(source)
    output = output or recovered_name(source)
    if output.exists():
        raise LogError(f"{output} exists already; remove it or choose another name with -o")
    temporary = output.with_name(output.name + _TEMPORARY)
    try:
        count = _rewrite(reader, temporary)
        if reader.complete and not reader.warnings and not source.name.endswith(PART_SUFFIX):
            return Recovery(source, source, count, ())
        if not count and not even_empty:
            raise LogError(f"{source}: not one whole message in its {source.stat().st_size} bytes")
        publish(temporary, output)
    except OSError as error:
        problem = f"cannot write {temporary}: {describe(error)}"
        raise LogError(f"{problem}; write it elsewhere with -o") from None
    finally:
        with suppress(OSError):  # a disk that is read-only would hide the error
            temporary.unlink(missing_ok=True)
    return Recovery(source, output, count, tuple(reader.warnings))


def recovered_name(source: Path) -> Path:
    """Return the name of the result for a damaged file."""
    if source.name.endswith(PART_SUFFIX):
        return source.with_name(source.name[: -len(PART_SUFFIX)])
    return source.with_name(source.name.removesuffix(".mcap") + ".recovered.mcap")


def recover_folder(folder: Path) -> list[Recovery]:
    """Recover every part that a killed recorder left in a folder, and remove the parts.

    A part that cannot be recovered (empty, or the disk is full) stays and is tried again next time.
    """
    done = []
    for leftover in folder.glob(f"*{_TEMPORARY}"):
        leftover.unlink(missing_ok=True)
    for part in sorted(folder.glob(f"*.mcap{PART_SUFFIX}")):
        if not holds_data(part):
            continue
        output = recovered_name(part)
        try:
            if output.exists():  # died between the rename of the result and the removal of the part
                output = output.with_name(output.name.removesuffix(".mcap") + ".recovered.mcap")
            done.append(recover(part, output, even_empty=True))  # or it would be tried again for ever
        except LogError:
            continue
        part.unlink()
        sync_folder(folder)
    return done


def _rewrite(reader: LogReader, output: Path) -> int:
    """Copy everything intact into a new file; return the number of messages."""
    count = 0
    with output.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start(profile="ros2", library="vical recover")
        ids: dict[LogChannel, int] = {}
        for message in reader.messages():
            channel_id = ids.get(message.channel)
            if channel_id is None:
                channel_id = ids[message.channel] = _register(writer, message.channel)
            writer.add_message(
                channel_id=channel_id,
                log_time=message.log_time_ns,
                publish_time=message.publish_time_ns,
                sequence=message.sequence,
                data=message.payload,
            )
            count += 1
        for name, values in reader.metadata:
            writer.add_metadata(name, values)
        for item in reader.attachments:
            writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.data)
        writer.finish()  # type: ignore[no-untyped-call]
        file.flush()
        os.fsync(file.fileno())
    return count


def _register(writer: Writer, channel: LogChannel) -> int:
    schema_id = 0
    if channel.type_name:
        schema_id = writer.register_schema(
            channel.type_name, channel.schema_encoding, channel.schema.encode()
        )
    return writer.register_channel(channel.topic, channel.encoding, schema_id)
