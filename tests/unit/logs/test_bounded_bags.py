"""What bags unpack to has a bound, and the functions of rosbags are back when the bag is closed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.rosbag2 import reader as ros2
from rosbags.typesys import Stores, get_typestore

from vical_daemon.logs import RecordingError, bags, ros1_bag
from vical_daemon.logs.mcap.chunks import Budget

SIZE = 200_000  # bytes of the one message


def write(folder: Path, kind: str) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC if kind in ("bz2", "lz4") else Stores.LATEST)
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    name = "std_msgs/msg/UInt8MultiArray"
    message = store.types[name](layout=layout, data=np.zeros(SIZE, np.uint8))
    if kind in ("bz2", "lz4"):
        path = folder / "a.bag"
        writer1 = Ros1Writer(path)
        writer1.set_compression(Ros1Writer.CompressionFormat[kind.upper()])
        with writer1:
            connection1 = writer1.add_connection("/a", name, typestore=store)
            writer1.write(connection1, 1, store.serialize_ros1(message, name))
        return path
    path = folder / "a"
    writer2 = Ros2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer2.set_compression(CompressionMode[kind.upper()], CompressionFormat.ZSTD)
    with writer2:
        connection2 = writer2.add_connection("/a", name, typestore=store)
        writer2.write(connection2, 1, store.serialize_cdr(message, name))
    return path


def read(path: Path) -> int:
    return sum(len(message.payload) for message in bags.bag_messages(path, ["std_msgs/msg/UInt8MultiArray"]))


@pytest.mark.parametrize("kind", ["bz2", "lz4", "message", "file"])
def test_packed_bags_are_read_and_bounded(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, kind)
    own = ros2.zstd
    assert read(path) > SIZE

    class Small(Budget):
        def __init__(self, file_bytes: int) -> None:
            super().__init__(file_bytes)
            self._left = SIZE // 2

    monkeypatch.setattr(bags, "Budget", Small)
    with pytest.raises(RecordingError, match="were unpacked from a file of"):
        read(path)
    assert ros2.zstd is own


@pytest.mark.parametrize("kind", ["bz2", "message"])
def test_one_piece_is_bounded(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, kind)
    for module in (bags, ros1_bag):
        monkeypatch.setattr(module, "CHUNK_LIMIT", SIZE // 2)
    with pytest.raises(RecordingError, match="unpacks to more than"):
        read(path)
