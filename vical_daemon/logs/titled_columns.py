"""Finds the columns of an inertial table by its title, where they are not in the order of EuRoC's."""

from __future__ import annotations

import re
from typing import NamedTuple

IN_DEGREES = "its title gives the gyro in degrees; rad/s are expected: multiply by pi/180, correct the title"
_IN_ORDER = tuple(range(7))
_IGNORED = re.compile(r"covar|std|sigma|bias|mag|orient|quat|gravity|free|user|ang\w*acc|accura")
_GYRO = re.compile(r"gyr|omega|ang\w*\W?(vel|rate|speed)|rot\w*\W?(vel|rate|speed)|^[wg]_?(rs_s)?_?[xyz]$")
_ACCEL = re.compile(r"acc|specific|force|^a_?(rs_s)?_?[xyz]$|^f_?[xyz]$")
_DEGREES = re.compile(r"deg|dps|°")
_STAMP = re.compile(r"time|stamp|^ts?$|^ts_|^t_|^cts$")
_COUNTER = re.compile(r"count(er)?$")
_RATE = re.compile(r"(?:update|sampl\w*|output)[ _]?rate\W*(\d+(?:\.\d+)?) *Hz", re.IGNORECASE)
_AROUND = ' #%\t\r\n"\ufeff'
_WHOLE, _REST = re.compile(r"stamp\W?secs?$"), re.compile(r"stamp\W?nsecs?$|stamp\W?nanosecs?$")


class Columns(NamedTuple):
    """Where a table has its stamps, three rates and three forces.

    Attributes:
        numbers: Of these seven columns, from 0.
        rest: Column of the nanoseconds if that of the stamps holds whole seconds; None: it holds all.
    """

    numbers: tuple[int, ...]
    rest: int | None = None

    @property
    def in_order(self) -> bool:
        """Whether these are the first seven columns, in EuRoC's order."""
        return self.numbers == _IN_ORDER and self.rest is None


def columns_by_title(title: str) -> Columns | None:
    """Return where the title of a table says that its columns are; None: it does not name all six axes once.

    >>> columns_by_title("#timestamp [ns],w_RS_S_x,w_RS_S_y,w_RS_S_z,a_RS_S_x,a_RS_S_y,a_RS_S_z").in_order
    True
    >>> columns_by_title("seq,stamp,temp,ax,ay,az,gx,gy,gz").numbers
    (1, 6, 7, 8, 3, 4, 5)
    """
    names = [_plain(name) for name in title.split(",")]
    axes: list[int] = []
    for pattern in (_GYRO, _ACCEL):
        for axis in "xyz":
            found = [
                i
                for i, name in enumerate(names)
                if name.endswith(axis) and pattern.search(name) and not _IGNORED.search(name)
            ]
            if len(found) != 1:
                return None
            axes += found
    if len(set(axes)) < 6:
        return None
    stamp, rest = _stamp_of(names, axes)
    return Columns((stamp, *axes), rest)


def axes_by_title(title: str) -> Columns | None:
    """Return stamp and axes of a table of one sensor by its title; None: it does not name them.

    In exports of GoPro's telemetry the sensor's name stands over the first axis, 1 and 2 over the others.

    >>> axes_by_title("time,seconds_elapsed,z,y,x").numbers
    (0, 4, 3, 2)
    >>> axes_by_title("cts,date,Accelerometer [m/s2],1,2").numbers
    (0, 2, 3, 4)
    """
    names = [_plain(name) for name in title.split(",")]
    found = [[i for i, name in enumerate(names) if name.endswith(axis)] for axis in "xyz"]
    axes = [i[0] for i in found if len(i) == 1]
    if len(axes) < 3:
        first = next((i for i, name in enumerate(names) if _GYRO.search(name) or _ACCEL.search(name)), None)
        if first is None or names[first + 1 : first + 3] != ["1", "2"]:
            return None
        axes = [first, first + 1, first + 2]
    stamp, rest = _stamp_of(names, axes)
    return Columns((stamp, *axes), rest)


def counts_only(title: str) -> bool:
    """Whether the column that is taken for the stamps counts rows: there is no time.

    >>> counts_only("PacketCounter,gx,gy,gz,ax,ay,az"), counts_only("utc,count,gx,gy,gz,ax,ay,az")
    (True, False)
    """
    columns = columns_by_title(title)
    name = title.split(",")[0 if columns is None else columns.numbers[0]]
    return _COUNTER.search(_plain(name)) is not None


def rate_named(lines: list[str]) -> float | None:
    """Return the rate that lines above a table name, Hz: `// Update Rate: 100.0Hz`; None: they do not."""
    found = (_RATE.search(line) for line in lines)
    return next((float(match[1]) for match in found if match), None)


def names_degrees(title: str) -> bool:
    """Whether the title of a table of one sensor names degrees a second."""
    return re.search(r"deg\w*\W*(/|per|s)|dps|°/s", title.lower()) is not None


def degrees_named(title: str) -> bool:
    """Whether the title of a table gives rates in degrees: at rest, the readings do not show it.

    >>> degrees_named("t,gx [deg/s],gy,gz"), degrees_named("t,gyro_x_dps,y"), degrees_named("t,gx [rad/s]")
    (True, True, False)
    """
    names = [name.lower() for name in title.split(",")]
    return any(_GYRO.search(_plain(name)) and _DEGREES.search(name) for name in names)


def reordered(text: bytes, columns: Columns) -> bytes:
    """Return a table with its seven columns in EuRoC's order; lines keep their numbers."""
    wanted, whole, out = columns.numbers[1:], columns.numbers[0], []
    last = max(*columns.numbers, columns.rest or 0)
    for line in text.split(b"\n"):
        cells = [cell.strip() for cell in line.split(b",")]
        if len(cells) <= last:  # empty, or cut off
            out.append(line if len(cells) == 1 else cells[whole] if whole < len(cells) else cells[0])
            continue
        stamp = cells[whole]
        if columns.rest is not None and stamp.isdigit():
            stamp += cells[columns.rest].rjust(9, b"0")
        out.append(b",".join([stamp, *(cells[i] for i in wanted)]))
    return b"\n".join(out)


def _plain(name: str) -> str:
    """Return a column's name in lower case, without its unit and what `rostopic echo -p` puts before it.

    PX4 counts the axes, and DJI the sensors.

    >>> _plain("gyro_rad[2]"), _plain("IMU_ATTI(0):accelX"), _plain("field.ax [m/s^2]")
    ('gyro_radz', 'imu_atti:accelx', 'ax')
    """
    name = re.sub(r"\[([012])\]$", lambda axis: "xyz"[int(axis[1])], name.lower().strip(_AROUND))
    return re.sub(r"[\[(][^\])]*[\])]|[\[(].*", "", name).strip(_AROUND).removeprefix("field.")


def _stamp_of(names: list[str], axes: list[int]) -> tuple[int, int | None]:
    """Return the column of the stamps, and that of their nanoseconds if they are apart.

    The stamp of a message's header goes before the time at which it was recorded.
    """
    found = [i for i, name in enumerate(names) if _STAMP.search(name) and i not in axes]
    whole, rest = ([i for i in found if pattern.search(names[i])] for pattern in (_WHOLE, _REST))
    if whole and rest:
        return whole[0], rest[0]
    return next((i for i in found if "stamp" in names[i]), found[0] if found else 0), None
