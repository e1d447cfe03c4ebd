"""Reads MCAP files that may be cut, damaged or hostile; yields every intact message.

Records are taken from front to back, never through the index, so that a file without its end reads
like any other. Nothing is believed: lengths must lie in the file, chunks must match their checksum,
no chunk may unpack to more than `chunks.CHUNK_LIMIT`, and all of them together to no more than a recording
of the file's size can (`chunks.Budget`).
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from vical_drivers.user_files import open_file

from vical_daemon.logs.mcap.chunks import Budget, SpentError, unpack_chunk
from vical_daemon.logs.mcap.files import PART_SUFFIX, LogError, describe

MAGIC = b"\x89MCAP0\r\n"
# What the parsers of the mcap package and of lz4 raise on damaged input.
_DAMAGE = (ValueError, RuntimeError, KeyError, OverflowError, EOFError, struct.error, McapError)
_OP_MESSAGE = int(Opcode.MESSAGE)
_LENGTH = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_END = struct.Struct("<BQQQI8s")  # footer and magic
_SUMMARY_LIMIT = 64 * 2**20
_RECORD_LIMIT = 2**30  # bytes; no chunk or attachment of a recording is as large


@dataclass(frozen=True, slots=True)
class LogChannel:
    """One topic of a log: ROS topic, type, encoding of messages and schema text."""

    topic: str
    type_name: str
    encoding: str
    schema: str
    schema_encoding: str


class LogMessage(NamedTuple):
    """One message of a log; `log_time_ns` is when it was received (UNIX), not its own stamp.

    A tuple because millions of them are made.
    """

    channel: LogChannel
    payload: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int


@dataclass(slots=True)
class LogReader:
    """Front-to-back reader of one file.

    Attributes:
        path: The file.
        end: Read no further than this offset: of a file that grows, each pass sees the same.
        metadata: Metadata records seen so far, (name, values) in order.
        attachments: Attachments seen so far.
        warnings: What is wrong with the file, one line each; complete after `bus/messages` has ended.
        complete: The file ended correctly; valid after `bus/messages` has ended.
        data_end: Offset after the last intact record.
    """

    path: Path
    end: int | None = None
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    complete: bool = False
    _schemas: dict[int, Schema] = field(default_factory=dict)
    _channels: dict[int, LogChannel] = field(default_factory=dict)
    _damaged: int = 0
    _budget: Budget = field(default_factory=lambda: Budget(0))

    def __post_init__(self) -> None:
        """Check that this is an MCAP file.

        Raises:
            LogError: It cannot be read, or is not an MCAP file.
        """
        try:
            with open_now(self.path) as file:
                head = file.read(len(MAGIC))
        except OSError as error:
            raise LogError(f"cannot read {self.path}: {describe(error)}") from None
        if not head:
            raise LogError(f"{self.path} is empty; was it copied in full?")
        if head != MAGIC:
            raise LogError(
                f"{self.path} is no MCAP file, whatever its name says; give a log of `vical run`, "
                "a ROS bag under its own name (.bag), or a folder"
            )

    @property
    def channels(self) -> list[LogChannel]:
        """Topics seen so far."""
        return list(self._channels.values())

    def messages(self) -> Iterator[LogMessage]:
        """Yield every intact message in the order of the file; never raises on damage (see `warnings`).

        Raises:
            LogError: The disk refuses.
        """
        self._restart()
        stopped = False
        try:
            with open_now(self.path) as file:
                size = os.fstat(file.fileno()).st_size
                size = size if self.end is None else min(size, self.end)
                self._budget = Budget(size)
                self._learn_from_summary(file, size)
                file.seek(len(MAGIC))
                yield from self._read_data(file, size)
        except OSError as error:
            raise LogError(f"cannot read {self.path}: {describe(error)}") from None
        except SpentError as error:
            stopped = True
            self.warnings.append(f"{self.path.name}: {error}")
        if self._damaged:
            pieces = "1 damaged piece" if self._damaged == 1 else f"{self._damaged} damaged pieces"
            self.warnings.append(f"{self.path.name}: {pieces} left out")
        if not self.complete and not stopped:
            self.warnings.append(f"{self.path.name}: the end is missing; what is there is used")

    def _restart(self) -> None:
        self.metadata.clear()
        self.attachments.clear()
        self.warnings.clear()
        self._schemas.clear()
        self._channels.clear()
        self.complete = False
        self._damaged = 0

    def _learn_from_summary(self, file: BinaryIO, size: int) -> None:
        """Read the topics from the summary at the end too, as their chunk may be damaged."""
        file.seek(max(0, size - _END.size))
        tail = file.read(_END.size)
        if len(tail) < _END.size or not tail.endswith(MAGIC):
            return
        opcode, length, begin, _, _, _ = _END.unpack(tail)
        if opcode != Opcode.FOOTER or length != 20 or not 0 < begin < size - _END.size:
            return
        file.seek(begin)
        summary = file.read(min(size - _END.size - begin, _SUMMARY_LIMIT))
        try:
            for _ in self._read_records(summary):
                pass
        except _DAMAGE:
            return

    def _read_data(self, file: BinaryIO, size: int) -> Iterator[LogMessage]:
        while True:
            head = file.read(_LENGTH.size)
            if len(head) < _LENGTH.size or file.tell() > size:
                return
            opcode, length = _LENGTH.unpack(head)
            if opcode == Opcode.DATA_END:
                self.complete = self._ends_well(file, size)
                return
            if length > size - file.tell():
                if opcode == Opcode.CHUNK:
                    yield from self._read_open_chunk(file.read(min(size - file.tell(), _RECORD_LIMIT)))
                return
            self._budget.spend(0)
            if length > _RECORD_LIMIT:
                self._damaged += 1
                file.seek(length, 1)
            elif opcode in (
                Opcode.CHUNK,
                Opcode.MESSAGE,
                Opcode.METADATA,
                Opcode.ATTACHMENT,
                Opcode.SCHEMA,
                Opcode.CHANNEL,
            ):
                yield from self._read_record(opcode, file.read(length))
            else:
                file.seek(length, 1)

    def _ends_well(self, file: BinaryIO, size: int) -> bool:
        file.seek(max(0, size - len(MAGIC)))
        return file.read() == MAGIC

    def _read_record(self, opcode: int, content: bytes) -> Iterator[LogMessage]:
        try:
            if opcode == Opcode.CHUNK:
                yield from self._read_records(unpack_chunk(content, self._budget))
            elif opcode == Opcode.MESSAGE:
                message = self._message(content, 0, len(content))
                if message is not None:
                    yield message
            elif opcode == Opcode.METADATA:
                record = Metadata.read(ReadDataStream(BytesIO(content)))
                self.metadata.append((record.name, record.metadata))
            elif opcode == Opcode.ATTACHMENT:
                self.attachments.append(Attachment.read(ReadDataStream(BytesIO(content))))
            else:
                self._learn(opcode, content)
        except _DAMAGE:
            self._damaged += 1

    def _read_open_chunk(self, content: bytes) -> Iterator[LogMessage]:
        """Read the messages of the chunk that was unfinished when the process died."""
        try:
            yield from self._read_records(unpack_chunk(content, self._budget, whole=False))
        except _DAMAGE:
            return

    def _read_records(self, data: bytes) -> Iterator[LogMessage]:
        position, end = 0, len(data)
        while position + _LENGTH.size <= end:
            opcode, length = _LENGTH.unpack_from(data, position)
            position += _LENGTH.size
            self._budget.spend(0)
            if length > end - position:
                return
            if opcode == _OP_MESSAGE:
                message = self._message(data, position, length)
                if message is not None:
                    yield message
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._learn(opcode, data[position : position + length])
            position += length

    def _message(self, data: bytes, begin: int, length: int) -> LogMessage | None:
        if length < _MESSAGE.size:
            return None
        channel_id, sequence, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(data, begin)
        channel = self._channels.get(channel_id)
        if channel is None:
            return None
        payload = data[begin + _MESSAGE.size : begin + length]
        return LogMessage(channel, payload, log_time_ns, publish_time_ns, sequence)

    def _learn(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
            return
        channel = Channel.read(stream)
        known = self._schemas.get(channel.schema_id)
        name, encoding = (known.name, known.encoding) if known else ("", "")
        text = known.data.decode("utf-8", "replace") if known else ""
        self._channels[channel.id] = LogChannel(channel.topic, name, channel.message_encoding, text, encoding)


def open_now(path: Path) -> BinaryIO:
    """Open a file; a part that its recorder has finished meanwhile, under its final name.

    Raises:
        OSError: It cannot be read.
    """
    try:
        return open_file(path)
    except FileNotFoundError:
        finished = path.with_suffix("")
        if path.suffix != PART_SUFFIX or not finished.exists():
            raise
        return open_file(finished)


def size_now(path: Path) -> int:
    """Return the size of a file as `open_now` opens it; 0: it is gone, or another kind of file."""
    try:
        with open_now(path) as file:
            return os.fstat(file.fileno()).st_size
    except OSError:
        return 0


def segments_in(folder: Path) -> list[Path]:
    """Return the MCAP files of a folder in the order of their first messages, also an unfinished one.

    Names do not tell the order: ROS 2 calls the segments of a bag _0, _1, ... _10.
    """
    parts = list(folder.glob(f"*.mcap{PART_SUFFIX}"))  # first: one that is finished now is then found twice
    finished = list(folder.glob("*.mcap"))
    begun = [part for part in parts if part.with_suffix("") not in finished and size_now(part)]
    return sorted(finished + begun, key=lambda path: (_begin_ns(path), path.name))


def _begin_ns(path: Path) -> int:
    try:
        return next((message.log_time_ns for message in LogReader(path).messages()), 0)
    except LogError:
        return 0  # whoever reads it reports the error
