"""Reads ROS 1 bags from front to back, without their index: also those that were cut off or never finished.

Format: wiki.ros.org/Bags/Format/2.0. Definitions of messages in the bag are not looked at.
"""

from __future__ import annotations

import bz2
import os
import struct
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from vical_drivers.user_files import open_file

from vical_daemon.bus.messages.schemas import typestore
from vical_daemon.logs.mcap.chunks import CHUNK_LIMIT, Budget, decompress_lz4

_MAGIC = b"#ROSBAG V2.0\n"
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")  # seconds and nanoseconds
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7  # op codes
_KNOWN = range(2, 8)
_HEADER_LIMIT = 2**20  # bytes; a header holds names and numbers

Item = tuple[str, str, int, memoryview]
"""Topic, type as in ROS 2, time at which it was recorded (ns), and the message."""


def ros2_type(type_name: str) -> str:
    """Return the name in ROS 2 of a type of ROS 1.

    >>> ros2_type("sensor_msgs/Imu")
    'sensor_msgs/msg/Imu'
    """
    package, _, name = type_name.rpartition("/")
    return f"{package}/msg/{name}"


def to_cdr(data: bytes | memoryview, type_name: str, types: Collection[str]) -> bytes:
    """Return a ROS 1 message as CDR (its header loses `seq`); empty if damaged, or of no type wanted."""
    if type_name not in types:
        return b""
    try:
        return bytes(typestore().ros1_to_cdr(bytes(data), type_name))
    except Exception:  # rosbags raises whatever its parsers raise on damaged messages
        return b""


class _DamageError(Exception):
    """Here are no records."""


_UNREADABLE = (_DamageError, KeyError, IndexError, struct.error, EOFError, RuntimeError)
"""What damaged records and packed data end with."""


def read_ros1_bag(path: Path, budget: Budget, warn: Callable[[str], None]) -> Iterator[Item]:
    """Yield the messages of a bag in the order in which they were recorded.

    Args:
        path: The bag.
        budget: Limits what is unpacked.
        warn: Takes what is damaged, one line each.

    Raises:
        ValueError: It is no bag; the message completes a sentence about it.
        SpentError: It unpacks to more than a recording can.
        OSError: It cannot be read.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("it does not begin like one of ROS 1, version 2.0")
        topics: dict[bytes, tuple[str, str]] = {}
        spoilt = 0
        while (begin := file.tell()) < size:
            try:
                fields, content = _next_record(file, size)
            except _UNREADABLE:
                warn(f"{path.name}: cut off or damaged after {begin / 1e6:.1f} MB; what came before is used")
                break
            try:
                if fields[b"op"][0] == _CHUNK:
                    yield from _messages(_unpacked(fields, content, budget), topics, budget)
                else:
                    yield from _message(fields, content, topics)
            except _UNREADABLE:  # the records behind it are sound
                spoilt += 1
        if spoilt:
            warn(f"{path.name}: {spoilt} damaged chunks left out")


def _next_record(file: BinaryIO, size: int) -> tuple[dict[bytes, bytes], memoryview]:
    """Return header and content of the next record of the file; the content of an index is not read."""
    fields = _fields(file.read(_length(file.read(4), _HEADER_LIMIT)))
    length = _length(file.read(4), size - file.tell())
    if fields[b"op"][0] not in _KNOWN:
        raise _DamageError
    if fields[b"op"][0] in (_MESSAGE, _CHUNK, _CONNECTION):
        return fields, memoryview(file.read(length))
    file.seek(length, os.SEEK_CUR)
    return fields, memoryview(b"")


def _messages(chunk: memoryview, topics: dict[bytes, tuple[str, str]], budget: Budget) -> Iterator[Item]:
    """Yield the messages of an unpacked chunk."""
    at, end = 0, len(chunk)
    while at < end:
        budget.spend(0)
        begin = at + 4 + _length(chunk[at : at + 4], end - at)
        fields = _fields(bytes(chunk[at + 4 : begin]))
        at = begin + 4 + _length(chunk[begin : begin + 4], end - begin)
        if at > end:
            raise _DamageError
        yield from _message(fields, chunk[begin + 4 : at], topics)


def _message(
    fields: dict[bytes, bytes], content: memoryview, topics: dict[bytes, tuple[str, str]]
) -> Iterator[Item]:
    """Yield the message of a record, if it holds one; note the topic of a connection."""
    op = fields[b"op"][0]
    if op == _CONNECTION:
        type_name = _fields(bytes(content))[b"type"].decode("utf-8", "replace")
        topics[fields[b"conn"]] = fields[b"topic"].decode("utf-8", "replace"), ros2_type(type_name)
    elif op == _MESSAGE and fields[b"conn"] in topics:  # or it was in a damaged chunk
        seconds, nanoseconds = _TIME.unpack(fields[b"time"])
        yield *topics[fields[b"conn"]], seconds * 1_000_000_000 + nanoseconds, content


def _length(data: bytes | memoryview, limit: int) -> int:
    if len(data) < 4:
        raise _DamageError
    length: int = _LENGTH.unpack(data)[0]
    if length > limit:
        raise _DamageError
    return length


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Parse `name=value` fields, each behind its length."""
    found, at = {}, 0
    while at < len(header):
        end = at + 4 + int.from_bytes(header[at : at + 4], "little")
        name, _, found_value = header[at + 4 : end].partition(b"=")
        found[name] = found_value
        at = end
    return found


def _unpacked(fields: dict[bytes, bytes], packed: memoryview, budget: Budget) -> memoryview:
    """Unpack a chunk.

    Raises:
        ValueError: It is too large, or packed in a way that is not known.
        SpentError: All chunks together are too large.
    """
    size: int = _LENGTH.unpack(fields[b"size"])[0]
    if size > CHUNK_LIMIT:
        raise ValueError(f"a chunk unpacks to more than {CHUNK_LIMIT / 1e6:.0f} MB")
    compression = fields[b"compression"]
    if compression == b"none":
        unpacked = bytes(packed)
    elif compression == b"lz4":
        unpacked = decompress_lz4(packed, size + 1)
    elif compression == b"bz2":
        try:
            unpacked = bz2.BZ2Decompressor().decompress(packed, size + 1)
        except OSError:
            raise _DamageError from None
    else:
        raise ValueError(f"its chunks are packed by {compression.decode('utf-8', 'replace')[:20]!r}")
    budget.spend(len(unpacked))
    if len(unpacked) != size:
        raise _DamageError
    return memoryview(unpacked)
