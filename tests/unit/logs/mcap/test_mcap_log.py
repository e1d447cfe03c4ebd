"""MCAP logs: what is written opens everywhere, what is damaged gives what is whole."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import struct
import threading
import zlib
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.logs.mcap import LogError, LogReader, LogWriter, is_being_written, recover, recover_folder
from vical_daemon.logs.mcap.files import LockedFile

IMU = topics.IMU.key("rig0", "imu0")
POINTS = topics.POINTS.key("rig0", "cam0")
T0 = 1_600_000_000_000_000_000


def fill(writer: LogWriter, count: int, begin: int = 0) -> None:
    for i in range(begin, begin + count):
        stamp = T0 + i * 5_000_000
        writer.write(IMU, m.encode_imu(stamp, "imu0", (i, 0.1, 0.2), (0.0, 0.0, 9.8)), stamp)
        if i % 10 == 0:
            writer.write(
                POINTS, m.encode_points(stamp, "cam0", np.arange(5), np.full((5, 2), float(i))), stamp
            )


def read(path: Path) -> tuple[LogReader, list[int]]:
    reader = LogReader(path)
    numbers = [
        int(m.decode_imu(message.payload).gyro_rps[0])
        for message in reader.messages()
        if message.channel.topic == "/" + IMU
    ]
    return reader, numbers


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path, {"vical": {"version": "1"}}) as writer:
        fill(writer, 400)
        writer.flush()
        fill(writer, 100, 400)
        writer.attach("config.yaml", "text/yaml", b"rig: rig0", T0)
    return path


def test_log_reads_back(log):
    reader, numbers = read(log)
    assert numbers == list(range(500))
    assert reader.complete
    assert not reader.warnings
    assert reader.metadata == [("vical", {"version": "1"})]
    assert [(a.name, a.data) for a in reader.attachments] == [("config.yaml", b"rig: rig0")]
    assert sorted(c.type_name for c in reader.channels) == [m.IMU_TYPE, m.POINTS_TYPE]
    assert read(log)[1] == numbers  # a second time
    assert not list(log.parent.glob("*.part"))


def test_log_opens_with_mcap_and_rosbags(log):
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 550
        assert {c.topic for c in summary.channels.values()} == {"/" + IMU, "/" + POINTS}
    with AnyReader([log]) as reader:
        assert reader.message_count == 550
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)  # our own type is learnt from the file


def test_metadata_is_there_after_a_crash_at_once(tmp_path):
    writer = LogWriter(tmp_path / "a.mcap", {"vical": {"version": "1"}})
    reader, numbers = read(writer.part_path)
    assert (reader.metadata, numbers, reader.complete) == ([("vical", {"version": "1"})], [], False)
    writer.close()


def test_flushed_data_survives_without_close(tmp_path):
    writer = LogWriter(tmp_path / "a.mcap")
    fill(writer, 300)
    writer.flush()
    fill(writer, 50, 300)
    assert is_being_written(writer.part_path)
    with pytest.raises(LogError, match="still being written"):
        recover(writer.part_path)
    copy = tmp_path / "b.mcap.part"
    copy.write_bytes(writer.part_path.read_bytes())
    reader, numbers = read(copy)
    assert numbers[:300] == list(range(300))
    assert "end is missing" in reader.warnings[0]
    result = recover(copy)
    assert result.output == tmp_path / "b.mcap"
    reader, again = read(result.output)
    assert again == numbers
    assert reader.complete
    with result.output.open("rb") as file:
        assert make_reader(file).get_summary() is not None
    writer.close()


def test_every_cut_gives_a_beginning(log, tmp_path):
    whole = log.read_bytes()
    cut = tmp_path / "cut.mcap"
    lengths = [*range(9, 200, 5), *np.linspace(200, len(whole) - 1, 40).astype(int).tolist()]
    counts = []
    for length in lengths:
        cut.write_bytes(whole[:length])
        reader, numbers = read(cut)
        assert numbers == list(range(len(numbers)))
        assert not reader.complete
        counts.append(len(numbers))
    assert counts[-1] == 500
    assert counts == sorted(counts)


def test_damaged_chunk_is_left_out_and_said(log):
    raw = bytearray(log.read_bytes())
    raw[3000] ^= 0xFF  # inside the first chunk
    log.write_bytes(raw)
    reader, numbers = read(log)
    assert numbers == list(range(400, 500))
    assert "damaged" in reader.warnings[0]


def test_chunk_that_lies_about_its_size_is_refused(tmp_path):
    """64 MB of zeros in a few hundred kB, said to be 1 kB; and a zstd frame without end."""
    import lz4.frame
    import zstandard

    for name, packed in (
        ("lz4", lz4.frame.compress(bytes(2**26))),
        ("zstd", zstandard.compress(bytes(2**26))),
    ):
        body = (
            struct.pack("<QQQII", 0, 1, 1024, 0, len(name))
            + name.encode()
            + struct.pack("<Q", len(packed))
            + packed
        )
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(body)) + body)
        reader, numbers = read(path)
        assert not numbers
        assert reader.warnings


def test_foreign_mcaps_are_read(tmp_path):
    for compression in (CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4):
        for chunking in (True, False):
            path = tmp_path / f"{compression.name}{chunking}.mcap"
            with path.open("wb") as file:
                writer = Writer(file, compression=compression, use_chunking=chunking, chunk_size=2000)
                writer.start()
                schema = writer.register_schema(m.IMU_TYPE, "ros2msg", m.ros2_schema(m.IMU_TYPE).encode())
                channel = writer.register_channel("/" + IMU, "cdr", schema)
                for i in range(40):
                    writer.add_message(
                        channel, T0 + i, m.encode_imu(T0 + i, "i", (i, 0, 0), (0, 0, 9.8)), T0 + i
                    )
                writer.finish()
            reader, numbers = read(path)
            assert (numbers, reader.complete, reader.warnings) == (list(range(40)), True, [])


@pytest.mark.parametrize("content", [b"", b"hello, this is text\n", b"\x89MCAP1\r\n", b"\x89MC"])
def test_what_is_no_mcap_is_refused(tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"is no MCAP file|is empty"):
        LogReader(path)


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(LogError, match="No such file"):
        LogReader(tmp_path / "no.mcap")
    with pytest.raises(LogError, match="is a folder, a file is needed"):
        LogReader(tmp_path)
    with pytest.raises(LogError, match="cannot create"):
        LogWriter(tmp_path / "no" / "a.mcap")


def test_nothing_is_ever_overwritten(log):
    with pytest.raises(LogError, match="exists already"):
        LogWriter(log)
    with pytest.raises(LogError, match="exists already"):
        recover(log, log)


def test_key_without_a_type_is_refused(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as writer:
        for key in ("vical/rig0/nothing", "a b", "../../etc"):
            with pytest.raises(LogError, match="can be recorded"):
                writer.write(key, b"", T0)


def test_full_disk_is_an_error_and_costs_only_the_end(tmp_path, monkeypatch, caplog):
    writer = LogWriter(tmp_path / "a.mcap")
    fill(writer, 200)
    writer.flush()
    real = os.write

    def full(descriptor, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(LogError, match="No space left"):
        fill(writer, 200, 200)
    with pytest.raises(LogError, match="No space left"):
        writer.close()
    monkeypatch.setattr(os, "write", real)
    sdk = logging.getLogger("foxglove.log_sink_set")
    sdk.warning(
        'error logging message: McapError(Io(Custom { ... traceback: Some("Traceback (most ...") } }))'
    )
    sdk.warning("something else")
    assert "Traceback" not in caplog.text and "something else" in caplog.text
    assert recover_folder(tmp_path)
    assert read(tmp_path / "a.mcap")[1][:200] == list(range(200))
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_recover_folder_leaves_living_and_hopeless_files(tmp_path):
    living = LogWriter(tmp_path / "living.mcap")
    fill(living, 10)
    living.flush()
    dead = tmp_path / "dead.mcap.part"
    dead.write_bytes(living.part_path.read_bytes())
    (tmp_path / "empty.mcap.part").write_bytes(b"")
    (tmp_path / "text.mcap.part").write_bytes(b"no log at all")
    (tmp_path / "dead.mcap.recovering").write_bytes(b"half of an earlier attempt")
    done = recover_folder(tmp_path)
    assert [r.output.name for r in done] == ["dead.mcap"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dead.mcap", "living.mcap.part", "text.mcap.part"]
    living.close()
    assert read(tmp_path / "living.mcap")[1] == list(range(10))


def test_recovery_that_died_half_way_is_finished(log, tmp_path):
    """Killed between the rename of the result and the removal of the part: no harm."""
    before = log.read_bytes()
    part = tmp_path / "a.mcap.part"
    part.write_bytes(before[:20000])
    assert [r.output.name for r in recover_folder(tmp_path)] == ["a.recovered.mcap"]
    assert log.read_bytes() == before
    assert not part.exists()


def test_locked_file_says_so(tmp_path):
    file = LockedFile(tmp_path / "x")
    assert is_being_written(tmp_path / "x")
    file.close()
    file.close()
    assert not is_being_written(tmp_path / "x")
    assert not is_being_written(tmp_path / "nothing")


def test_a_file_just_made_is_not_taken_for_a_leftover(tmp_path):
    """Between making and locking it is empty and nobody's: cleaning up then took the recording away."""
    stop = threading.Event()

    def clean():
        while not stop.is_set():
            recover_folder(tmp_path)

    cleaner = threading.Thread(target=clean)
    cleaner.start()
    try:
        for k in range(300):
            part = tmp_path / f"{k}.mcap.part"
            file = LockedFile(part)
            file.write(b"data")
            assert part.stat().st_size == 4
            part.rename(tmp_path / f"{k}.done")
            file.close()
    finally:
        stop.set()
        cleaner.join()


def test_a_cleaner_between_making_and_locking_costs_a_second_attempt(tmp_path, monkeypatch):
    part, real = tmp_path / "a.mcap.part", fcntl.flock

    def late(descriptor, how):
        monkeypatch.setattr(fcntl, "flock", real)
        assert recover_folder(tmp_path) == []
        assert not part.exists()
        real(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", late)
    file = LockedFile(part)
    assert part.exists()
    assert is_being_written(part)
    file.close()


def test_a_leftover_that_may_only_be_read_is_recovered(log, tmp_path, monkeypatch):
    part, real = tmp_path / "a.mcap.part", os.open
    part.write_bytes(log.read_bytes())

    def refused(path, flags, *mode, **rest):
        if Path(path) == part and flags & os.O_RDWR:
            raise PermissionError(errno.EACCES, "Permission denied")
        return real(path, flags, *mode, **rest)

    monkeypatch.setattr(os, "open", refused)
    (done,) = recover_folder(tmp_path)
    assert done.output.exists()
    assert not part.exists()


def test_mutated_files_never_raise(log, tmp_path, rng):
    whole = log.read_bytes()
    path = tmp_path / "m.mcap"
    for _ in range(150):
        raw = bytearray(whole[: int(rng.integers(8, len(whole) + 1))])
        for _ in range(int(rng.integers(1, 8))):
            if len(raw) > 8:
                raw[int(rng.integers(8, len(raw)))] = int(rng.integers(0, 256))
        path.write_bytes(raw)
        for message in LogReader(path).messages():
            assert zlib.crc32(message.payload) >= 0
