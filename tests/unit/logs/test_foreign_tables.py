"""Tables with other separators, decimal commas and dates; KITTI's raw folders; dates in names of images."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import cv2
import numpy as np
import pytest

from vical_daemon.bus.messages import decode_compressed_image
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.logs.stamps import date_ns, stamp_in_name
from vical_daemon.logs.trajectory import read_trajectory


def date(t_ns, sep="T", zone=UTC, digits=9, ending=""):
    at = datetime.fromtimestamp(t_ns // 10**9, tz=zone)
    return f"{at:%Y-%m-%d}{sep}{at:%H:%M:%S}.{t_ns % 10**9:09d}"[: 20 + digits] + ending


def rewritten(folder, cell_of, separator, stamp):
    """Write both tables of a folder in another way."""
    for path in (folder / "mav0/imu0/data.csv", folder / "mav0/cam0/corners.csv"):
        title, *rows = path.read_text().splitlines()
        lines = [title.replace(",", separator)]
        for row in rows:
            first, *cells = row.split(",")
            lines.append(separator.join([stamp(int(first)), *map(cell_of, cells)]))
        path.write_text("\n".join(lines) + "\n")
    return folder


WRITTEN = {
    "semicolons": (str, ";", str),
    "decimal commas": (lambda cell: cell.replace(".", ","), ";", str),
    "decimal commas and tabs": (lambda cell: cell.replace(".", ","), "\t", str),
    "spaces": (str, "  ", str),
    "dates": (str, ",", date),
    "dates with a blank": (str, ",", lambda t: date(t, " ")),
    "dates between spaces": (str, " ", lambda t: date(t, " ")),
    "Zulu": (str, ",", lambda t: date(t, ending="Z")),
    "dates with a zone": (
        str,
        ",",
        lambda t: date(t, " ", timezone(-timedelta(hours=3, minutes=30)), ending="-03:30"),
    ),
    "Excel in German": (lambda cell: cell.replace(".", ","), ";", lambda t: date(t, " ").replace(".", ",")),
}


@pytest.mark.parametrize("way", WRITTEN)
def test_the_way_a_table_is_written_changes_nothing(asl_folder, tmp_path, way):
    expected = list(open_recording(asl_folder).messages())
    folder = rewritten(shutil.copytree(asl_folder, tmp_path / "asl"), *WRITTEN[way])
    assert list(open_recording(folder).messages()) == expected


def test_a_comma_followed_by_a_tab_is_one_separator(asl_folder, tmp_path):
    expected = list(open_recording(asl_folder).messages())
    folder = rewritten(shutil.copytree(asl_folder, tmp_path / "asl"), str, ",\t", str)
    assert list(open_recording(folder).messages()) == expected


def test_a_title_between_spaces_names_the_columns(asl_folder, tmp_path):
    expected = list(open_recording(asl_folder).messages())
    folder = shutil.copytree(asl_folder, tmp_path / "asl")
    path = folder / "mav0/imu0/data.csv"
    cells = [row.split(",") for row in path.read_text().splitlines()[1:]]
    lines = ["# recorded by hand", "# id timestamp [ns] a_x [m s^-2] a_y a_z w_x [rad / s] w_y w_z"]
    lines += [" ".join([str(i), *(row[k] for k in (0, 4, 5, 6, 1, 2, 3))]) for i, row in enumerate(cells)]
    path.write_text("\n".join(lines))
    assert list(open_recording(folder).messages()) == expected


@pytest.mark.parametrize(
    "above",
    ["sep=,\n", "# recorded by hand\n# 2026-01-31 12:00, 200 Hz\n", "Recorder;Version 3\n\nby: hand, me\n"],
    ids=["Excel", "comments", "text"],
)
def test_lines_above_the_title_do_not_hide_the_order_of_the_columns(asl_folder, tmp_path, above):
    expected = list(open_recording(asl_folder).messages())
    folder = shutil.copytree(asl_folder, tmp_path / "asl")
    path = folder / "mav0/imu0/data.csv"
    rows = path.read_text().splitlines()[1:]
    rows = [",".join([c[0], *c[4:], *c[1:4]]) for c in (row.split(",") for row in rows)]
    path.write_text(above + "time,ax,ay,az,gx,gy,gz\n" + "\n".join(rows) + "\n")
    assert list(open_recording(folder).messages()) == expected


def test_a_table_of_both_sensors_in_turns_is_named(asl_folder, tmp_path):
    folder = shutil.copytree(asl_folder, tmp_path / "asl")
    path = folder / "mav0/imu0/data.csv"
    path.write_text("sensor,time,x,y,z\n" + "gyroscope,1,2,3,4\naccelerometer,1,2,3,4\n" * 20)
    with pytest.raises(
        RecordingError, match=r"line 2 is not 7 numbers \(gyro and accelerometer in two tables"
    ):
        open_recording(folder)


def test_unicode_text_of_a_spreadsheet_is_read(asl_folder, tmp_path):
    expected = list(open_recording(asl_folder).messages())
    folder = shutil.copytree(asl_folder, tmp_path / "asl")
    path = folder / "mav0/imu0/data.csv"
    path.write_text(path.read_text().replace(",", "\t"), encoding="utf-16")
    assert list(open_recording(folder).messages()) == expected


def test_an_imu_may_be_a_text_file(asl_folder, tmp_path):
    expected = list(open_recording(asl_folder).messages())
    folder = shutil.copytree(asl_folder, tmp_path / "asl")
    (folder / "mav0/imu0/data.csv").rename(folder / "mav0/imu0.txt")
    assert list(open_recording(folder).messages()) == expected


def test_rounded_dates_widen_the_time_shift(asl_folder, tmp_path):
    folder = rewritten(
        shutil.copytree(asl_folder, tmp_path / "asl"), str, ",", lambda t: date(t + 123_456, digits=3)
    )
    sigma_s = open_recording(folder, as_recorded=True).stamp_sigma_s
    assert sigma_s.get("imu0", 0.0) in (0.0, pytest.approx(1e-3 / 12**0.5))


def test_a_damaged_date_is_named(asl_folder, tmp_path):
    folder = rewritten(shutil.copytree(asl_folder, tmp_path / "asl"), str, ",", date)
    path = folder / "mav0/imu0/data.csv"
    lines = path.read_text().splitlines()
    lines[7] = "2026-13-01T" + lines[7][11:]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordingError, match=r"row 7 of the data: its stamp is no number: '2026-13-01T"):
        open_recording(folder)


@pytest.mark.parametrize("sep", [" ", "T"])
@pytest.mark.parametrize(("between", "last"), [(" ", "1 0 0 0"), (",", "0 0 0 1")])
def test_trajectories_may_have_dates(tmp_path, sep, between, last):
    """TUM has w last; with commas a title tells."""
    path = tmp_path / "t.txt"
    title = "time,px,py,pz,qw,qx,qy,qz" if between == "," else ""
    values = ["0.5"] * 3 + (last.split()[::-1] if between == "," else last.split())
    rows = [between.join([date(10**18 + k * 10**8, sep), *values]) for k in range(5)]
    path.write_text("\n".join([title, *rows]))
    found = read_trajectory(path)
    assert found.t_ns.tolist() == [10**18 + k * 10**8 for k in range(5)]
    assert found.q_wxyz[0].tolist() == ([1, 0, 0, 0] if between == "," else [0, 1, 0, 0])


def test_trajectories_may_have_decimal_commas(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("t;x;y;z;qx;qy;qz;qw\n0,5;1,5;0;0;0,6;0;0;0,8\n0,6;1,5;0;0;0,6;0;0;0,8\n")
    assert read_trajectory(path).q_wxyz[0].tolist() == [0.8, 0.6, 0, 0]


def test_dates_are_exact():
    assert date_ns("2026-01-31T12:00:00.123456789Z") == 1769860800123456789
    assert date_ns("2026-01-31 13:00:00,5+0100") == 1769860800500000000
    assert date_ns("2026-01-31T12:00:00 UTC") == 1769860800000000000
    for text in ("2026-02-30T12:00:00", "2026-01-31", "1769860800", "31.01.2026 12:00:00"):
        assert date_ns(text) is None


@pytest.mark.parametrize(
    ("name", "stamp"),
    [
        ("2026-01-31T12-00-00.123456", "2026-01-31T12:00:00.123456"),
        ("cam0_20260131_120000_123456789", "2026-01-31T12:00:00.123456789"),
        ("IMG_20260131_120000123", "2026-01-31T12:00:00.123"),
        ("20260131120000123", "2026-01-31T12:00:00.123"),
        ("2026-01-31 12_00_00.123_left", "2026-01-31T12:00:00.123"),
        ("IMG_20260131_120000", ""),  # of whole seconds
        ("1403636579763555584", "1403636579763555584"),
        ("2026013112000000000", "2026013112000000000"),  # UNIX time of the year 2034, ns
        ("1305031102.175304", "1305031102.175304"),
        ("frame-1403636579763555584_a", "1403636579763555584"),
        ("000123", ""),
    ],
)
def test_stamps_in_names(name, stamp):
    assert stamp_in_name(name) == stamp


def image(level):
    return cv2.imencode(".png", np.full((6, 8), level, np.uint8))[1].tobytes()


@pytest.fixture
def kitti(tmp_path, a_motion):
    """A raw folder of KITTI's: `make(every)` keeps every so many readings of 200 Hz."""

    def make(every=2, images=12, cut=0):
        folder = tmp_path / "2011_09_26_drive_0001_extract"
        for name in ("image_00", "oxts"):
            (folder / name / "data").mkdir(parents=True)
        t_ns, gyro, force = a_motion()
        names = "lat lon alt roll pitch yaw vn ve vf vl vu ax ay az af al au wx wy wz wf wl wu pos_accuracy"
        names = [*names.split(), "vel_accuracy", "navstat", "numsats", "posmode", "velmode", "orimode"]
        (folder / "oxts/dataformat.txt").write_text("".join(f"{n}:   what {n} is (unit)\n" for n in names))
        stamps = []
        for i, k in enumerate(range(0, len(t_ns), every)):
            row = [*[7.0] * 11, *force[k], 7, 7, 7, *gyro[k], *[8.0] * 10]
            (folder / f"oxts/data/{i:010d}.txt").write_text(" ".join(map(repr, map(float, row))) + " \n")
            stamps.append(date(int(t_ns[k]), " "))
        (folder / "oxts/timestamps.txt").write_text("\n".join(stamps[: len(stamps) - cut]) + "\n")
        of_images = t_ns[100 : 100 + 20 * images : 20].tolist()
        for i in range(images):
            (folder / f"image_00/data/{i:010d}.png").write_bytes(image(i))
        (folder / "image_00/timestamps.txt").write_text("".join(date(t, " ") + "\n" for t in of_images))
        return folder, t_ns[::every], gyro[::every], force[::every], of_images

    return make


def test_a_raw_folder_of_kitti_is_read(kitti):
    folder, t_ns, gyro, force, of_images = kitti()
    recording = open_recording(folder, as_recorded=True)
    imu = recording.imu_arrays("oxts")
    assert (imu.t_ns == t_ns).all() and (imu.gyro_rps == gyro).all()
    assert (imu.specific_force_mps2 == force).all()
    found = [decode_compressed_image(m) for _, m in recording.messages([recording.cameras["image_00"]])]
    assert [m.stamp_ns for m in found] == of_images
    assert found[5].data == image(5)


def test_the_imu_of_a_synced_folder_is_too_slow(kitti):
    folder = kitti(every=21)[0]
    with pytest.raises(
        RecordingError, match=r"oxts: 9\.52 samples a second.*KITTI.*_extract.*100 Hz"
    ) as refused:
        open_recording(folder)
    assert "\n" not in str(refused.value)


def test_a_folder_of_readings_that_is_not_whole_is_named(kitti):
    with pytest.raises(RecordingError, match=r"oxts: 1200 files in data/, but 1198 lines in timestamps.txt"):
        open_recording(kitti(cut=2)[0])


def test_readings_that_are_not_there_are_lost_alone(kitti):
    folder, t_ns, *_ = kitti()
    for i in (50, 51, 52):
        (folder / f"oxts/data/{i:010d}.txt").unlink()
    recording = open_recording(folder, as_recorded=True)
    assert recording.imu_arrays("oxts").t_ns.tolist() == np.delete(t_ns, [50, 51, 52]).tolist()
    assert any("about 3 samples missing in 1 holes" in w for w in recording.warnings)


def test_the_folder_of_a_day_names_its_drives(kitti):
    folder = kitti()[0]
    with pytest.raises(RecordingError, match=f"found recordings in it: give one of {folder.name}"):
        open_recording(Path(folder).parent)


@pytest.mark.parametrize(
    ("name", "refused"),
    [
        (lambda i, t: date(t, digits=6).replace(":", "-"), False),
        (lambda i, t: "left_" + date(t, digits=3).replace("-", "").replace(":", "").replace("T", "_"), False),
        (lambda i, t: f"IMG_20260131_120000_{i:03d}", True),
        (lambda i, t: f"IMG_20260131_1200{i:02d}", True),
    ],
    ids=["ISO", "digits", "a counter behind a date", "whole seconds"],
)
def test_names_of_images_hold_dates(tmp_path, write_asl, a_motion, name, refused):
    folder = write_asl(tmp_path / "a", corners=False)
    (folder / "mav0/cam0/data").mkdir()
    stamps = a_motion()[0][100:340:20].tolist()
    for i, t in enumerate(stamps):
        (folder / f"mav0/cam0/data/{name(i, t)}.png").write_bytes(image(i))
    recording = open_recording(folder, as_recorded=True)
    if refused:
        assert not recording.cameras
        assert any("cam0" in w and "nor dates to 1 ms" in w for w in recording.warnings)
        return
    found = [decode_compressed_image(m) for _, m in recording.messages([recording.cameras["cam0"]])]
    assert np.abs(np.array([m.stamp_ns for m in found]) - stamps).max() < 1_000_000
    assert [m.data for m in found] == [image(i) for i in range(len(stamps))]
