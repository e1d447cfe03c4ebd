"""Gyro and accelerometer in two tables, as apps for phones and exports of action cameras write them.

``Gyroscope.csv`` and ``Accelerometer.csv``, ``gyro.csv`` and ``accel.csv``, ``..._gyro.csv`` and so on: a
stamp and three axes in each row. `united_imu` makes one IMU of them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.logs.asl_tables import head_of, is_table, load_table, read_table
from vical_daemon.logs.labelled_rows import labelled_file, tables_of
from vical_daemon.logs.model import RecordingError
from vical_daemon.logs.stamp_column import column_ns
from vical_daemon.logs.stamps import StampError, not_a_stamp, numbers
from vical_daemon.logs.table_text import titles
from vical_daemon.logs.titled_columns import (
    IN_DEGREES,
    axes_by_title,
    columns_by_title,
    names_degrees,
    reordered,
)

_GYRO, _ACCEL = re.compile(r"gyr"), re.compile(r"acc")
_DERIVED = re.compile(r"uncal|gravity|linear|user|mag|bias")
"""In the name of a table: made from others by the phone, or without its calibration."""
_ROW = np.dtype([("t", "<i8"), ("axes", "<f8", (3,))])
_EXPECTED = "a stamp and 3 axes"


class SensorTable(NamedTuple):
    """One sensor of a table.

    Attributes:
        path: Its file; of records that name their sensor with that name behind it.
        t_ns: In the order of the table, ns, shape (n,).
        axes: Readings, shape (n, 3).
        report: On its stamps, for people; empty: nothing.
        sigma_s: By how much all stamps may be off together, s, see `column_ns`.
    """

    path: Path
    t_ns: IntArray
    axes: FloatArray
    report: str
    sigma_s: float


def two_tables(root: Path) -> tuple[Path, Path] | None:
    """Return the tables of gyro and accelerometer of a folder; None: they are not there, or not clear.

    The accelerometer with gravity goes first: `TotalAcceleration.csv` of Sensor Logger, not
    `Accelerometer.csv`.
    """
    places = (root, root / "imu0")
    tables = [p for place in places if place.is_dir() for p in sorted(place.iterdir()) if is_table(p)]
    return _pair(tables)


def two_sensors(root: Path) -> tuple[SensorTable, SensorTable] | None:
    """Read gyro and accelerometer of a folder; None: they are not there, or not clear.

    Raises:
        RecordingError: They cannot be read.
    """
    if (pair := two_tables(root)) is not None:
        return read_sensor(pair[0]), read_sensor(pair[1])
    file = labelled_file(root)
    tables = {file / name: text for name, text in tables_of(file).items()} if file is not None else {}
    if (pair := _pair(list(tables))) is None:
        return None
    return _sensor_of(tables[pair[0]], pair[0]), _sensor_of(tables[pair[1]], pair[1])


def _pair(tables: list[Path]) -> tuple[Path, Path] | None:
    gyro, accel = (_named(tables, *x) for x in ((_GYRO, _ACCEL), (_ACCEL, _GYRO)))
    return None if gyro is None or accel is None else (gyro, accel)


def one_table(root: Path) -> Path | None:
    """Return the one table of a folder whose title names all six axes; None: there is none, or several."""
    tables = sorted(p for p in root.iterdir() if is_table(p) and p.suffix != ".gz")
    found = [p for p in tables if any(map(columns_by_title, titles(head_of(p))))]
    return found[0] if len(found) == 1 else None


def _named(tables: list[Path], word: re.Pattern[str], other: re.Pattern[str]) -> Path | None:
    found = [p for p in tables if word.search(p.name.lower()) and not other.search(p.name.lower())]
    found = [p for p in found if not _DERIVED.search(p.name.lower())] or found
    found = [p for p in found if "total" in p.name.lower()] or found
    return found[0] if len(found) == 1 else None


def read_sensor(path: Path) -> SensorTable:
    """Read the table of one sensor; rows that are not finite are left out.

    Raises:
        RecordingError: It is none, or its title says that rates are in degrees.
    """
    return _sensor_of(read_table(path), path)


def _sensor_of(text: bytes, path: Path) -> SensorTable:
    lines = titles(text)
    title = next(filter(axes_by_title, lines), "".join(lines[:1]))
    if names_degrees(title):
        raise RecordingError(f"{path}: {IN_DEGREES}")
    columns = axes_by_title(title)
    if columns is not None:
        text = reordered(text, columns)
    elif _stamp_is_last(text):
        text = b"\n".join(
            b",".join(line.split(b",")[3:4] + line.split(b",")[:3]) for line in text.split(b"\n")
        )
    rows = load_table(text, path, _ROW, _EXPECTED)
    try:
        stamps = rows["t"] if rows["t"].dtype.kind == "i" else numbers(rows["t"].tolist())
        column = column_ns(stamps, title, imu=True)
    except StampError as error:
        text_ = not_a_stamp(str(rows["t"][error.index]))
        raise RecordingError(f"{path}: row {error.index + 1} of the data: {text_}") from None
    good = np.isfinite(rows["axes"]).all(axis=1)
    return SensorTable(path, column.t_ns[good], rows["axes"][good], column.report, column.sigma_s)


def _stamp_is_last(text: bytes) -> bool:
    """Whether rows without a title are x, y, z, stamp (OpenCamera Sensors): only the last is so large."""
    cells = text.split(b"\n", 1)[0].strip().split(b",")
    try:
        values = [abs(float(cell)) for cell in cells]
    except ValueError:
        return False
    return len(values) == 4 and values[3] > 100.0 * max(values[:3])
