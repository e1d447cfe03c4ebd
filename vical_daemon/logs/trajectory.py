"""Reads trajectory files: stamps and orientations, with the column order that the file states.

Nothing is guessed from the orientations: with the parts of all quaternions permuted alike, the angles between
them stay what they are, so a wrong order fits a gyro as well as the right one does and turns the mounting.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from vical_drivers.user_files import read_file

from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.logs.asl_tables import TABLE_LIMIT
from vical_daemon.logs.model import RecordingError
from vical_daemon.logs.stamps import (
    UNIT_WORDS,
    StampError,
    numbers,
    to_ns,
    unit_by_spacing,
    unit_named,
)
from vical_daemon.logs.table_text import SPACED_DATE

_SLOWEST_HZ, _USUAL_HZ, _FASTEST_HZ = 1.0, 50.0, 5000.0
_LATEST_SECONDS = 1e12  # more than this are no seconds
_TUM, _EUROC = (7, 4, 5, 6), (4, 5, 6, 7)  # columns of qw qx qy qz
_QUATERNION_WORDS = ("q", "orient", "rot", "att")


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Orientations of a trajectory file.

    Attributes:
        t_ns: Stamps, ns, shape (n,).
        q_wxyz: Quaternions as the file gives them, w first, shape (n, 4).
        warnings: Deviations from the plain formats, one line each.
    """

    t_ns: IntArray
    q_wxyz: FloatArray
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Layout:
    """Which column is what; `unit` of the stamps as the title says it."""

    quaternion: tuple[int, ...]
    stamp: int = 0
    unit: str | None = None


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory: with a title line that names the columns, or in one of the two plain formats.

    A title names the parts of the quaternion (`qw`, `q_RS_w`, `orientation.w`, ...). Without one, stamps with
    a fraction mean TUM (`t x y z qx qy qz qw`, seconds; also with commas), whole nanoseconds followed by
    commas mean EuRoC (`t, x, y, z, qw, qx, qy, qz`).

    Raises:
        RecordingError: The file is neither, or could be both.
    """
    titles, rows, warnings = _rows(path)
    if not rows:
        raise RecordingError(f"{path}: 0 poses; expected {_EXPECTED}")
    comma = "," in rows[0][1] and ";" not in rows[0][1]
    cells = [_cells(text) for _, text in rows]
    layout = _named(path, titles, len(cells[0])) or _plain(path, cells, comma)
    needed = max(*layout.quaternion, layout.stamp) + 1
    if len(cells) > 1 and (len(cells[-1]) < needed or not _is_row(cells[-1], layout)):
        cells.pop()
        warnings.append(f"{path.name}: the last line is cut off and was left out")
    q = np.empty((len(cells), 4))
    for i, row in enumerate(cells):
        where = f"{path} line {rows[i][0]}"
        if len(row) < needed:
            raise RecordingError(f"{where}: {len(row)} columns; expected {_EXPECTED}")
        try:
            q[i] = [float(row[k]) for k in layout.quaternion]
        except ValueError:
            raise RecordingError(f"{where}: not a number in '{rows[i][1][:60]}'") from None
    try:
        values = numbers(row[layout.stamp] for row in cells)
        unit = layout.unit or unit_by_spacing(values, _SLOWEST_HZ, _FASTEST_HZ, _USUAL_HZ)
        t_ns = to_ns(values, unit)
    except StampError as error:
        number, text = rows[error.index]
        raise RecordingError(f"{path} line {number}: not a number in '{text[:60]}'") from None
    if layout.unit is None and unit in ("us", "ms"):
        warnings.append(f"{path.name}: by their spacing the stamps are {UNIT_WORDS[unit]}; read as such")
    return Trajectory(t_ns, q, tuple(warnings))


_EXPECTED = (
    "`t x y z qx qy qz qw` (TUM) or `t, x, y, z, qw, qx, qy, qz` (EuRoC), or a title naming qx qy qz qw"
)


def _rows(path: Path) -> tuple[list[str], list[tuple[int, str]], list[str]]:
    """Lines in front of the first row of numbers, rows with their line numbers, and a list for warnings."""
    titles: list[str] = []
    rows: list[tuple[int, str]] = []
    data = read_file(path, TABLE_LIMIT)
    if b"\0" in data:
        raise RecordingError(f"{path}: no text, so no trajectory; expected {_EXPECTED}")
    text = SPACED_DATE.sub(rb"\1T", data).decode("utf-8-sig", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        text = line.strip()
        if not text:
            continue
        if text[0].isdigit() or (text[0] in "-+." and text[1:2].isdigit()):
            rows.append((number, text))
        elif not rows:
            titles.append(text)
        elif text[0] not in "#%":
            raise RecordingError(f"{path} line {number}: not a number in '{text[:60]}'")
    return titles, rows, []


def _cells(text: str) -> list[str]:
    text = text.replace(",", ".") if ";" in text else text  # decimal commas
    separator = next((s for s in ",;" if s in text), None)
    return [cell.strip() for cell in text.rstrip(",; ").split(separator)]


def _is_row(cells: list[str], layout: _Layout) -> bool:
    try:
        numbers([cells[layout.stamp]])
        [float(cells[k]) for k in layout.quaternion]
    except ValueError:
        return False
    return True


def _named(path: Path, titles: list[str], columns: int) -> _Layout | None:
    """The layout by the last title line that names the four parts of a quaternion; None without one."""
    for title in reversed(titles):
        plain = title.lstrip("#% ")
        if "," not in plain and ";" not in plain:
            plain = re.sub(r"\[.*?\]|\(.*?\)", "", plain)  # units may hold blanks
        names = _cells(plain)
        found = _quaternion_columns([re.sub(r"\[.*?\]|\(.*?\)", "", name).strip().lower() for name in names])
        if found is None:
            continue
        if any(len(part) > 1 for part in found):
            raise RecordingError(
                f"{path}: its title names more than one quaternion; keep the columns of one and the stamps"
            )
        if len(names) != columns:
            raise RecordingError(f"{path}: its title names {len(names)} columns, but its rows have {columns}")
        times = [i for i, name in enumerate(names) if re.match(r"\W*(time|stamp|t\b|t_)", name.lower())]
        stamp = times[0] if times else 0
        return _Layout(tuple(part[0] for part in found), stamp, unit_named(names[stamp]))
    return None


def _quaternion_columns(names: list[str]) -> list[list[int]] | None:
    """Columns of w, x, y and z of the quaternions among some names; None where a part is missing."""
    found: list[list[int]] = [[], [], [], []]
    for i, name in enumerate(names):
        words = re.split(r"[^a-z0-9]+", name[:-1])
        if name[-1:] in set("wxyz") and any(word.startswith(_QUATERNION_WORDS) for word in words):
            found["wxyz".index(name[-1])].append(i)
    if all(found):
        return found
    bare = [[i for i, name in enumerate(names) if name == part] for part in "wxyz"]
    return bare if all(len(part) == 1 for part in bare) else None


def _plain(path: Path, cells: list[list[str]], comma: bool) -> _Layout:
    """The layout of a file without names: TUM or EuRoC, where only one of them can be meant."""
    if len(cells[0]) < 8:
        raise RecordingError(f"{path}: {len(cells[0])} columns; expected {_EXPECTED}")
    stamps = [row[0] for row in cells]
    whole = all(stamp.lstrip("+-").isdigit() for stamp in stamps)
    try:
        values = numbers(stamps)
    except StampError as error:
        raise RecordingError(f"{path}: '{stamps[error.index][:30]}' is no stamp") from None
    largest = max(abs(float(values[0])), abs(float(values[-1])))
    in_ns = whole and unit_by_spacing(values, _SLOWEST_HZ, _FASTEST_HZ, _USUAL_HZ) == "ns"
    if not whole and (not comma or (largest < _LATEST_SECONDS and len(cells[0]) == 8)):
        return _Layout(_TUM)
    if comma and in_ns:
        return _Layout(_EUROC)
    raise RecordingError(
        f"{path}: its columns can be read in two ways, `t x y z qx qy qz qw` (w last, TUM) or "
        "`t x y z qw qx qy qz` (w first, EuRoC), and nothing in it says which; write the right one in front "
        "of the rows as a title line"
    )
