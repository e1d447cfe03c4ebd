"""Gyro and accelerometer in one file whose records name their sensor.

Sensor Logger's JSON (an object for each reading: sensor, time in ns, x, y, z as text), and logs of Android's
GnssLogger (lines that begin with the sensor's name; a comment lists the columns of each).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import msgspec
from vical_drivers.user_files import open_file, read_file

from vical_daemon.logs.asl_tables import TABLE_LIMIT
from vical_daemon.logs.model import RecordingError

_HEAD_BYTES = 65_536  # GnssLogger has 3 kB of comments at its beginning
_GNSS_TITLE = re.compile(rb"^# ((?:Uncal)?(?:Gyro|Accel)),([^\r\n]*)", re.MULTILINE)
_GNSS_AXIS = re.compile(r"(?:Gyro|Accel)([XYZ])(?:RadPerSec|Mps2)")
_GNSS_STAMPS = ("elapsedRealtimeNanos", "utcTimeMillis")  # the first is steady
_REALSENSE = b"Stream Type,F#,HW Timestamp"
_TITLE = b"time,x,y,z\n"


class _Record(msgspec.Struct, gc=False):
    """A reading of Sensor Logger; of some sensors it has other values instead."""

    sensor: str = ""
    time: str | int = ""
    x: str | float | None = None
    y: str | float | None = None
    z: str | float | None = None


def labelled_file(root: Path) -> Path | None:
    """Return the one file of a folder whose records name gyro and accelerometer; None: there is none.

    Raises:
        RecordingError: It is one that cannot be read.
    """
    found = [p for p in sorted(root.iterdir()) if p.suffix.lower() in (".json", ".txt", ".csv") and _fits(p)]
    return found[0] if len(found) == 1 else None


def _fits(path: Path) -> bool:
    try:
        with open_file(path) as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return False
    if _REALSENSE in head:
        raise RecordingError(f"{path}: rs-convert mixes three clocks in it; give the camera's .bag itself")
    if path.suffix.lower() == ".json":
        return head.lstrip()[:1] == b"[" and b'"sensor"' in head and b'"seconds_elapsed"' in head
    return len(_GNSS_TITLE.findall(head)) > 1


def tables_of(path: Path) -> Mapping[str, bytes]:
    """Return a table of stamp and three axes for each sensor that has such.

    Raises:
        RecordingError: The file cannot be read.
    """
    try:
        text = read_file(path, TABLE_LIMIT)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    return _of_json(text, path) if path.suffix.lower() == ".json" else _of_gnss(text)


def _of_json(text: bytes, path: Path) -> dict[str, bytes]:
    try:
        records = msgspec.json.decode(text, type=list[_Record])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise RecordingError(f"{path} is no whole export of Sensor Logger: {error}") from None
    rows: dict[str, list[str]] = {}
    for r in records:
        if None not in (r.x, r.y, r.z):
            rows.setdefault(r.sensor, []).append(f"{r.time},{r.x},{r.y},{r.z}")
    return {sensor: _TITLE + "\n".join(lines).encode() for sensor, lines in rows.items()}


def _of_gnss(text: bytes) -> dict[str, bytes]:
    tables = {}
    for label, title in _GNSS_TITLE.findall(text):
        names = title.decode("utf-8", "replace").split(",")
        axes = {match[1]: i for i, name in enumerate(names) if (match := _GNSS_AXIS.search(name))}
        stamp = next((names.index(name) for name in _GNSS_STAMPS if name in names), None)
        if stamp is None or len(axes) != 3:
            continue
        wanted = [1 + stamp, *(1 + axes[axis] for axis in "XYZ")]
        lines = re.findall(rb"^%s,[^\r\n]*" % label, text, re.MULTILINE)
        cells = (line.split(b",") for line in lines)
        rows = [b",".join(row[i] for i in wanted) for row in cells if len(row) > max(wanted)]
        if rows:
            tables[label.decode()] = _TITLE + b"\n".join(rows)
    return tables
