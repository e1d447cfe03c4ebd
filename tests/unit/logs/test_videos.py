"""Videos as cameras of a folder: stamps, images, and files that are none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vical_daemon.bus.messages import decode_image
from vical_daemon.config.priors import Initial
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.offline.calibration_job import make_job
from vical_daemon.offline.errors import InputError
from vical_daemon.vision.video import Video

SIZE = (64, 48)  # px
COUNT, FPS = 45, 15.0


def film(path, count=COUNT, codec="MJPG", size=SIZE):
    """Write a video of an edge that moves by 1 px from one image to the next."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), FPS, size)
    assert writer.isOpened()
    for k in range(count):
        image = np.zeros((size[1], size[0], 3), np.uint8)
        image[:, : k + 8] = 255
        writer.write(image)
    writer.release()
    return path


@pytest.fixture
def folder(tmp_path, write_asl):
    """An IMU's table alone."""
    data = (write_asl(tmp_path / "asl", corners=False) / "mav0/imu0/data.csv").read_text()
    (tmp_path / "a").mkdir()
    (tmp_path / "a/imu0.csv").write_text(data)
    return tmp_path / "a"


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "MJPG"), ("a.MP4", "mp4v"), ("a.mkv", "mp4v")])
def test_images_come_with_the_stamps_of_the_video_and_in_grey(tmp_path, name, codec):
    video = Video(film(tmp_path / name, codec=codec))
    step_s = 1e-3 if name.endswith("mkv") else 1e-6  # Matroska counts ms
    np.testing.assert_allclose(video.t_ns * 1e-9, np.arange(COUNT) / FPS, atol=step_s)
    assert (video.size, video.announced, video.turned_deg) == (SIZE, COUNT, 0)
    for k in (0, 1, 2, 40, 3, 44):  # forwards, over some, and back
        image = video.image(k)
        assert image.shape == SIZE[::-1]
        assert np.mean(image > 127) * SIZE[0] == k + 8


def test_a_video_beside_a_table_is_a_camera_that_begins_with_the_imu_at_first(folder):
    film(folder / "GX010007.MP4", codec="mp4v")
    recording = open_recording(folder)
    camera = recording.cameras["cam0"]
    assert (camera.kind, camera.count, camera.resolution) == ("image", COUNT, SIZE)
    assert camera.begin_ns == recording.imus["imu0"].begin_ns
    assert recording.unplaced == {"cam0"}
    recording.place("cam0", 2_500_000_000)
    stamps = [
        decode_image(payload).stamp_ns for _, payload in recording.messages([recording.cameras["cam0"]])
    ]
    assert stamps[0] == recording.cameras["cam0"].begin_ns == camera.begin_ns + 2_500_000_000
    assert recording.added_ns["cam0"] == stamps[0]
    assert not recording.unplaced


def test_stamps_of_a_file_next_to_the_video_are_those_of_the_imu(folder):
    film(folder / "VID_1.mp4", codec="mp4v")
    begin_ns = open_recording(folder, check=False).imus["imu0"].begin_ns
    stamps = [begin_ns + round(k * 1e9 / FPS) + 1_000_000_000 for k in range(COUNT)]
    (folder / "VID_1_timestamps.csv").write_text("\n".join(map(str, stamps)) + "\n")
    (folder / "another_timestamps.csv").write_text("1\n")
    recording = open_recording(folder)
    assert recording.cameras["cam0"].begin_ns == stamps[0]
    assert not recording.unplaced
    (folder / "VID_1_timestamps.csv").write_text("\n".join(map(str, stamps[:-1])) + "\n")
    recording = open_recording(folder)
    assert recording.unplaced == {"cam0"}
    assert any("timestamps.csv is not used: it has no line" in text for text in recording.warnings)


def test_videos_are_cameras_by_their_names(folder):
    for name in ("cam0.avi", "cam2.avi", "another.avi", "._cam3.avi"):
        film(folder / name) if name[0] != "." else (folder / name).write_bytes(b"Mac OS X")
    (folder / "cam1").mkdir()
    film(folder / "cam1" / "x.avi")
    assert list(open_recording(folder).cameras) == ["cam0", "cam1", "cam2"]
    assert list(open_recording(folder, cameras=["cam1"]).cameras) == ["cam1"]


def test_videos_of_several_recordings_are_not_cameras_of_one(folder):
    for name in ("GX010001.MP4", "GX010002.MP4"):
        film(folder / name, codec="mp4v")
    with pytest.raises(
        InputError, match=r"of the videos GX010001\.MP4, GX010002\.MP4\? Name those"
    ) as refused:
        make_job(open_recording(folder), Initial(), target=None)
    assert "\n" not in str(refused.value)


def test_images_go_before_the_video_that_they_are_from(folder):
    film(folder / "movie.avi")
    (folder / "cam0").mkdir()
    begin_ns = open_recording(folder, check=False).imus["imu0"].begin_ns
    for k in range(5):
        cv2.imwrite(str(folder / f"cam0/{begin_ns + k * 10**8}.png"), np.zeros((48, 64), np.uint8))
    assert open_recording(folder).cameras["cam0"].kind == "compressed"


def cut_in_the_middle(path):
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


BAD = {
    "cut.mp4": cut_in_the_middle,  # its index was at the end
    "text.mp4": lambda path: path.write_text("no video"),
    "empty.mov": lambda path: path.write_bytes(b""),
    "playlist.mp4": lambda path: path.write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_file_that_is_no_video_is_named_in_one_line(folder, name, capfd):
    BAD[name](film(folder / name, codec="mp4v"))
    with pytest.raises(
        RecordingError, match=rf"{name[:-4]}\.m.. is no video that OpenCV can read"
    ) as refused:
        open_recording(folder)
    assert "\n" not in str(refused.value)
    assert capfd.readouterr() == ("", "")  # neither OpenCV nor FFmpeg prints


def test_a_video_that_is_cut_off_is_read_as_far_as_it_goes(folder, capfd):
    cut_in_the_middle(film(folder / "a.avi"))
    recording = open_recording(folder)
    count = recording.cameras["cam0"].count
    assert 10 < count < COUNT
    assert any(f"{count} of the {COUNT} images that a.avi announces" in text for text in recording.warnings)
    assert len(list(recording.messages([recording.cameras["cam0"]]))) == count
    assert capfd.readouterr() == ("", "")


def test_a_video_that_players_turn_is_used_as_the_sensor_read_it(folder):
    path = film(folder / "a.mp4", codec="mp4v")
    data, one = path.read_bytes(), (65536).to_bytes(4, "big")
    begin = data.index(b"tkhd") + 44  # the matrix of the track's header, ISO 14496-12
    assert data[begin : begin + 4] == one
    turned = b"".join([bytes(4), one, bytes(4), (-65536).to_bytes(4, "big", signed=True)])
    path.write_bytes(data[:begin] + turned + bytes(4) + data[begin + 20 :])
    recording = open_recording(folder)
    assert recording.cameras["cam0"].resolution == SIZE
    assert any("players turn a.mp4 by 90 deg" in text for text in recording.warnings)
    _, payload = next(iter(recording.messages([recording.cameras["cam0"]])))
    assert decode_image(payload).pixels().shape == SIZE[::-1]
