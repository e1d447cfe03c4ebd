"""The recorder: segments, quota, reserve, commands, two at a time, and what a crash leaves."""

from __future__ import annotations

import os
import resource
import shutil
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.config.model import loads
from vical_daemon.logs import open_recording
from vical_daemon.logs.mcap import LogError, LogFolder, LogReader
from vical_daemon.record import role as record
from vical_daemon.record.queue import Arrival, RecordQueue, arrival
from vical_daemon.record.recorder import Recorder
from vical_daemon.service.wall_clock import private_clock

IMU = topics.IMU.key("rig0", "imu0")
COMMAND = topics.COMMAND.key("rig0", "record")
CLOCK = private_clock()


def settings(folder: Path, more: str = ""):
    return loads(f"rig: rig0\nrecord:\n  directory: {folder}\n  reserve_bytes: 0\n{more}")


@pytest.fixture
def make(tmp_path):
    """Makes a recorder on a folder of its own."""
    made = []

    def build(more: str = "", folder: Path | None = None, **options):
        config = settings(folder or tmp_path / "log", more)
        log_folder = LogFolder(folder or tmp_path / "log", **options)
        recorder = Recorder(config, log_folder, private_clock())
        made.append(recorder)
        return recorder

    yield build
    for recorder in made:
        recorder.close()


def feed(recorder: Recorder, count: int, begin: int = 0, key: str = IMU) -> None:
    for i in range(begin, begin + count):
        stamp = 1_700_000_000_000_000_000 + i * 1_000_000
        payload = m.encode_imu(stamp, "imu0", (float(i), 0.1, 0.2), (0.0, 0.0, 9.8))
        recorder.write(arrival(Sample(key, payload, i), private_clock()))


def numbers(path: Path) -> list[int]:
    return [
        int(m.decode_imu(x.payload).gyro_rps[0])
        for x in LogReader(path).messages()
        if x.channel.topic == "/" + IMU
    ]


def wait_until(condition) -> None:
    begin_s = time.monotonic()
    while not condition():
        assert time.monotonic() < begin_s + 30.0
        time.sleep(0.02)


def command(recorder: Recorder, word: str) -> None:
    recorder.write(arrival(Sample(COMMAND, m.encode_string(word), 0), private_clock()))


def run_role(config, bus, during):
    stop = threading.Event()
    thread = threading.Thread(target=record.run, args=(config, bus, stop), kwargs={"clock": private_clock()})
    thread.start()
    try:
        end = time.monotonic() + 5
        while not bus.latest(topics.STATUS.key("rig0", "record")) and time.monotonic() < end:
            time.sleep(0.01)
        during()
    finally:
        stop.set()
        thread.join(10)
    assert not thread.is_alive()


def test_role_records_what_travels(tmp_path, asl_folder):
    bus = LocalBus()
    bus.publish(
        topics.CAMERA_INFO.key("rig0", "cam0"),
        m.encode_camera_info(1, "cam0", (8, 6), [1, 2, 3, 4], "radtan", []),
    )
    recording = open_recording(asl_folder)
    sent = list(recording.messages())

    def during():
        for key, payload in sent:
            bus.publish(key, payload)
        bus.publish("vical/rig9/imu/imu0", b"of another rig")
        bus.publish("vical/rig0/unknown", b"not in the table")

    run_role(settings(tmp_path / "log"), bus, during)
    (path,) = (tmp_path / "log").glob("*.mcap")
    reader = LogReader(path)
    got = [(x.channel.topic[1:], x.payload) for x in reader.messages()]
    assert [x for x in got if "/imu/" in x[0] or "points" in x[0]] == sent
    assert any(key.endswith("camera_info") for key, _ in got)
    assert reader.complete
    assert dict(reader.metadata)["vical"]["rig"] == "rig0"
    assert "wall_minus_monotonic_ns" in dict(reader.metadata)["vical"]
    (status,) = bus.latest(topics.STATUS.key("rig0", "record"))
    assert m.decode_diagnostics(status.payload).statuses[0].values["state"] in ("recording", "waiting")
    # what was recorded is bit for bit what the folder gives
    assert list(open_recording(path).messages()) == sent


def test_rotation_loses_nothing(make, tmp_path):
    recorder = make("  rotate_bytes: 1000000\n")
    recorder.tick()
    for i in range(0, 6000, 500):
        feed(recorder, 500, i)
        command(recorder, "split") if i % 1500 == 1000 else recorder.tick()
    recorder.close()
    segments = LogFolder(tmp_path / "log").segments()
    assert len(segments) >= 4
    assert [n for path in segments for n in numbers(path)] == list(range(6000))
    runs = set()
    for i, path in enumerate(segments):
        reader = LogReader(path)
        list(reader.messages())
        about = dict(reader.metadata)["vical"]
        assert about["segment"] == str(i)
        runs.add(about["run"])
    assert len(runs) == 1


def test_a_limit_of_file_sizes_begins_new_files_and_loses_nothing(make, tmp_path, caplog):
    """Each file failed with "File too large", and 5 s were lost before the next one."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, before[1]))
    try:
        recorder = make()
        recorder.tick()
        for i in range(0, 20_000, 500):
            feed(recorder, 500, i)
            recorder.tick()
        recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    segments = LogFolder(tmp_path / "log").segments()
    assert len(segments) >= 2
    assert [n for path in segments for n in numbers(path)] == list(range(20_000))
    (line,) = (r.getMessage() for r in caplog.records if r.levelname != "INFO")
    assert line == "files may have 1 MB (ulimit -f): a new one begins after 1 MB"


def test_segments_repeat_what_each_needs(make, tmp_path):
    recorder = make()
    recorder.tick()
    info = m.encode_camera_info(1, "cam0", (8, 6), [1, 2, 3, 4], "radtan", [])
    key = topics.CAMERA_INFO.key("rig0", "cam0")
    recorder.write(arrival(Sample(key, info, 0), private_clock()))
    command(recorder, "split")
    recorder.close()
    assert len(LogFolder(tmp_path / "log").segments()) == 2
    for path in LogFolder(tmp_path / "log").segments():
        assert next(LogReader(path).messages()).channel.topic == "/" + key


def test_start_and_stop_over_the_bus(make, tmp_path):
    recorder = make("  enabled: false\n")
    recorder.tick()
    feed(recorder, 10)
    assert not recorder.recording
    status = recorder.status(RecordQueue(), 6)  # what is lost while nothing is recorded is no loss
    assert (status.level, status.message) == (m.Level.OK, "off: record.enabled is false")
    command(recorder, "start")
    assert recorder.recording
    feed(recorder, 10, 10)
    command(recorder, "stop")
    feed(recorder, 10, 20)
    command(recorder, "nonsense")
    recorder.write(arrival(Sample(COMMAND, b"junk", 0), private_clock()))
    recorder.tick()
    assert not recorder.recording
    (path,) = LogFolder(tmp_path / "log").segments()
    assert numbers(path) == list(range(10, 20))
    assert recorder.status(RecordQueue(), 0).message == "stopped by command"


def test_two_recorders_do_not_mix(make, tmp_path):
    first, second = make(), make()
    first.tick()
    second.tick()
    feed(first, 10)
    feed(second, 10)
    assert first.recording
    assert not second.recording
    assert "another recorder" in second.status(RecordQueue(), 0).message
    first.close()
    second._retry_ns = 0
    second.tick()  # takes over
    assert second.recording
    feed(second, 5, 10)
    second.close()
    segments = LogFolder(tmp_path / "log").segments()
    assert [n for path in segments for n in numbers(path)] == list(range(15))


def test_quota_deletes_the_oldest_of_ours_only(make, tmp_path):
    folder = tmp_path / "log"
    folder.mkdir()
    foreign = folder / "precious.mcap"
    foreign.write_bytes(b"x" * 3_000_000)
    recorder = make(quota_bytes=150_000)
    recorder.tick()
    for i in range(8):
        feed(recorder, 800, i * 800)
        command(recorder, "split")
        recorder.tick()
    recorder.close()
    segments = LogFolder(folder).segments()
    assert foreign.exists()
    assert sum(path.stat().st_size for path in segments) < 200_000
    assert 0 < len(segments) < 8
    assert numbers(segments[-1]) in ([], list(range(5600, 6400)))
    assert int(recorder.status(RecordQueue(), 0).values["files_deleted"]) > 0


def test_a_disk_without_room_from_the_start_is_reported_once(make, tmp_path, monkeypatch, caplog):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=4_000_000))
    recorder = make(reserve_bytes=5_000_000)
    for _ in range(3):
        recorder._retry_ns = 0
        recorder.tick()
    assert not recorder.recording
    assert [r.levelname for r in caplog.records if "not recording: the disk" in r.message] == ["WARNING"]


def test_a_folder_that_cannot_be_written_is_reported_once(make, caplog):
    recorder = make()
    for _ in range(2):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(LogFolder, "lock", Mock(side_effect=LogError("cannot record: read-only")))
            for _ in range(3):
                recorder._retry_ns = 0
                recorder.tick()
        assert "read-only" in recorder.status(RecordQueue(), 0).message
        recorder._retry_ns = 0
        recorder.tick()
        assert recorder.recording
        recorder.close()
    assert caplog.text.count("cannot record: read-only") == 2  # once each time


def test_reserve_stops_before_the_disk_is_full(make, tmp_path, monkeypatch):
    free = [10_000_000]
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=free[0]))
    recorder = make(reserve_bytes=5_000_000)
    recorder.tick()
    feed(recorder, 10)
    free[0] = 4_000_000
    recorder.tick()
    assert not recorder.recording
    assert recorder.status(RecordQueue(), 0).level == m.Level.ERROR
    assert "reserve_bytes" in recorder.status(RecordQueue(), 0).message
    free[0] = 5_200_000  # a little is not enough
    recorder._retry_ns = 0
    recorder.tick()
    assert not recorder.recording
    free[0] = 9_000_000
    recorder._retry_ns = 0
    recorder.tick()
    assert recorder.recording
    assert [numbers(path) for path in LogFolder(tmp_path / "log").segments()] == [list(range(10))]


def test_full_disk_ends_the_segment_and_recording_goes_on_later(make, tmp_path, monkeypatch):
    import errno
    import os

    recorder = make()
    recorder.tick()
    feed(recorder, 200)
    recorder._session._writer.flush()
    real = os.write

    def full(descriptor, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    feed(recorder, 10_000, 200)
    assert not recorder.recording
    assert "No space left" in recorder.status(RecordQueue(), 0).message
    recorder._retry_ns = 0
    recorder.tick()
    assert not recorder.recording
    monkeypatch.setattr(os, "write", real)
    recorder._retry_ns = 0
    recorder.tick()
    assert recorder.recording
    feed(recorder, 10, 50_000)
    recorder.close()
    found = sorted(numbers(path) for path in LogFolder(tmp_path / "log").segments())
    assert found[0][:200] == list(range(200))
    assert found[-1] == list(range(50_000, 50_010))


def test_read_only_folder_is_a_status_not_a_crash(make, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    recorder = make(folder=blocked / "log")
    recorder.tick()
    feed(recorder, 10)
    assert "cannot record into" in recorder.status(RecordQueue(), 0).message


def test_what_a_killed_recorder_left_is_recovered_at_the_next_start(make, tmp_path):
    first = make()
    first.tick()
    feed(first, 300)
    first._session._writer.flush()
    part = first._session._writer.part_path
    copy = part.read_bytes()
    first.close()
    for path in (tmp_path / "log").glob("*.mcap"):
        path.unlink()
    part.write_bytes(copy)
    second = make()
    second.tick()
    feed(second, 10, 300)
    second.close()
    recovered, fresh = sorted(LogFolder(tmp_path / "log").segments(), key=lambda path: -len(numbers(path)))
    assert numbers(recovered) == list(range(300))
    assert numbers(fresh) == list(range(300, 310))
    assert not part.exists()


def test_calibration_and_serials_are_in_the_log(make, tmp_path):
    from vical_daemon.estimation.result import CalibrationEstimate, Status

    recorder = make()
    status = m.DiagnosticStatus(m.Level.OK, "imu/imu0", hardware_id="6223.42")
    recorder.write(
        arrival(
            Sample(topics.STATUS.key("rig0", "imu"), m.encode_diagnostics(1, "imu", [status]), 0),
            private_clock(),
        )
    )
    recorder.tick()
    estimate = CalibrationEstimate(1, Status.WAITING, "", 0.0, "", 0.0, 0, 0, {}, None, [], 0.0, 0.0)
    payload = m.encode_calibration(estimate, "cam0")
    recorder.write(arrival(Sample(topics.CALIBRATION.key("rig0", "cam0"), payload, 0), private_clock()))
    recorder.close()
    (path,) = LogFolder(tmp_path / "log").segments()
    reader = LogReader(path)
    assert len(list(reader.messages())) == 1
    assert dict(reader.metadata)["devices"] == {"imu/imu0": "6223.42"}
    assert [a.name for a in reader.attachments] == ["calibration.json"]


def test_a_replaced_device_begins_a_new_file(make, tmp_path):
    recorder = make()

    def status(serial):
        payload = m.encode_diagnostics(
            1, "imu", [m.DiagnosticStatus(m.Level.OK, "imu/imu0", hardware_id=serial)]
        )
        sample = Sample(topics.STATUS.key("rig0", "imu"), payload, 0)
        recorder.write(arrival(sample, private_clock()))

    status("A")
    recorder.tick()
    for serial in ("A", "B", "A", "B", "B"):  # a damaged message is no other device
        status(serial)
    assert len(LogFolder(tmp_path / "log").segments()) == 0  # all in the open one
    status("B")
    recorder.close()
    readers = [LogReader(path) for path in LogFolder(tmp_path / "log").segments()]
    for reader in readers:
        list(reader.messages())
    assert [dict(r.metadata)["devices"] for r in readers] == [{"imu/imu0": "A"}, {"imu/imu0": "B"}]


@pytest.mark.parametrize(
    "password",
    [
        "  password: geheim",
        '  "password": geheim',
        "  password : geheim",
        "  password: >\n    ge\n    geheim",
    ],
)
def test_passwords_stay_out_of_logs(tmp_path, password):
    path = tmp_path / "vical.yaml"
    path.write_text(f"rig: rig0\nbus:\n{password}\n  user: a\nrecord: {{directory: {tmp_path / 'log'}}}\n")
    from vical_daemon.config.model import load

    recorder = Recorder(load(path), LogFolder(tmp_path / "log"), private_clock())
    recorder.tick()
    recorder.close()
    (log,) = LogFolder(tmp_path / "log").segments()
    assert b"geheim" not in log.read_bytes()
    reader = LogReader(log)
    list(reader.messages())
    assert b"user: a" in reader.attachments[0].data


def test_queue_gives_up_images_first():
    queue = RecordQueue(limit_bytes=1000)
    image = Arrival(topics.IMAGE, "i", bytes(400), 0)
    imu = Arrival(topics.IMU, "m", bytes(100), 0)
    for _ in range(3):
        queue.put(image)
    for _ in range(9):
        queue.put(imu)
    items = queue.take(0)
    assert [len(item.payload) for item in items] == [400, *[100] * 6]
    assert queue.dropped == {"image": 2, "imu": 3}
    assert queue.take(0.01) == []


def test_images_can_be_left_out(make):
    recorder = make("  images: false\n")
    assert not recorder.wants(topics.IMAGE)
    assert recorder.wants(topics.IMU)
    assert recorder.wants(topics.POINTS)
    assert make().wants(topics.IMAGE)


def test_arrival_of_an_unknown_key_is_nothing():
    assert arrival(Sample("vical/rig0/unknown", b"", 0), private_clock()) is None
    assert np.sign(arrival(Sample(IMU, b"", 0), private_clock()).log_time_ns) == 1


def test_invented_keys_fill_neither_memory_nor_log(make, tmp_path):
    recorder = make()
    recorder.tick()
    for i in range(600):
        feed(recorder, 1, i, key=topics.IMU.key("rig0", f"junk{i}"))
    assert recorder.messages == 512
    assert recorder.status(RecordQueue(), 0).values["refused"] == "88"


def test_what_does_not_decode_is_neither_recorded_nor_repeated_in_later_files(make, tmp_path, caplog):
    """Two junk messages once made 22 segments unreadable for mcap-ros2 and rosbags-convert."""
    recorder = make()
    recorder.tick()
    info = topics.CAMERA_INFO.key("rig0", "cam0")
    good = m.encode_camera_info(1, "cam0", (8, 6), [1, 2, 3, 4], "radtan", [])
    for payload in (good, b"junk", good[:-9], good + bytes(9)):
        for _ in range(2):
            recorder.write(arrival(Sample(info, payload, 0), private_clock()))
    recorder.write(arrival(Sample(topics.TF_STATIC.key("rig0"), b"junk", 0), private_clock()))
    feed(recorder, 3)
    command(recorder, "split")
    recorder.close()
    paths = LogFolder(tmp_path / "log").segments()
    assert len(paths) == 2
    for path in paths:
        for x in LogReader(path).messages():
            m.check_message(x.channel.type_name, x.payload)
    values = recorder.status(RecordQueue(), 0).values
    assert values["malformed"] == "7" and values["messages"] == str(2 + 3 + 1)
    assert caplog.text.count("not recorded, not a sensor_msgs/msg/CameraInfo") == 1


def test_a_key_that_no_log_can_hold_does_not_end_the_segment(make, tmp_path):
    recorder = make()
    recorder.tick()
    feed(recorder, 1)
    for name in ("a-b", "a b", "é", "1"):
        item = arrival(Sample(f"vical/rig0/imu/{name}", m.encode_imu(1, "x", (0,) * 3, (0,) * 3), 0), CLOCK)
        assert item is None or recorder.write(item) is None
    feed(recorder, 1, 1)
    assert recorder.recording
    recorder.close()
    (path,) = LogFolder(tmp_path / "log").segments()
    assert numbers(path) == [0, 1]


def test_invented_keys_leave_room_for_those_of_the_rig(make, tmp_path):
    recorder = make("imus: {imu7: {port: /dev/x}}\n")
    recorder.tick()
    for i in range(600):
        feed(recorder, 1, i, key=topics.IMU.key("rig0", f"junk{i}"))
    feed(recorder, 1, key=topics.IMU.key("rig0", "imu7"))
    assert recorder.messages == 512 + 1


def test_a_disk_that_stalls_is_reported_and_loses_nothing(tmp_path, monkeypatch, caplog):
    """On a robot the watchdog killed the recorder after 15 s, and what waited in memory was lost."""
    answers, write = threading.Event(), os.write

    def stalled(descriptor: int, data: bytes) -> int:
        assert answers.wait(30.0)
        return write(descriptor, data)

    monkeypatch.setattr("vical_daemon.record.recorder._SLOW_S", 0.2)
    monkeypatch.setattr("vical_daemon.service.health.STATUS_PERIOD_S", 0.1)
    bus, stop = LocalBus(), threading.Event()
    heard = []
    key = topics.STATUS.key("rig0", "record")
    bus.subscribe(key, lambda s: heard.append(m.decode_diagnostics(s.payload).statuses[0]))
    log = tmp_path / "log"
    role = threading.Thread(target=record.run, args=(settings(log), bus, stop), kwargs={"clock": CLOCK})
    role.start()
    try:
        wait_until(lambda: any("recording" in status.message for status in heard))
        monkeypatch.setattr(os, "write", stalled)
        for i in range(200):
            bus.publish(IMU, m.encode_imu(i + 1, "imu0", (float(i), 0.1, 0.2), (0.0, 0.0, 9.8)))
            time.sleep(0.01)
        wait_until(lambda: "messages wait in memory" in heard[-1].message and heard[-1].level is m.Level.WARN)
        assert heard[-1].values["state"] == "recording"
    finally:
        answers.set()
        stop.set()
        role.join(30.0)
    assert heard[-1].level is m.Level.OK and heard[-1].values["dropped"] == "0"
    assert sum(f"the disk of {log} has taken nothing for" in r.getMessage() for r in caplog.records) == 1
    (path,) = LogFolder(log).segments()
    assert numbers(path) == list(range(200))
