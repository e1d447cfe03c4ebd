"""Reads bags of ROS 1 and ROS 2; every message comes out as ROS 2 CDR. rosbags reads packed ones of ROS 2."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vical_drivers.user_files import open_file, read_text

from vical_daemon.config.strict_yaml import MAX_BYTES
from vical_daemon.logs.db3 import read_db3
from vical_daemon.logs.mcap.chunks import CHUNK_LIMIT, Budget
from vical_daemon.logs.model import RecordingError
from vical_daemon.logs.recorded_logs import SENSOR_TYPES, LogRecording, RawMessage
from vical_daemon.logs.ros1_bag import read_ros1_bag, to_cdr

PACKED = re.compile(r"^\s*compression_mode:\s*['\"]?(message|file)", re.IGNORECASE | re.MULTILINE)
_LISTED = re.compile(r"^\s*- (\S+\.db3)\s*$", re.MULTILINE)


def _nowhere(line: str) -> None:
    """Take a warning, and do nothing."""


def is_bag(path: Path) -> bool:
    """Whether this is what `bag_messages` reads: a file of ROS 1, or a folder or a ``.db3`` file of ROS 2."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or any(path.glob("*.db3"))
    return path.is_file() and path.name.endswith((".bag", ".bag.active", ".db3"))


def bag_messages(
    path: Path, types: Collection[str], warn: Callable[[str], None] = _nowhere
) -> Iterator[RawMessage]:
    """Yield all messages of a bag, of ROS 1 those of some types as CDR, and others empty.

    Args:
        path: See `is_bag`.
        types: Of which the content is wanted.
        warn: Takes what is damaged, one line each.

    Raises:
        RecordingError: It cannot be read.
    """
    try:
        budget = Budget(_checked_size(path))
        if path.is_file() and path.suffix != ".db3":
            for topic, type_name, time_ns, data in read_ros1_bag(path, budget, warn):
                yield RawMessage(topic, type_name, time_ns, to_cdr(data, type_name, types))
        elif path.is_file() or (plain := _plain_files(path, warn)):
            for item in read_db3([path] if path.is_file() else plain, budget, warn):
                yield RawMessage(*item)
        else:
            yield from _packed(path, budget)
    except (RecordingError, GeneratorExit):
        raise
    except OSError as error:
        raise RecordingError(f"{error.filename or path}: {error.strerror or error}") from None
    except Exception as error:  # rosbags raises whatever its parsers raise on damaged files
        first = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise RecordingError(f"{path} cannot be read as a bag: {first[:200]}") from None


def _plain_files(folder: Path, warn: Callable[[str], None]) -> list[Path]:
    """Return the ``.db3`` files of a bag of ROS 2 whose messages are not packed."""
    files = sorted(folder.glob("*.db3"))
    try:
        text = read_text(folder / "metadata.yaml", MAX_BYTES)
    except (OSError, UnicodeDecodeError):
        return files
    if PACKED.search(text):
        return []
    names = {Path(name).name for name in _LISTED.findall(text)}
    missing = sorted(names - {file.name for file in files}) if len(names) != len(files) else []
    if files and missing:
        warn(f"{folder}: {', '.join(missing)} of its metadata.yaml is not there")
    return files


def _packed(folder: Path, budget: Budget) -> Iterator[RawMessage]:
    """Yield the messages of a bag of ROS 2 that is packed."""
    from rosbags.rosbag2 import Reader

    with _bounded(budget), Reader(folder) as reader:
        for connection, time_ns, data in reader.messages():
            yield RawMessage(connection.topic, connection.msgtype, time_ns, bytes(data))


def _checked_size(path: Path) -> int:
    """Return the size of a bag, bytes; refuses members that are not regular files."""
    size = 0
    for member in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not member.is_dir():
            with open_file(member, MAX_BYTES if member.name == "metadata.yaml" else None) as file:
                size += file.seek(0, io.SEEK_END)
    return size


@contextmanager
def _bounded(budget: Budget) -> Iterator[None]:
    """Replace the unpacking functions of rosbags, which have no limit, while a bag is open."""
    from rosbags.rosbag2 import reader as ros2

    zstd = ros2.zstd
    ros2.zstd = _Zstd(zstd, budget)
    try:
        yield
    finally:
        ros2.zstd = zstd


def _spend(budget: Budget, data: bytes) -> bytes:
    budget.spend(len(data))
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


class BagRecording(LogRecording):
    """A bag of ROS 1 or ROS 2, see `is_bag`."""

    def _raw(self) -> Iterator[RawMessage]:
        return bag_messages(self.path, SENSOR_TYPES, _nowhere if self._scanned else self.warnings.append)
