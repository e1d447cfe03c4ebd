"""The recorder's folder: moved, deleted or replaced while recording, and the quota over many segments."""

from __future__ import annotations

import errno
import os
import shutil
import stat
from pathlib import Path

import pytest

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.config.model import loads
from vical_daemon.logs.mcap import LogError, LogFolder, LogReader
from vical_daemon.record.queue import RecordQueue, arrival
from vical_daemon.record.recorder import Recorder
from vical_daemon.service.wall_clock import private_clock

IMU = topics.IMU.key("rig0", "imu0")


@pytest.fixture
def recorder(tmp_path):
    config = loads(f"rig: rig0\nrecord: {{directory: {tmp_path / 'log'}, reserve_bytes: 0}}\n")
    recorder = Recorder(config, LogFolder(tmp_path / "log"), private_clock())
    recorder.tick()
    yield recorder
    recorder.close()


def feed(recorder: Recorder, begin: int, count: int) -> None:
    for i in range(begin, begin + count):
        payload = m.encode_imu(1, "imu0", (float(i), 0.0, 0.0), (0.0, 0.0, 9.8))
        recorder.write(arrival(Sample(IMU, payload, i), private_clock()))


def kept(folder: Path) -> list[int]:
    paths = LogFolder(folder).segments()
    return sorted(
        int(m.decode_imu(message.payload).gyro_rps[0])
        for path in paths
        for message in LogReader(path).messages()
        if message.channel.topic == "/" + IMU
    )


def numbered(folder: Path, index: int, size: int = 10) -> Path:
    path = folder / f"rig0_20261121T022842Z_ab12cd_{index:04d}.mcap"
    path.write_bytes(b"x" * size)
    return path


@pytest.mark.parametrize("made_anew", [False, True])
def test_a_folder_that_was_moved_keeps_its_segment_and_the_recording_goes_on(
    recorder, tmp_path, caplog, made_anew
):
    feed(recorder, 0, 5)
    (tmp_path / "log").rename(tmp_path / "moved")
    if made_anew:
        (tmp_path / "log").mkdir()
    recorder.tick()
    assert "moved, deleted or replaced" in recorder.status(RecordQueue(), 0).message
    recorder.tick()
    feed(recorder, 5, 5)
    assert recorder.status(RecordQueue(), 0).level == m.Level.OK
    recorder.close()
    assert kept(tmp_path / "moved") == [0, 1, 2, 3, 4]
    assert kept(tmp_path / "log") == [5, 6, 7, 8, 9]
    assert [r.levelname for r in caplog.records if r.levelno > 20] == ["WARNING"]


@pytest.mark.parametrize(("error", "warnings"), [(FileNotFoundError, 0), (PermissionError, 1)])
def test_a_folder_that_goes_while_logs_are_recovered_is_reported_once(
    recorder, monkeypatch, caplog, error, warnings
):
    """By `tick`: the thread that recovers them had warned as well, now and then."""

    def fail():
        raise error("log")

    monkeypatch.setattr(recorder._folder, "recover", fail)
    recorder._recover()
    assert sum(r.levelname == "WARNING" for r in caplog.records) == warnings


def test_a_folder_that_is_deleted_during_the_look_is_made_again_at_once(recorder, tmp_path, monkeypatch):
    """`rm -rf` between two looks at the folder: 5 s were not recorded."""
    feed(recorder, 0, 5)
    look = LogFolder.in_place
    looks = iter([True])
    monkeypatch.setattr(LogFolder, "in_place", lambda folder: next(looks, None) or look(folder))
    shutil.rmtree(tmp_path / "log")
    recorder.tick()
    recorder.tick()
    assert recorder.recording
    feed(recorder, 5, 5)
    recorder.close()
    assert kept(tmp_path / "log") == [5, 6, 7, 8, 9]


def test_a_recorder_that_stands_by_says_so_once(recorder, tmp_path, caplog, monkeypatch):
    config = loads(f"rig: rig0\nrecord: {{directory: {tmp_path / 'log'}, reserve_bytes: 0}}\n")
    second = Recorder(config, LogFolder(tmp_path / "log"), private_clock())
    monkeypatch.setattr("vical_daemon.record.recorder._RETRY_NS", 0)
    second.tick()
    second.tick()
    said = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert len(said) == 1 and said[0].startswith("standing by: another recorder writes into ")
    recorder.close()
    second.tick()
    assert second.recording
    second.close()


def test_a_deleted_folder_is_made_again(recorder, tmp_path):
    feed(recorder, 0, 5)
    shutil.rmtree(tmp_path / "log")
    recorder.tick()
    recorder.tick()
    feed(recorder, 5, 5)
    recorder.close()
    assert kept(tmp_path / "log") == [5, 6, 7, 8, 9]


def test_stop_after_the_folder_was_deleted_is_one_line(recorder, tmp_path, caplog):
    feed(recorder, 0, 5)
    shutil.rmtree(tmp_path / "log")
    recorder.close()
    (line,) = [r.getMessage() for r in caplog.records if r.levelname == "ERROR"]
    assert line.startswith("cannot finish ") and "No such file or directory" in line


def test_quota_counts_segments_beyond_the_ten_thousandth(tmp_path):
    """A recorder with `rotate_s: 300` gets there in 35 days."""
    paths = [numbered(tmp_path, index) for index in (9998, 9999, 10000, 10001)]
    folder = LogFolder(tmp_path, quota_bytes=20)
    assert folder.segments() == paths
    assert folder.enforce_quota() == paths[:2]


def test_quota_takes_the_age_from_the_names(tmp_path):
    """Recovered late, copied, or written after the wall clock was set back: the file's time is another."""
    paths = [numbered(tmp_path, index) for index in range(3)]
    for age, path in enumerate(paths):
        os.utime(path, (1e9 - age, 1e9 - age))
    assert LogFolder(tmp_path, quota_bytes=20).enforce_quota() == paths[:1]


def test_quota_reads_the_folder_once_a_segment(tmp_path, monkeypatch):
    """The recorder asks ten times a second: with 400 segments that took 13 % of a core."""
    reads = []
    segments = LogFolder.segments
    monkeypatch.setattr(LogFolder, "segments", lambda folder: reads.append(1) or segments(folder))
    for index in range(3):
        numbered(tmp_path, index)
    folder = LogFolder(tmp_path, quota_bytes=100)
    for size in range(40):
        assert not folder.enforce_quota(tmp_path / "open", size)
    assert len(reads) == 1
    numbered(tmp_path, 3)
    assert not folder.enforce_quota(tmp_path / "next", 40)
    assert [path.name[-9:-5] for path in folder.enforce_quota(tmp_path / "next", 70)] == ["0000"]
    assert [path.name[-9:-5] for path in folder.enforce_quota(tmp_path / "next", 85)] == ["0001", "0002"]


def test_a_lock_file_that_root_made_is_no_obstacle(tmp_path, monkeypatch):
    """`sudo vical run record`, once, and the service could no longer record."""
    really_open = os.open

    def open_as_other_user(path, flags, *mode, **more):
        if Path(path).name == ".recorder.lock" and flags & os.O_RDWR:
            raise PermissionError(13, "Permission denied", str(path))
        return really_open(path, flags, *mode, **more)

    (tmp_path / ".recorder.lock").touch()
    monkeypatch.setattr(os, "open", open_as_other_user)
    first, second = LogFolder(tmp_path), LogFolder(tmp_path)
    assert first.lock() and not second.lock()
    first.unlock()
    assert second.lock()
    second.unlock()


def record_run(folder: Path, unix_s: int) -> Path:
    """Leave a segment of 10 bytes, as a recorder that starts at this date would."""
    log = LogFolder(folder)
    assert log.lock()
    path = folder / f"{log.begin_run('rig0', unix_s * 10**9)}_0000.mcap"
    path.write_bytes(b"x" * 10)
    log.unlock()
    return path


def test_runs_are_in_the_order_in_which_they_began(tmp_path, monkeypatch):
    """Whatever their marks, which are random, and their dates.

    A computer without a battery-backed clock is in 1970 again after a start without a network: the recording
    of today was deleted at once, and last year's kept.
    """
    marks = iter(["ffffff", "000000", "dddddd", "222222"])
    monkeypatch.setattr("secrets.token_hex", lambda size: next(marks))
    paths = [record_run(tmp_path, unix_s) for unix_s in (1_790_000_000, 1_790_000_000, 30, 20)]
    assert LogFolder(tmp_path).segments() == paths
    assert LogFolder(tmp_path, quota_bytes=20).enforce_quota() == paths[:2]


def test_copied_runs_come_before_listed_ones_and_deleted_ones_are_forgotten(tmp_path):
    copied = numbered(tmp_path, 0)
    first = record_run(tmp_path, 30)
    second = record_run(tmp_path, 20)
    assert LogFolder(tmp_path).segments() == [copied, first, second]
    first.unlink()
    third = record_run(tmp_path, 10)
    assert LogFolder(tmp_path).segments() == [copied, second, third]
    assert len((tmp_path / ".recorder.runs").read_text().splitlines()) == 2


@pytest.mark.parametrize("damage", [b"", b"\xff\x00nonsense\n"])
def test_without_its_list_the_dates_count(tmp_path, damage):
    paths = [record_run(tmp_path, unix_s) for unix_s in (20, 10)]
    (tmp_path / ".recorder.runs").write_bytes(damage)
    assert LogFolder(tmp_path).segments() == paths[::-1]


def test_a_disk_without_locks_is_named(tmp_path, monkeypatch):
    """It was taken for one on which another recorder writes: `standing by`, for ever."""

    def no_locks(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", no_locks)
    with pytest.raises(LogError, match=r"recorder.lock: No locks available; mount this disk with locks"):
        LogFolder(tmp_path).lock()


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.EIO])
def test_a_disk_that_cannot_sync_folders_keeps_its_recordings(recorder, tmp_path, monkeypatch, number):
    """CIFS, shared folders of virtual machines: `cannot finish ...: Invalid argument`, of a finished file."""
    sync = os.fsync

    def of_files_alone(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        sync(descriptor)

    feed(recorder, 0, 5)
    monkeypatch.setattr(os, "fsync", of_files_alone)
    recorder.close()
    problem = recorder.status(RecordQueue(), 0).message
    assert ("cannot finish" in problem) == (number == errno.EIO)
    assert kept(tmp_path / "log") == [0, 1, 2, 3, 4]
