"""Tables as spreadsheets and archives leave them, and folders that hold more than one recording."""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path

import pytest

from vical_daemon.config.priors import Initial
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.logs.summary import summarise_recording
from vical_daemon.offline.calibration_job import make_job
from vical_daemon.offline.errors import InputError


@pytest.fixture
def folder(asl_folder, tmp_path) -> Path:
    """A copy that a test may change."""
    return shutil.copytree(asl_folder, tmp_path / "asl")


def tables(folder: Path) -> list[Path]:
    return [folder / "mav0" / "imu0" / "data.csv", folder / "mav0" / "cam0" / "corners.csv"]


def messages(folder: Path) -> list[tuple[str, bytes]]:
    return list(open_recording(folder).messages())


def test_packed_tables_are_read_like_others(folder):
    before = messages(folder)
    for path in tables(folder):
        path.with_name(path.name + ".gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    assert messages(folder) == before


def test_quoted_cells_are_numbers(folder):
    before = messages(folder)
    for path in tables(folder):
        lines = path.read_text().splitlines()
        path.write_text("\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in lines))
    assert messages(folder) == before


def test_decimal_commas_are_named(folder):
    """Each number would be read as two: the accelerometer read 1e16 m/s^2."""
    for path in tables(folder):
        title, *rows = path.read_text().splitlines()
        path.write_text("\n".join([title, *(row.replace(".", ",") for row in rows)]))
    with pytest.raises(RecordingError, match="more columns than its title: write decimal points, not commas"):
        open_recording(folder)


def test_a_recording_without_its_imu_says_what_was_found(folder):
    tables(folder)[0].unlink()
    with pytest.raises(RecordingError, match=r"holds no IMU data: found only .*corners\.csv"):
        open_recording(folder)


def test_files_of_two_rigs_are_not_mixed(asl_folder, tmp_path):
    for rig in ("rover", "drone"):
        with LogWriter(tmp_path / f"{rig}.mcap") as writer:
            for key, payload in open_recording(asl_folder).messages():
                writer.write(key.replace("rig0", rig), payload, stamp_of(payload))
    with pytest.raises(RecordingError, match=r"holds imu0 of two rigs, \w+ and \w+: give the files of one"):
        open_recording(tmp_path)
    topics = ["vical/rover/imu/imu0", "vical/rover/camera/cam0/points"]
    assert open_recording(tmp_path, topics=topics).rig == "rover"


def test_a_copy_in_the_folder_is_named(asl_folder, tmp_path):
    for name in ("a", "copy of a"):
        with LogWriter(tmp_path / f"{name}.mcap") as writer:
            for key, payload in open_recording(asl_folder).messages():
                writer.write(key, payload, stamp_of(payload))
    with pytest.raises(RecordingError, match="is one of the files a copy of another"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("files", "says"),
    [
        (["run1/mav0/x", "run2/a.bag"], "found recordings in it: give one of run1, run2"),
        (["img/0.png", "imu.txt"], r"found images in img/, tables imu\.txt$"),
        (["movie.MP4", "gyro.csv"], r"imu0\.csv and a video; found tables gyro\.csv, videos movie\.MP4$"),
        (["0.png", "imu0.csv"], r"found images in the folder itself"),
        (["cam0.zip", "imu0.csv"], r"found cam0\.zip \(unpack: unzip cam0\.zip\)"),
        (["movie.h264", "imu0.csv"], r"found movie\.h264 \(without stamps that can be read: convert it"),
        (["left/data/0.jpg", "imu0.csv"], r"cam0, cam1 \.\.\.; found images in left/data/"),
        (["cam0/1600000000000000000.png", "imu0.txt"], r"no IMU data: .* images in cam0/, tables imu0\.txt"),
    ],
)
def test_what_may_have_been_meant_is_named(tmp_path, asl_folder, files, says):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    if "imu0.csv" in files:
        shutil.copyfile(asl_folder / "mav0/imu0/data.csv", tmp_path / "imu0.csv")
    with pytest.raises((RecordingError, InputError), match=says) as refused:
        make_job(open_recording(tmp_path), Initial(), target=None)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("part", ["mav0/cam0", "mav0/imu0", "mav0/imu0/data.csv"])
def test_a_part_in_place_of_the_recording_is_named(folder, part):
    says = f"it is part of a recording: give {folder}/mav0"
    with pytest.raises((RecordingError, InputError), match=says) as refused:
        make_job(open_recording(folder / part), Initial(), target=None)
    assert "\n" not in str(refused.value)


def test_a_video_is_no_recording(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"x")
    with pytest.raises(RecordingError, match=r"a\.mp4 is a video: give the folder that holds it and a table"):
        open_recording(tmp_path / "a.mp4")


def test_a_table_alone_is_listed_by_its_name(asl_folder):
    """`vical info` had called it "."."""
    summary = summarise_recording(open_recording(asl_folder / "mav0/imu0/data.csv"))
    assert [topic.topic for topic in summary.topics] == ["data.csv"]
