"""Recordings as other programs pack them: compressed bags, bags in part, and files that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from vical_daemon.bus import messages as m
from vical_daemon.cli import main
from vical_daemon.logs import RecordingError, bags, open_recording, ros1_bag

IMU = "sensor_msgs/msg/Imu"
BEGIN_NS = 1_700_000_000_000_000_000


def bag(folder: Path, plugin: StoragePlugin, mode: CompressionMode) -> Path:
    writer = Ros2Writer(folder / "bag", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/imu/data", IMU, typestore=get_typestore(Stores.LATEST))
        for i in range(50):
            stamp = BEGIN_NS + 10_000_000 * i
            writer.write(topic, stamp, m.encode_imu(stamp, "imu", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))
    return folder / "bag"


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_packed_ros2_bags_are_read_by_the_name_of_folder_or_file(tmp_path, plugin, mode):
    folder = bag(tmp_path, plugin, mode)
    for name in (folder, *folder.iterdir()):
        assert open_recording(name, check=False).imus["imu0"].count == 50, name


def test_packed_messages_without_metadata_say_what_is_missing(tmp_path):
    folder = bag(tmp_path, StoragePlugin.MCAP, CompressionMode.MESSAGE)
    (folder / "metadata.yaml").unlink()
    with pytest.raises(RecordingError, match=r"zstd: give the bag with its metadata\.yaml"):
        open_recording(folder, check=False)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("a.mcap.gz", "is packed: gunzip -k a.mcap.gz"),
        ("a.tar.zst", "is packed: zstd -d a.tar.zst"),
        ("a.bag.active", r"active cannot be read as a bag: it does not begin like one of ROS 1"),
        ("a.db3", r"cannot be read as a bag: a\.db3 .* no tables of a ROS 2 bag; .* Copy it again"),
        ("folder/a.bag", r"holds ROS 1 bags: give the files, .*/\*\.bag"),
        ("folder/a.db3", r"folder cannot be read as a bag: a\.db3 .* Copy it again"),
        ("notes.txt", "is no recording: expected"),
    ],
)
def test_what_cannot_be_read_as_it_is_says_what_to_do(tmp_path, name, says):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"x")
    with pytest.raises(RecordingError, match=says):
        open_recording(path.parent if path.parent != tmp_path else path)


def test_a_pipe_is_named_as_one():
    with pytest.raises(RecordingError, match=r"is a pipe or a device: .* copy it into a file"):
        open_recording("/dev/null")


@pytest.mark.parametrize("kind", ["bz2", "lz4"])
def test_each_chunk_of_a_ros1_bag_is_unpacked_once(tmp_path, monkeypatch, kind):
    """A recorder writes messages as they arrive, here up to 1 s later, and in that order they are read."""
    store = get_typestore(Stores.ROS1_NOETIC)
    text = "std_msgs/msg/String"
    writer = Ros1Writer(tmp_path / "a.bag")
    writer.chunk_threshold = 2000
    writer.set_compression(Ros1Writer.CompressionFormat[kind.upper()])
    rng = np.random.default_rng(1)
    times = sorted(range(400), key=lambda i: 10_000_000 * i + rng.integers(0, 1_000_000_000))
    with writer:
        topic = writer.add_connection("/a", text, typestore=store)
        for i in times:
            data = store.serialize_ros1(store.types[text](data=rng.bytes(50).hex()), text)
            writer.write(topic, 10_000_000 * i + 1, data)
    unpacked = []
    unpack = ros1_bag._unpacked
    monkeypatch.setattr(
        ros1_bag, "_unpacked", lambda x, data, all_: unpacked.append(bytes(data)) or unpack(x, data, all_)
    )
    found = [message.log_time_ns for message in bags.bag_messages(tmp_path / "a.bag", ())]
    assert found == [10_000_000 * i + 1 for i in times] and len(found) == 400
    assert len(unpacked) == len(set(unpacked)) > 10


def test_info_gives_the_size_of_a_long_text_of_the_metadata(tmp_path, capsys):
    folder = bag(tmp_path, StoragePlugin.MCAP, CompressionMode.STORAGE)
    assert main(["info", str(folder / "bag.mcap")]) == 0
    lines = capsys.readouterr().out.splitlines()
    (line,) = [line for line in lines if line.startswith("metadata rosbag2")]
    assert line.endswith("characters)")
