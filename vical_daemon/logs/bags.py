"""Reads ROS 1 bags and ROS 2 bag folders through rosbags; every message comes out as ROS 2 CDR."""

from __future__ import annotations

import bz2
import io
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vical_drivers.user_files import open_file

from vical_daemon.bus.messages import (
    COMPRESSED_IMAGE_TYPE,
    IMAGE_TYPE,
    IMU_TYPE,
    POINTS_TYPE,
    TRACKS_TYPE,
)
from vical_daemon.bus.messages.schemas import typestore
from vical_daemon.config.strict_yaml import MAX_BYTES
from vical_daemon.logs.mcap.chunks import CHUNK_LIMIT, Budget, decompress_lz4
from vical_daemon.logs.model import RecordingError
from vical_daemon.logs.recorded_logs import LogRecording, RawMessage

_ROS1 = b"#ROSBAG V2.0\n"  # wiki.ros.org/Bags/Format/2.0
_RECENT_BYTES = 32 * 2**20  # 40 chunks of the usual 768 kB


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """Open a bag with rosbags; turns its errors into one line.

    Args:
        path: A ``.bag`` file of ROS 1, or a folder with ``metadata.yaml`` of ROS 2.

    Returns:
        A rosbags `AnyReader`.

    Raises:
        RecordingError: It cannot be read.
    """
    from rosbags.highlevel import AnyReader

    try:
        with (
            _bounded(Budget(_checked_size(path))),
            AnyReader([path], default_typestore=None if path.suffix == ".bag" else typestore()) as reader,
        ):
            yield reader
    except (RecordingError, GeneratorExit):
        raise
    except OSError as error:
        raise RecordingError(f"{error.filename or path}: {error.strerror or error}") from None
    except Exception as error:  # rosbags raises whatever its parsers raise on damaged files
        first = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise RecordingError(
            f"{path} cannot be read as a bag: {first[:200]}; try rosbag reindex or ros2 bag reindex"
        ) from None


def _checked_size(path: Path) -> int:
    """Return the size of a bag, bytes; refuses members that are not regular files."""
    size = 0
    for member in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not member.is_dir():
            with open_file(member, MAX_BYTES if member.name == "metadata.yaml" else None) as file:
                if member.suffix == ".bag" and file.read(len(_ROS1)) != _ROS1:
                    raise RecordingError(
                        f"{member} cannot be read as a bag: it does not begin like one of ROS 1, version 2.0"
                    )
                size += file.seek(0, io.SEEK_END)
    return size


@contextmanager
def _bounded(budget: Budget) -> Iterator[None]:
    """Replace the unpacking functions of rosbags, which have no limit, while a bag is open."""
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2

    unpackers, zstd = dict(ros1.decompressors), ros2.zstd
    ros1.decompressors["bz2"] = _RecentChunks(budget, _decompress_bz2)
    ros1.decompressors["lz4"] = _RecentChunks(
        budget, lambda data: decompress_lz4(memoryview(data), CHUNK_LIMIT)
    )
    ros2.zstd = _Zstd(zstd, budget)
    try:
        yield
    finally:
        ros1.decompressors.update(unpackers)
        ros2.zstd = zstd


def _decompress_bz2(data: bytes) -> bytes:
    unpacker = bz2.BZ2Decompressor()
    unpacked = unpacker.decompress(data, CHUNK_LIMIT)
    if not unpacker.eof:
        raise ValueError(f"a chunk is cut off or unpacks to more than {CHUNK_LIMIT / 1e6:.0f} MB")
    return unpacked


def _spend(budget: Budget, data: bytes) -> bytes:
    budget.spend(len(data))
    return data


class _RecentChunks:
    """Unpacks chunks of ROS 1; keeps the last ones, because rosbags reads by time and keeps only one.

    A recorder writes messages as they arrive, so at a chunk's end their times alternate between two chunks
    (of streams with other delays: among several).
    """

    def __init__(self, budget: Budget, unpack: Callable[[bytes], bytes]) -> None:
        self._budget, self._unpack = budget, unpack
        self._chunks: dict[bytes, bytes] = {}  # packed -> unpacked, the last used at the end

    def __call__(self, packed: bytes) -> bytes:
        data = self._chunks.pop(packed, None)
        if data is None:
            data = _spend(self._budget, self._unpack(packed))
        self._chunks[packed] = data
        while len(self._chunks) > 1 and sum(map(len, self._chunks.values())) > _RECENT_BYTES:
            del self._chunks[next(iter(self._chunks))]
        return data


class _Zstd:
    """The two functions of `compression.zstd` that rosbags uses, within a budget."""

    def __init__(self, module: Any, budget: Budget) -> None:
        self._module = module
        self._budget = budget

    def open(self, file: Any, mode: str) -> Any:
        """Open a packed file."""
        inside = self._module.open(file, mode)
        read = inside.read
        inside.read = lambda size=-1: _spend(self._budget, read(size))
        return inside

    def decompress(self, data: bytes) -> bytes:
        """Unpack one message."""
        with self._module.open(io.BytesIO(data), "rb") as file:
            unpacked: bytes = file.read(CHUNK_LIMIT + 1)
        if len(unpacked) > CHUNK_LIMIT:
            raise ValueError(f"a message unpacks to more than {CHUNK_LIMIT / 1e6:.0f} MB")
        return _spend(self._budget, unpacked)


def bag_messages(path: Path, types: Collection[str]) -> Iterator[RawMessage]:
    """Yield all messages of a bag, see `open_bag`; of ROS 1 those of some types as CDR, and others empty.

    Raises:
        RecordingError: It cannot be read.
    """
    with open_bag(path) as reader:
        for connection, log_time_ns, data in reader.messages():
            payload = bytes(data) if reader.is2 else _to_cdr(data, connection.msgtype, types)
            yield RawMessage(connection.topic, connection.msgtype, log_time_ns, payload)


class BagRecording(LogRecording):
    """A ``.bag`` file of ROS 1, or a folder with ``metadata.yaml`` of ROS 2."""

    def _raw(self) -> Iterator[RawMessage]:
        return bag_messages(self.path, _WANTED)


_WANTED = frozenset({IMU_TYPE, IMAGE_TYPE, COMPRESSED_IMAGE_TYPE, POINTS_TYPE, TRACKS_TYPE})


def _to_cdr(data: bytes, type_name: str, types: Collection[str]) -> bytes:
    """Return a ROS 1 message as CDR (its header loses `seq`); None for types that are not used."""
    if type_name not in types:
        return b""
    return bytes(typestore().ros1_to_cdr(data, type_name))
