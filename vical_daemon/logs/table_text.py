"""Text of tables as spreadsheets, loggers and apps write it: separators, decimal commas, dates, titles."""

from __future__ import annotations

import re

FIRST_ROW = re.compile(rb"^[ \t]*[-+]?\.?\d[^\r\n]*", re.MULTILINE)
_FOR_EXCEL = re.compile(rb"\Asep=.\r?\n", re.IGNORECASE)
SPACED_DATE = re.compile(rb"(\d{4}-\d\d-\d\d) +(?=\d\d:\d\d)")
_OTHER_DATE = re.compile(
    rb"(?P<before>^|[,;\t])[ \t]*(?:(?P<year>\d{4})/|(?P<first>\d\d?)(?P<mark>[./]))(?P<second>\d\d?)[./]"
    rb"(?P<last>\d{1,4})[T ]+(?=\d\d:\d\d)",
    re.MULTILINE,
)
"""A date at the beginning of a cell: 31.01.2026, 31/01/2026, 01/31/2026 or 2026/01/31, and a time."""
_ROS2_ECHO = re.compile(rb"\d+,\d{1,9},[^,\n]*(,[-+.\deinf]+){37}\r?\n", re.IGNORECASE)
"""What `ros2 topic echo --csv` writes of a sensor_msgs/Imu: its 40 values in their order, without a title."""
_ROS2_TITLE = b",".join(
    [b"stamp secs,stamp nsecs,frame", *[b"orientation"] * 13]
    + [b"angular_velocity_%c" % axis for axis in b"xyz"] + [b"covariance"] * 9
    + [b"acceleration_%c" % axis for axis in b"xyz"] + [b"covariance"] * 9
) + b"\n"  # fmt: skip
_SPACED_UNIT = re.compile(rb" *(\[[^\]]*\]|\([^)]*\))")


def with_commas(text: bytes) -> bytes:
    """Return a table with commas between its cells, points in its numbers, and T in its dates.

    Its first row tells how it was written: cells between semicolons or tabs may have decimal commas.
    """
    text = _FOR_EXCEL.sub(b"", text)
    first = FIRST_ROW.search(text)
    row = first[0].strip() if first else b""
    if _OTHER_DATE.search(row):
        text = _with_iso_dates(text)
        row = FIRST_ROW.search(text)[0].strip()  # type: ignore[index]
    elif SPACED_DATE.search(row):
        text, row = (SPACED_DATE.sub(rb"\1T", part) for part in (text, row))
    for mark in (b";", b"\t"):
        if mark in row.strip(b";") and b"," + mark not in row:
            return text.translate(bytes.maketrans(b"," + mark, b".,"))
    if b"," in row or not row.split()[1:]:
        return _ROS2_TITLE + text if _ROS2_ECHO.match(text) else text
    begin = FIRST_ROW.search(text).start()  # type: ignore[union-attr]
    title = _title_with_commas(text[:begin], len(row.split()))
    return title + re.sub(rb"(?<=\S)[ \t]+(?=[^\s])", b",", text[begin:])


def _with_iso_dates(text: bytes) -> bytes:
    """Return a table whose dates are written as in ISO 8601; as it is if none shows what is day and month.

    Between points the day comes first. Between slashes it is what exceeds 12 somewhere in the table.
    """
    found = list(_OTHER_DATE.finditer(text))
    parts = {name: [int(m[name]) for m in found if m["mark"] == b"/"] for name in ("first", "second")}
    day_first, month_first = (max(parts[name], default=13) > 12 for name in ("first", "second"))
    if parts["first"] and day_first == month_first:
        return text

    def iso(match: re.Match[bytes]) -> bytes:
        year, day, month = match["last"], match["first"], match["second"]
        if match["year"]:
            year, month, day = match["year"], match["second"], match["last"]
        elif len(year) != 4:
            return match[0]
        elif match["mark"] == b"/" and month_first:
            day, month = month, day
        return b"%s%s-%02d-%02dT" % (match["before"], year, int(month), int(day))

    return _OTHER_DATE.sub(iso, text)


def _title_with_commas(text: bytes, count: int) -> bytes:
    """Return lines above rows of so many cells between spaces; without names where their number differs."""
    lines = text.splitlines()
    plain = _SPACED_UNIT.sub(lambda unit: unit[1].replace(b" ", b""), lines[-1] if lines else b"")
    names = plain.strip(b"#% \t").split()
    title = b"#" + b",".join(names if len(names) == count else [])
    return b"\n".join([title, *[b"#"] * (len(lines) - 1), b""]) if lines else b""


def first_row(text: bytes) -> int:
    """Return the offset behind titles, units and comments of any number; without numbers behind a title."""
    row = FIRST_ROW.search(text)
    return row.start() if row else text.find(b"\n") + 1


def titles(text: bytes) -> list[str]:
    """Return the lines above the first row."""
    return text[: first_row(text)].decode("utf-8", "replace").splitlines()
