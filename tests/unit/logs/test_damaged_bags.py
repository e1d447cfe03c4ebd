"""Bags as crashes and other programs leave them: cut, without index or metadata, with odd messages."""

from __future__ import annotations

import shutil
import sqlite3

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from vical_daemon.bus.messages import IMU_TYPE, encode_imu
from vical_daemon.bus.messages.schemas import typestore
from vical_daemon.logs import RecordingError, open_recording

COUNT = 400
BEGIN_NS = 1_700_000_000_000_000_000


def readings():
    for i in range(COUNT):
        stamp = BEGIN_NS + 10_000_000 * i
        yield stamp, encode_imu(stamp, "imu", (0.1, i / 1000.0, 0.2), (0.0, 0.0, 9.8))


@pytest.fixture(params=["NONE", "LZ4", "BZ2"])
def ros1(tmp_path, request):
    """A bag with many small chunks, and a topic whose definition nobody can parse."""
    store, rng = get_typestore(Stores.ROS1_NOETIC), np.random.default_rng(1)
    writer = Ros1Writer(tmp_path / "a.bag")
    writer.chunk_threshold = 5000
    if request.param != "NONE":
        writer.set_compression(Ros1Writer.CompressionFormat[request.param])
    with writer:
        topic = writer.add_connection("/imu/data", IMU_TYPE, typestore=store)
        other = writer.add_connection("/lidar", "some_msgs/msg/Scan", msgdef="Point[] of ! what", md5sum="*")
        for stamp, payload in readings():
            writer.write(topic, stamp, bytes(typestore().cdr_to_ros1(payload, IMU_TYPE)))
            writer.write(other, stamp, rng.bytes(200))
    return tmp_path / "a.bag"


@pytest.fixture
def ros2(tmp_path):
    writer = Ros2Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3)
    with writer:
        topic = writer.add_connection("/imu/data", IMU_TYPE, typestore=get_typestore(Stores.ROS2_HUMBLE))
        for stamp, payload in readings():
            writer.write(topic, stamp, payload)
    return tmp_path / "bag"


def count(path):
    recording = open_recording(path, check=False)
    return recording.imus["imu0"].count, recording.warnings


def test_definitions_of_other_packages_do_not_matter(ros1):
    assert count(ros1) == (COUNT, [])


@pytest.mark.parametrize("name", ["cut.bag", "run.bag.active"])
def test_a_bag_that_was_never_finished_is_read_up_to_its_end(ros1, name):
    data = ros1.read_bytes()
    path = ros1.with_name(name)
    path.write_bytes(data[: len(data) // 2] + bytes(500))  # a file system may leave zeros behind a crash
    found, warnings = count(path)
    assert 0.4 * COUNT < found < 0.6 * COUNT
    assert any(f"{name}: cut off or damaged after" in warning for warning in warnings)


def test_a_damaged_chunk_costs_that_chunk(ros1):
    data = bytearray(ros1.read_bytes())
    begins = [data.find(magic, len(data) // 2) for magic in (b"\x04\x22\x4d\x18", b"BZh9")]  # lz4, bz2
    if max(begins) < 0:
        pytest.skip("there is nothing to check it by")
    data[max(begins) : max(begins) + 64] = bytes(64)
    ros1.write_bytes(data)
    found, (warning,) = count(ros1)
    assert 0.8 * COUNT < found < COUNT
    assert "1 damaged chunks left out" in warning


def test_a_bag_without_its_metadata_is_read(ros2):
    (ros2 / "metadata.yaml").unlink()
    assert count(ros2) == count(ros2 / "bag.db3") == (COUNT, [])


@pytest.mark.parametrize("name", ["run #2", "50%20", "what?"])
def test_names_that_mean_something_in_an_address_are_names(ros2, name):
    assert count(ros2.rename(ros2.with_name(name))) == (COUNT, [])


def test_what_a_crash_left_in_the_log_of_sqlite_is_read(ros2, tmp_path):
    database = sqlite3.connect(ros2 / "bag.db3")
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("DELETE FROM messages WHERE id > 300")
    database.commit()
    shutil.copytree(ros2, tmp_path / "crashed")
    database.close()
    assert (tmp_path / "crashed/bag.db3-wal").stat().st_size
    assert count(tmp_path / "crashed") == (300, [])


def test_a_file_that_was_not_copied_whole_is_read_as_far_as_it_goes(ros2):
    path = ros2 / "bag.db3"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    found, (warning,) = count(ros2)
    assert 0.3 * COUNT < found < 0.6 * COUNT
    assert f"cut off or damaged behind {found} messages" in warning


def test_a_segment_without_messages_or_one_that_is_missing_is_reported(ros2):
    (ros2 / "bag_1.db3").write_bytes(b"")
    found, (warning,) = count(ros2)
    assert found == COUNT and "bag_1.db3 cannot be read" in warning
    text = (ros2 / "metadata.yaml").read_text()
    (ros2 / "metadata.yaml").write_text(text.replace("  - bag.db3", "  - bag.db3\n  - bag_1.db3"))
    (ros2 / "bag_1.db3").unlink()
    found, (warning,) = count(ros2)
    assert found == COUNT and "bag_1.db3 of its metadata.yaml is not there" in warning


def test_a_view_in_place_of_a_table_is_refused(tmp_path):
    """It could compute messages without end."""
    database = sqlite3.connect(tmp_path / "a.db3")
    database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
    database.execute("CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, x'00' AS data")
    database.close()
    with pytest.raises(RecordingError, match="it has no tables of a ROS 2 bag"):
        open_recording(tmp_path / "a.db3")


@pytest.mark.parametrize("damaged", [0, 3])
def test_a_bag_of_ros_1_converted_to_mcap_is_read(tmp_path, damaged):
    """`mcap convert a.bag a.mcap` keeps the messages as they are."""
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros1")
        schema = writer.register_schema("sensor_msgs/Imu", "ros1msg", b"")
        topic = writer.register_channel("/imu/data", "ros1", schema)
        for number, (stamp, payload) in enumerate(readings()):
            data = bytes(typestore().cdr_to_ros1(payload, IMU_TYPE))
            writer.add_message(topic, stamp, data[: 50 if number < damaged else None], stamp)
        writer.finish()
    found, warnings = count(tmp_path / "a.mcap")
    assert found == COUNT - damaged
    assert [f"{damaged} unreadable messages left out" in w for w in warnings] == [True] * bool(damaged)


@pytest.mark.parametrize(
    ("length", "says"), [(10**9, "string or blob too big"), (10**8, "were unpacked from a")]
)
def test_a_column_that_is_computed_is_bounded(tmp_path, length, says):
    database = sqlite3.connect(tmp_path / "a.db3")
    database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
    database.execute("INSERT INTO topics VALUES (1, '/imu', 'sensor_msgs/msg/Imu')")
    column = f"data BLOB GENERATED ALWAYS AS (zeroblob({length}))"
    database.execute(f"CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp INTEGER, {column})")
    database.executemany(
        "INSERT INTO messages(topic_id, timestamp) VALUES (1, ?)", [(i,) for i in range(100)]
    )
    database.commit()
    database.close()
    with pytest.raises(RecordingError, match=says):
        open_recording(tmp_path / "a.db3")
