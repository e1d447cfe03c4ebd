"""Tables of an ASL/EuRoC folder: numbers, packed or not. Its images: `asl_images`."""

from __future__ import annotations

import codecs
import gzip
import io
import os
import re
import zlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from vical_drivers.user_files import open_file, read_file

from vical_daemon.logs.model import RecordingError
from vical_daemon.logs.stamps import date_ns
from vical_daemon.logs.table_text import FIRST_ROW, first_row, with_commas

_NUMBER_BYTES = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf|infinity)", re.IGNORECASE)
_HEAD_BYTES = 4096  # title and first rows
_MISSING = frozenset({b"", b"na", b"n/a", b"null", b"none", b"-"})
_FIRST_NUMBERS = 20  # of these one stamp in seconds is not a whole one
_ROWS_LOOKED_AT = 20_000  # twenty images of 1000 points
_IMU_COLUMNS = 7  # stamp, 3 rates, 3 forces
TABLE_LIMIT = 2**30  # bytes; two hours of a board's 144 corners at 30 Hz
_SMALL = 2**25  # bytes; a packed table may always unpack to this size
_SHRINKS = 100  # times; tables of numbers shrink to a third or a tenth, a file of zeros to a thousandth


def without_cut_line(text: bytes, columns: int) -> bytes:
    """Return a table without its last line if that is cut off."""
    end = text.rfind(b"\n") + 1
    last = text[end:]
    if not end or not last.strip() or last.lstrip().startswith(b"#"):
        return text
    cells = last.split(b",")
    return text if len(cells) >= columns and all(cell.strip() for cell in cells[:columns]) else text[:end]


def load_table(text: bytes, path: Path, dtype: np.dtype[Any], columns: str) -> npt.NDArray[Any]:
    """Parse a table of numbers.

    Stamps keep all digits: integers, or text where the first is a fraction. Other integers may be written
    like 12.0.
    """
    begin = first_row(text)
    wanted = dtype
    dtype = np.dtype([(name, _type_read(dtype, name, text, begin)) for name in dtype.names or ()])
    if next(_data_lines(text, begin), None) is None:
        raise RecordingError(f"{path}: no data below its title")
    if _has_decimal_commas(text, begin):
        raise RecordingError(f"{path}: more columns than its title: write decimal points, not commas")
    try:
        rows = _parsed(text[begin:], dtype)
    except (ValueError, OverflowError, UnicodeDecodeError):
        mistake = _first_mistake(text, begin, wanted)
        try:
            rows = _parsed(_missing_as_nan(text[begin:], columns_of(dtype)), dtype)
        except (ValueError, OverflowError, UnicodeDecodeError):
            raise RecordingError(f"{path}: {mistake}; expected {columns}") from None
    for name in (wanted.names or ())[1:]:
        if wanted[name].kind == "i" and (rows[name] % 1 != 0).any():
            raise RecordingError(f"{path}: a fraction where integers are needed; expected {columns}")
    return rows


def _parsed(text: bytes, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    rows: npt.NDArray[Any] = np.loadtxt(
        io.BytesIO(text),
        dtype=dtype,
        delimiter=",",
        comments="#",
        ndmin=1,
        usecols=range(columns_of(dtype)),
    )
    return rows


def _missing_as_nan(text: bytes, count: int) -> bytes:
    """Return a table with nan in cells that are empty, or written as missing, behind the first column."""
    lines = text.split(b"\n")
    for i, line in enumerate(lines):
        cells = [cell.strip() for cell in line.split(b",")]
        if len(cells) >= count and any(cell.lower() in _MISSING for cell in cells[1:count]):
            cells[1:] = [b"nan" if cell.lower() in _MISSING else cell for cell in cells[1:]]
            lines[i] = b",".join(cells)
    return b"\n".join(lines)


def _type_read(dtype: np.dtype[Any], name: str, text: bytes, begin: int) -> np.dtype[Any]:
    """Type as which a column is read: that wanted, unless one of its first numbers is a fraction."""
    column = (dtype.names or ()).index(name)
    if dtype[name].kind != "i" or not _fractional(text, begin, column):
        return dtype[name]
    return np.dtype("f8" if column else "U40")


def _first_mistake(text: bytes, begin: int, dtype: np.dtype[Any]) -> str:
    """Say which line of a table is not as many numbers as are needed, and what may be wrong with it."""
    if b"\0" in text:
        return "this is not plain text (of a spreadsheet? save it as CSV)"
    count = columns_of(dtype)
    for number, line in _data_lines(text, begin):
        cells = [cell.strip() for cell in line.split(b",")]
        dated = date_ns(cells[0].decode("utf-8", "replace")) is not None
        if len(cells) >= count and all(_NUMBER_BYTES.fullmatch(cell) for cell in cells[dated:count]):
            continue
        found = line.strip()[:60].decode("utf-8", "replace")
        found = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in found)
        hint = ""
        if b"," in line and len(line.split()) >= count:
            hint = ", separated by spaces; write points in the numbers, not commas"
        elif 4 <= len(cells) < count and count == _IMU_COLUMNS:
            hint = " (gyro and accelerometer in two tables? give the folder that holds both)"
        return f"line {number} is not {count} numbers{hint}: {found!r}"
    return "a stamp or an id is no integer, or too large"


def _has_decimal_commas(text: bytes, begin: int) -> bool:
    """Whether the first row has more cells than the title, and no point: 0.35 would be read as 0 and 35."""
    _, row = next(_data_lines(text, begin))
    title = text[: text.find(b"\n")]
    named = begin > 0 or title.startswith(b"#")
    return (
        named
        and title.count(b",") > 1
        and row.rstrip(b", \r\n").count(b",") > title.count(b",")
        and b"." not in row
    )


def _data_lines(text: bytes, begin: int) -> Iterator[tuple[int, bytes]]:
    """Yield number in the file, from 1, and text of each line that is neither empty nor a comment."""
    for number, line in enumerate(io.BytesIO(text), 1):
        begin -= len(line)
        if begin < 0 and line.strip() and line.lstrip()[:1] != b"#":
            yield number, line


def _fractional(text: bytes, begin: int, column: int) -> bool:
    """Whether one of the first numbers of a column is a fraction (0, 0.005, ...; or 1e9), or a date."""
    seen = set[bytes]()  # all points of an image have one stamp
    for _, line in islice(_data_lines(text, begin), _ROWS_LOOKED_AT):
        cell = (line.split(b",") + [b""] * column)[column].strip().lower()
        if b"." in cell or b"e" in cell or b":" in cell:
            return True
        seen.add(cell)
        if len(seen) > _FIRST_NUMBERS:
            break
    return False


def columns_of(dtype: np.dtype[Any]) -> int:
    """How many columns a row of this type fills."""
    names = dtype.names or ()
    return sum(int(np.prod(dtype[name].shape)) for name in names)


def read_table(path: Path) -> bytes:
    """Read a table, packed or not, with commas between the cells, points in the numbers and T in dates.

    Args:
        path: Of a file; or of a folder with a file for each reading (`_joined`).

    Raises:
        RecordingError: It cannot be read, or is empty or too large.
    """
    try:
        if path.is_dir():
            text = _joined(path)
        else:
            text = _unpacked(path) if path.suffix == ".gz" else read_file(path, TABLE_LIMIT)
    except (EOFError, zlib.error, gzip.BadGzipFile):
        raise RecordingError(f"{path} is no sound gzip file; unpack or download it again") from None
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    if not text or text.isspace():
        raise RecordingError(f"{path} is empty")
    text = text.removeprefix(codecs.BOM_UTF8)
    if text.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):  # "Unicode text" of spreadsheets
        text = text.decode("utf-16", "replace").encode()
    if b"\n" not in text:
        text = text.replace(b"\r", b"\n")  # lines as old programs on a Macintosh end them
    return with_commas(text.replace(b'"', b""))  # some programs put every cell between quotes


def _joined(folder: Path) -> bytes:
    """Return one table of a folder with one file for each reading, as KITTI's `oxts`.

    ``timestamps.txt`` has a line for each file of ``data/``, which are named by its number, from 0;
    ``dataformat.txt`` one for each column, which begins with its name.

    Raises:
        OSError: A file cannot be read.
        RecordingError: Files have no stamps.
    """
    stamps = read_file(folder / "timestamps.txt", TABLE_LIMIT).splitlines()
    files = {int(p.stem): p for p in sorted((folder / "data").glob("*.txt")) if p.stem.isdecimal()}
    if not files or max(files) >= len(stamps):
        raise RecordingError(
            f"{folder}: {len(files)} files in data/, but {len(stamps)} lines in timestamps.txt; copy it again"
        )
    names = [
        line.split(b":")[0].strip()
        for line in read_file(folder / "dataformat.txt", _SMALL).splitlines()
        if b":" in line
    ]
    rows = [b" ".join([stamps[i].strip(), *read_file(p, _SMALL).split()]) for i, p in files.items()]
    return b"\n".join([b" ".join([b"timestamp", *names]), *rows])


def _unpacked(path: Path) -> bytes:
    """Unpack a table, up to the largest plausible size.

    Raises:
        RecordingError: It is larger.
    """
    with open_file(path, TABLE_LIMIT) as packed:
        limit = min(TABLE_LIMIT, max(_SMALL, _SHRINKS * os.fstat(packed.fileno()).st_size))
        with gzip.GzipFile(fileobj=packed) as file:
            text = file.read(limit + 1)
    if len(text) > limit:
        raise RecordingError(
            f"{path} unpacks to more than {limit / 1e6:.0f} MB; a table does not, is it one?"
        )
    return text


def imu_tables(root: Path) -> dict[str, Path]:
    """Return the tables of inertial readings of a folder by the names of the IMUs, in order of these.

    ``imu0/data.csv`` (ASL) or ``imu0.csv`` (Kalibr's `kalibr_bagcreater`; also ``imu.txt``), or packed; the
    folder ``oxts`` of KITTI.
    """
    beside = [p for p in sorted(root.glob("imu*"), reverse=True) if is_table(p)]
    found = {p.name.split(".")[0]: p for p in beside if re.fullmatch(r"imu[0-9]*\..*", p.name)}
    for name in ("data.csv.gz", "data.csv"):
        found |= {p.parent.name: p for p in root.glob(f"imu*/{name}")}
    found |= {p.parent.name: p.parent for p in root.glob("oxts/dataformat.txt")}
    return dict(sorted(found.items()))


def is_table(path: Path) -> bool:
    """Whether a file may be a table of readings: by its name; of a text, its first row tells."""
    name = path.name.lower()
    if name.endswith((".csv", ".csv.gz")):
        return path.is_file()
    row = FIRST_ROW.search(head_of(path)) if name.endswith((".txt", ".tsv")) and path.is_file() else None
    return row is not None and row[0].count(b",") > 2


def head_of(path: Path) -> bytes:
    """Return titles and first rows of a table that is not packed, with commas."""
    try:
        with open_file(path) as file:
            return with_commas(file.read(_HEAD_BYTES).replace(b'"', b""))
    except OSError:
        return b""  # it is named when it is read
