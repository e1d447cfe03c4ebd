"""The files of a folder are read in the order of their messages, whatever their names say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from vical_daemon.bus import messages as m
from vical_daemon.cli import main
from vical_daemon.logs import open_recording
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.mcap import LogReader, LogWriter, segments_in

IMU = "vical/rig0/imu/imu0"
BEGIN_NS = 1_700_000_000_000_000_000


@pytest.fixture
def split(tmp_path) -> Path:
    """Twelve segments of 5 s with the names of `ros2 bag record --max-bag-duration`."""
    for segment in range(12):
        with LogWriter(tmp_path / f"bag_{segment}.mcap") as writer:
            for i in range(50 * segment, 50 * segment + 50):
                stamp = BEGIN_NS + i * 100_000_000
                writer.write(IMU, m.encode_imu(stamp, "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)), stamp)
    return tmp_path


def stamps(folder: Path) -> list[int]:
    return [stamp_of(payload) for _, payload in open_recording(folder, check=False).messages()]


def test_segment_ten_comes_behind_segment_nine(split):
    assert [path.stem for path in segments_in(split)] == [f"bag_{segment}" for segment in range(12)]
    assert stamps(split) == [BEGIN_NS + i * 100_000_000 for i in range(600)]


def test_the_unfinished_segment_of_a_killed_recorder_is_read(split):
    last = split / "bag_11.mcap"
    last.rename(split / "bag_11.mcap.part")
    (split / "bag_12.mcap.part").touch()  # killed when it had just begun
    assert len(stamps(split)) == 600
    (split / "bag_11.mcap").write_bytes((split / "bag_11.mcap.part").read_bytes())  # killed while recovering
    assert len(stamps(split)) == 600


def test_a_folder_of_unfinished_segments_is_a_recording(split):
    for path in split.glob("*.mcap"):
        path.rename(path.with_suffix(".mcap.part"))
    assert len(stamps(split)) == 600


def test_an_empty_segment_is_reported_not_in_the_way(split, capsys):
    (split / "bag_12.mcap").touch()
    assert main(["info", str(split)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "bag_12.mcap is empty" in line


def test_info_names_topics_as_the_recording_does(split, asl_folder, capsys):
    assert main(["info", str(split), "--json"]) == 0
    assert [topic["topic"] for topic in json.loads(capsys.readouterr().out)["topics"]] == ["/" + IMU]
    assert main(["info", str(asl_folder), "--json"]) == 0
    topics = [topic["topic"] for topic in json.loads(capsys.readouterr().out)["topics"]]
    assert topics == ["mav0/cam0/corners.csv", "mav0/imu0/data.csv"]


def test_info_of_a_folder_says_as_much_as_of_its_files(tmp_path, capsys):
    for segment in range(2):
        with LogWriter(tmp_path / f"a_{segment}.mcap", {"vical": {"segment": str(segment)}}) as writer:
            for i in range(50 * segment, 50 * segment + 50):
                stamp = BEGIN_NS + i * 10_000_000
                payload = m.encode_imu(stamp, "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))
                writer.write(IMU, payload, stamp + 3_000_000)
            writer.write("vical/rig0/command/record", m.encode_string("start"), stamp)
            writer.attach("config.yaml", "text/yaml", b"rig: rig0", stamp)
    assert main(["info", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    command, imu = found["topics"]
    assert (command["count"], imu["count"], imu["latency_ms"]) == (2, 100, [3.0, 3.0])
    assert found["metadata"]["vical"]["segment"] == "1" and found["attachments"] == {"config.yaml": 9}


def test_a_file_that_is_being_written_is_the_same_in_every_pass(tmp_path):
    """Stamps that are put on an even grid in the second pass are those of the first."""
    rng = np.random.default_rng(1)
    writer = LogWriter(tmp_path / "a.mcap")

    def write(begin: int, end: int) -> None:
        for i in range(begin, end):
            t_s = 0.01 * i
            gyro = (float(np.sin(3 * t_s)), float(np.cos(2 * t_s)), float(np.sin(t_s)))
            stamp = BEGIN_NS + round(1e7 * i + abs(3e6 * rng.normal()))
            writer.write(IMU, m.encode_imu(stamp, "imu0", gyro, (0.0, 0.0, 9.8)), stamp)
        writer.flush()

    write(0, 2000)
    recording = open_recording(writer.part_path, check=False)
    assert any("put on an even grid" in warning for warning in recording.warnings)
    write(2000, 2500)
    assert sum(1 for _ in recording.messages()) == 2000
    writer.close()
    assert sum(1 for _ in recording.messages()) == 2000  # finished, and renamed


def test_segments_that_are_finished_while_a_folder_is_read_are_not_lost(split, monkeypatch):
    """A recorder that rotates gives its part the final name between two looks at the folder."""
    part = (split / "bag_11.mcap").rename(split / "bag_11.mcap.part")
    glob = Path.glob

    def then_finished(folder, pattern):
        yield from list(glob(folder, pattern))
        if part.exists():
            part.rename(split / "bag_11.mcap")

    monkeypatch.setattr(Path, "glob", then_finished)
    assert len(stamps(split)) == 600
    (split / "bag_11.mcap").rename(part)
    found = segments_in(split)
    if part.exists():
        part.rename(split / "bag_11.mcap")
    assert len(found) == 12 and LogReader(part).channels == []
    assert sum(1 for _ in LogReader(part).messages()) == 50
