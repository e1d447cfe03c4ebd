"""Folders of images as people have them: how they are named, listed, and what else lies among them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vical_daemon.bus.messages import decode_compressed_image
from vical_daemon.logs import RecordingError, open_recording

COUNT = 12


@pytest.fixture
def write(tmp_path, a_motion, write_asl):
    """A recording whose i-th image has the grey level i; `name` makes its name of number and stamp, ns."""

    def make(name, table=None, suffix="png"):
        folder = write_asl(tmp_path / "a", corners=False)
        (folder / "mav0/cam0/data").mkdir()
        stamps = a_motion()[0][100 : 100 + 20 * COUNT : 20].tolist()
        for i, t in enumerate(stamps):
            image = cv2.imencode(f".{suffix}", np.full((6, 8), i, np.uint8))[1].tobytes()
            (folder / f"mav0/cam0/data/{name(i, t)}.{suffix}").write_bytes(image)
        if table is not None:
            where, line = table
            (folder / where).write_text("".join(line(i, t) + "\n" for i, t in enumerate(stamps)))
        return folder, stamps

    return make


def levels(recording):
    """Stamp and grey level of each image."""
    out = []
    for _, payload in recording.messages([recording.cameras["cam0"]]):
        message = decode_compressed_image(payload)
        image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        out.append((message.stamp_ns, int(image[0, 0])))
    return out


@pytest.mark.parametrize(
    ("name", "table"),
    [
        (lambda i, t: f"{i}", ("mav0/cam0/times.txt", lambda i, t: f"{t // 10**9}.{t % 10**9:09d}")),
        (lambda i, t: f"{i:06d}", ("mav0/cam0/data/times.txt", lambda i, t: f"{i:06d} {t * 1e-9:.9f} 0.01")),
        (lambda i, t: f"frame{i}", ("mav0/timestamps.txt", lambda i, t: f"{t}")),
        (lambda i, t: f"{i}", ("mav0/VID_20260101_timestamps.csv", lambda i, t: f"{t}")),
        (lambda i, t: f"{i}", ("mav0/cam0/frame_timestamps.txt", lambda i, t: f"{t}")),
        (
            lambda i, t: f"{i}",
            (
                "mav0/cam0/times.txt",
                lambda i, t: "# id timestamp name\n" * (not i) + f"{i} {t * 1e-9:.9f} {i}.png",
            ),
        ),
        (lambda i, t: f"{i}", ("mav0/cam0/timestamps.csv", lambda i, t: "time\n" * (not i) + f"{t}")),
        (lambda i, t: f"{t}", ("mav0/cam0/data.csv", lambda i, t: f"{t},{t}")),
        (lambda i, t: f"{t}", ("mav0/cam0/data.csv", lambda i, t: f"{t},cam0/data/{t}.png")),
    ],
    ids=[
        "numbers",
        "numbers with their stamps",
        "ns",
        "OpenCamera",
        "MARS",
        "a title that names the stamps",
        "a title",
        "no ending",
        "folders in the table",
    ],
)
def test_images_get_their_stamps(write, name, table):
    folder, stamps = write(name, table)
    found = levels(open_recording(folder, as_recorded=True))
    assert [level for _, level in found] == list(range(COUNT))
    assert np.abs(np.array([t for t, _ in found]) - stamps).max() < 1000  # seconds in double precision


@pytest.mark.parametrize(
    ("name", "line"),
    [
        (lambda i, t: f"frame_{i + 1}", lambda i, t: "frame,timestamp\n" * (not i) + f"{i + 1},{t}"),
        (lambda i, t: f"img{i:04d}", lambda i, t: f"img{i:04d}.png {t // 10**9}.{t % 10**9:09d}"),
        (lambda i, t: f"{i:06d}", lambda i, t: f"{i};{t}"),
    ],
)
def test_lines_of_images_that_are_not_there_are_passed_over(write, name, line):
    folder, stamps = write(name, ("mav0/cam0/timestamps.csv", line))
    images = sorted((folder / "mav0/cam0/data").iterdir())
    for path in (images[0], images[5]):
        path.unlink()
    left = [int(path.stem.strip("_aefgimr")) - (path.stem[:5] == "frame") for path in images if path.exists()]
    assert [level for _, level in levels(open_recording(folder))] == sorted(left)
    assert [t for t, _ in levels(open_recording(folder))] == [stamps[i] for i in sorted(left)]


def test_images_may_be_in_folders_inside_but_not_those_of_two_cameras(write):
    folder, stamps = write(lambda i, t: f"{t}")
    images = sorted((folder / "mav0/cam0/data").iterdir())
    for k, path in enumerate(images):
        place = folder / f"mav0/cam0/part{k // 5}"
        place.mkdir(exist_ok=True)
        path.rename(place / path.name)
    assert levels(open_recording(folder)) == list(zip(stamps, range(COUNT), strict=True))
    (folder / "mav0/cam0/part0" / images[7].name).write_bytes(b"the same name")
    assert not open_recording(folder).cameras


def test_a_list_of_another_length_is_not_used(write):
    folder, _ = write(lambda i, t: f"{i}", ("mav0/cam0/times.txt", lambda i, t: f"{t}\n{t + 1}"))
    recording = open_recording(folder)
    assert not recording.cameras
    assert any("nor a times.txt with as many lines, and names like 0.png" in w for w in recording.warnings)


def test_files_that_do_not_belong_to_the_images_are_left_out(write):
    folder, _ = write(lambda i, t: f"{t}")
    data = folder / "mav0/cam0/data"
    (data / "._1600000000000000000.png").write_bytes(b"of macOS")
    (data / "preview.png").write_bytes(next(data.iterdir()).read_bytes())
    recording = open_recording(folder)
    assert len(levels(recording)) == COUNT
    assert any("cam0: 1 images left out, whose names are no stamps" in w for w in recording.warnings)


def test_a_damaged_first_image_does_not_hide_the_size(write):
    folder, stamps = write(lambda i, t: f"{t}")
    (folder / f"mav0/cam0/data/{stamps[0]}.png").write_bytes(b"\x89PNG")
    assert open_recording(folder).cameras["cam0"].resolution == (8, 6)


def test_images_of_another_kind_are_named(write):
    folder, _ = write(lambda i, t: f"{t}", suffix="tiff")
    recording = open_recording(folder)
    assert not recording.cameras
    assert any(f"cam0: {COUNT} unreadable images, like 16" in w for w in recording.warnings)


def test_a_table_does_not_lead_out_of_the_folder(write):
    folder, _ = write(lambda i, t: f"{t}", ("mav0/cam0/data.csv", lambda i, t: f"{t},../{t}.png"))
    with pytest.raises(RecordingError, match=r"line 1: expected 'timestamp \[ns\],filename'"):
        open_recording(folder)


@pytest.mark.parametrize("size", ["[752, 480]", "[6, 8]"])
def test_images_have_the_size_that_they_have(write, size):
    """They were made smaller, or the file is of another camera: all of them were refused, silently."""
    folder, _ = write(lambda i, t: f"{t}")
    (folder / "mav0/cam0/sensor.yaml").write_text(f"sensor_type: camera\nresolution: {size}\n")
    assert open_recording(folder).cameras["cam0"].resolution == (8, 6)
