"""Trajectory files: the order of their columns is what they say themselves, or they are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vical_daemon.logs import RecordingError
from vical_daemon.logs.trajectory import read_trajectory

EPOCH_NS = 1_700_000_000_123_456_789
N = 20
STAMPS_NS = [EPOCH_NS + i * 20_000_000 for i in range(N)]
Q = np.random.default_rng(0).normal(0, 1, (N, 4))
Q /= np.linalg.norm(Q, axis=1, keepdims=True)  # w x y z
W_FIRST, W_LAST = [0, 1, 2, 3], [1, 2, 3, 0]


def seconds(ns: int) -> str:
    return f"{ns // 10**9}.{ns % 10**9:09d}"


def write(path: Path, stamps: list[str], order: list[int], separator: str = " ", title: str = "") -> Path:
    rows = [
        separator.join([t, "0.1", "0.2", "0.3", *map(repr, q[order].tolist())])
        for t, q in zip(stamps, Q, strict=True)
    ]
    path.write_text(title + "\n".join(rows) + "\n")
    return path


def read_right(path: Path) -> tuple[str, ...]:
    found = read_trajectory(path)
    assert found.t_ns.tolist() == STAMPS_NS
    np.testing.assert_array_equal(found.q_wxyz, Q)
    return found.warnings


@pytest.mark.parametrize("separator", [" ", "\t", ", ", ",", "; "])
def test_a_fraction_in_the_stamps_means_w_last_whatever_the_separator(tmp_path, separator):
    path = write(tmp_path / "a.csv", [seconds(t) for t in STAMPS_NS], W_LAST, separator)
    assert read_right(path) == ()


def test_whole_nanoseconds_and_commas_are_euroc(tmp_path):
    assert read_right(write(tmp_path / "a.csv", list(map(str, STAMPS_NS)), W_FIRST, ",")) == ()


@pytest.mark.parametrize(
    ("title", "stamps", "order", "separator"),
    [
        ("#timestamp [ns], p_RS_R_x [m], py, pz, q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z\n", "ns", 1, ","),
        ("# truth\n# timestamp tx ty tz qx qy qz qw\n", "ns", 0, " "),
        ("%time,field.pose.position.x,y,z,field.pose.orientation.x,field.pose.orientation.y,"
         "field.pose.orientation.z,field.pose.orientation.w\n", "ns", 0, ","),
        ("time [s],px,py,pz,w,x,y,z\n", "s", 1, ","),
        ("# timestamp (s) tx ty tz qw qx qy qz\n", "s", 1, " "),
    ],
)  # fmt: skip
def test_names_in_a_title_are_honoured_against_every_habit(tmp_path, title, stamps, order, separator):
    texts = [str(t) if stamps == "ns" else seconds(t) for t in STAMPS_NS]
    path = write(tmp_path / "a.txt", texts, W_FIRST if order else W_LAST, separator, title)
    assert read_right(path) == ()


@pytest.mark.parametrize(
    ("stamps", "separator"),
    [
        (list(map(str, STAMPS_NS)), " "),  # EuRoC's stamps, TUM's separator
        ([str(t // 10**6) for t in STAMPS_NS], ","),  # whole milliseconds: neither
        ([f"{float(t):.18e}" for t in STAMPS_NS], ","),  # EuRoC's stamps written by numpy
    ],
)
def test_what_can_be_read_in_two_ways_is_refused_and_both_are_named(tmp_path, stamps, separator):
    path = write(tmp_path / "a.csv", stamps, W_FIRST, separator)
    with pytest.raises(RecordingError, match=r"qx qy qz qw.*TUM.*qw qx qy qz.*EuRoC.*title line"):
        read_trajectory(path)


def test_wider_rows_with_seconds_are_not_taken_for_tum(tmp_path):
    path = write(tmp_path / "a.csv", [seconds(t) for t in STAMPS_NS], W_FIRST, ",")
    path.write_text("".join(line + ",0,0,0\n" for line in path.read_text().splitlines()))
    with pytest.raises(RecordingError, match="two ways"):
        read_trajectory(path)


@pytest.mark.parametrize(("unit", "factor"), [("us", 10**3), ("ms", 10**6)])
def test_units_of_stamps_are_recognised_and_reported(tmp_path, unit, factor):
    title = "t,x,y,z,qw,qx,qy,qz\n"
    path = write(tmp_path / "a.csv", [str(t // factor) for t in STAMPS_NS], W_FIRST, ",", title)
    found = read_trajectory(path)
    assert found.t_ns.tolist() == [t // factor * factor for t in STAMPS_NS]
    assert {"us": "microseconds", "ms": "milliseconds"}[unit] in found.warnings[0]
    named = write(
        tmp_path / "b.csv", [str(t // factor) for t in STAMPS_NS], W_FIRST, ",", f"t [{unit}]" + title[1:]
    )
    assert read_trajectory(named).warnings == ()


def test_a_last_line_that_is_cut_off_is_left_out_and_said(tmp_path):
    path = write(tmp_path / "a.txt", [seconds(t) for t in STAMPS_NS], W_LAST)
    path.write_text(path.read_text()[:-60])
    found = read_trajectory(path)
    assert len(found.t_ns) == N - 1 and "cut off" in found.warnings[0]


@pytest.mark.parametrize(
    ("line", "says"),
    [("1700000000.5 1 2 x 0 0 0 1", None), ("1700000000.5 1 2 3 0 0 nought 1", "line 3: not a number"),
     ("1700000000.5 1 2 3", "line 3: 4 columns"), ("hello", "line 3: not a number")],
)  # fmt: skip
def test_a_bad_line_in_the_middle_is_named(tmp_path, line, says):
    path = write(tmp_path / "a.txt", [seconds(t) for t in STAMPS_NS], W_LAST)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], line, *lines[2:]]))
    if says is None:  # positions are not needed
        assert len(read_trajectory(path).t_ns) == N + 1
        return
    with pytest.raises(RecordingError, match=says):
        read_trajectory(path)


def test_a_recording_is_no_trajectory(tmp_path):
    """A line of binary data was quoted."""
    path = tmp_path / "log.mcap"
    path.write_bytes(b"\x89MCAP0\r\n\x01\x13\x00\x00\n32 \x0bresync_bytes\x00\n")
    with pytest.raises(RecordingError, match="no text, so no trajectory; expected `t x y z"):
        read_trajectory(path)


def test_titles_that_do_not_fit_the_rows_are_refused(tmp_path):
    two = "t,a,b,c,q_cam_w,q_cam_x,q_cam_y,q_cam_z,q_imu_w,q_imu_x,q_imu_y,q_imu_z\n"
    path = write(tmp_path / "a.csv", [seconds(t) for t in STAMPS_NS], W_LAST, ",", two)
    with pytest.raises(RecordingError, match="more than one quaternion"):
        read_trajectory(path)
    short = write(tmp_path / "b.csv", [seconds(t) for t in STAMPS_NS], W_LAST, ",", "t,qw,qx,qy,qz\n")
    with pytest.raises(RecordingError, match="names 5 columns, but its rows have 8"):
        read_trajectory(short)
    (tmp_path / "c.txt").write_text("# nothing\n")
    with pytest.raises(RecordingError, match="0 poses"):
        read_trajectory(tmp_path / "c.txt")
