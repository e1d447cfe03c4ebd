"""Tables with empty cells, a line of units below the title, a mark at the beginning, other line ends."""

from __future__ import annotations

import numpy as np
import pytest

from vical_daemon.logs import RecordingError, open_recording

TITLE = "timestamp,wx,wy,wz,ax,ay,az"


def rewritten(folder, change):
    path = folder / "mav0/imu0/data.csv"
    path.write_bytes(change(path.read_text().splitlines()))
    return open_recording(folder)


def lines(rows):
    return ("\n".join(rows) + "\n").encode()


@pytest.mark.parametrize("missing", ["", "NA", " null ", "nan"])
def test_readings_with_missing_cells_are_left_out_and_counted(tmp_path, write_asl, missing):
    def change(rows):
        return lines([*rows[:99], rows[99].split(",")[0] + f",{missing}" * 6, *rows[100:]])

    before = open_recording(write_asl(tmp_path / "a")).imu_arrays("imu0")
    after = rewritten(write_asl(tmp_path / "b"), change)
    assert "imu0: 1 samples that are not finite, or all 0, left out" in after.warnings
    np.testing.assert_array_equal(after.imu_arrays("imu0").gyro_rps, np.delete(before.gyro_rps, 98, axis=0))


@pytest.mark.parametrize(
    "change",
    [
        lambda rows: lines([TITLE, "ns,rad/s,rad/s,rad/s,m/s^2,m/s^2,m/s^2", *rows[1:]]),
        lambda rows: b"\xef\xbb\xbf" + lines(rows[1:]),
        lambda rows: lines(rows).replace(b"\n", b"\r"),
        lambda rows: lines(rows).replace(b"\n", b"\r\n"),
    ],
    ids=["units", "BOM", "CR", "CRLF"],
)
def test_no_reading_is_lost(tmp_path, write_asl, change):
    before = open_recording(write_asl(tmp_path / "a")).imu_arrays("imu0")
    after = rewritten(write_asl(tmp_path / "b"), change).imu_arrays("imu0")
    np.testing.assert_array_equal(after.t_ns, before.t_ns)
    np.testing.assert_array_equal(after.gyro_rps, before.gyro_rps)


def test_rows_of_one_sensor_in_turns_are_named(tmp_path, write_asl):
    """As joined tables of a gyro and an accelerometer are."""

    def change(rows):
        cells = [row.split(",") for row in rows[1:]]
        return lines(
            [rows[0]]
            + [
                ",".join(c[:4]) + ",,," if k % 2 else f"{c[0]},,,," + ",".join(c[4:])
                for k, c in enumerate(cells)
            ]
        )

    with pytest.raises(RecordingError, match="no row holds both gyro and accelerometer"):
        rewritten(write_asl(tmp_path / "a"), change)


def test_stamps_in_seconds_may_begin_with_a_whole_one(tmp_path, write_asl):
    """0, 0.005, ...: the first was taken for that of a table of integers, and the second refused."""

    def change(rows):
        cells = [row.split(",", 1) for row in rows[1:]]
        begin = int(cells[0][0])
        return lines([rows[0], *(f"{(int(t) - begin) * 1e-9:.12g},{rest}" for t, rest in cells)])

    before = open_recording(write_asl(tmp_path / "a", corners=False)).imu_arrays("imu0")
    after = rewritten(write_asl(tmp_path / "b", corners=False), change).imu_arrays("imu0")
    np.testing.assert_allclose(after.t_ns, before.t_ns - before.t_ns[0], atol=1)


def test_points_of_the_first_image_may_be_of_a_whole_second(tmp_path, write_asl):
    """All rows of the first image have the stamp 0."""
    folder = write_asl(tmp_path / "a")
    before = open_recording(folder).points_frames("cam0")
    table = folder / "mav0/cam0/corners.csv"
    title, *rows = table.read_text().splitlines()
    begin = int(rows[0].split(",")[0])
    moved = [(int(t) - begin, rest) for t, rest in (row.split(",", 1) for row in rows)]
    table.write_bytes(lines([title, *(f"{t * 1e-9:.12g},{rest}" for t, rest in moved)]))
    after = open_recording(folder, check=False).points_frames("cam0")
    for one, other in zip(before, after, strict=True):
        assert abs(one.t_cam_ns - begin - other.t_cam_ns) <= 1
        np.testing.assert_array_equal(one.uv_px, other.uv_px)


def test_two_imus_in_one_table_with_equal_stamps_are_named(tmp_path, write_asl):
    """The second one's readings were left out as repetitions."""

    def change(rows):
        cells = [row.split(",") for row in rows[1:]]
        turned = [",".join([c[0], *c[2:4], c[1], *c[5:7], c[4]]) for c in cells]  # another mounting
        return lines([rows[0], *(x for pair in zip(rows[1:], turned, strict=True) for x in pair)])

    with pytest.raises(RecordingError, match="as if two IMUs shared one table"):
        rewritten(write_asl(tmp_path / "a"), change)
