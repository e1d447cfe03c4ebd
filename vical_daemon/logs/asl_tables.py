"""Tables of an ASL/EuRoC folder: numbers, packed or not. Its images: `asl_images`."""

from __future__ import annotations

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

_NUMBER_BYTES = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf|infinity)", re.IGNORECASE)
_ROW = re.compile(rb"^[ \t]*[-+]?\.?\d[^\r\n]*", re.MULTILINE)
SPACED_DATE = re.compile(rb"(\d{4}-\d\d-\d\d) +(?=\d\d:\d\d)")
_SPACED_UNIT = re.compile(rb" *(\[[^\]]*\]|\([^)]*\))")
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
    begin = _first_data_row(text)
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
        return "this is not plain text (UTF-16 from a spreadsheet? save it as CSV UTF-8)"
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
    text = text.removeprefix(b"\xef\xbb\xbf")
    if b"\n" not in text:
        text = text.replace(b"\r", b"\n")  # lines as old programs on a Macintosh end them
    return with_commas(text.replace(b'"', b""))  # some programs put every cell between quotes


def with_commas(text: bytes) -> bytes:
    """Return a table with commas between its cells, points in its numbers, and T in its dates.

    Its first row tells how it was written: cells between semicolons or tabs may have decimal commas.
    """
    first = _ROW.search(text)
    row = first[0].strip() if first else b""
    if SPACED_DATE.search(row):
        text, row = (SPACED_DATE.sub(rb"\1T", part) for part in (text, row))
    for mark in (b";", b"\t"):
        if mark in row.strip(b";") and b"," + mark not in row:
            return text.translate(bytes.maketrans(b"," + mark, b".,"))
    if b"," in row or not row.split()[1:]:
        return text
    begin = _ROW.search(text).start()  # type: ignore[union-attr]
    title = _title_with_commas(text[:begin], len(row.split()))
    return title + re.sub(rb"(?<=\S)[ \t]+(?=[^\s])", b",", text[begin:])


def _title_with_commas(text: bytes, count: int) -> bytes:
    """Return lines above rows of so many cells between spaces; without names where their number differs."""
    lines = text.splitlines()
    plain = _SPACED_UNIT.sub(lambda unit: unit[1].replace(b" ", b""), lines[-1] if lines else b"")
    names = plain.strip(b"#% \t").split()
    title = b"#" + b",".join(names if len(names) == count else [])
    return b"\n".join([title, *[b"#"] * (len(lines) - 1), b""]) if lines else b""


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


def _first_data_row(text: bytes) -> int:
    """Return the offset behind a title line without ``#``, and behind units in the line below it."""
    begin = 0
    for _ in range(2):
        end = text.find(b"\n", begin)
        line = text[begin : end if end >= 0 else len(text)].strip()
        numbers = begin and any(_NUMBER_BYTES.fullmatch(cell.strip()) for cell in line.split(b","))
        if not line or line[:1].isdigit() or line[:1] in b"-+#" or numbers:
            break
        begin = end + 1 if end >= 0 else begin
    return begin


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
    return name.endswith((".txt", ".tsv")) and path.is_file() and title_of(path)[1].count(b",") > 2


def title_of(path: Path) -> tuple[bytes, bytes]:
    """Return the first line of a table that is not packed, and its first row, both with commas."""
    try:
        with open_file(path) as file:
            head = with_commas(file.read(_HEAD_BYTES).replace(b'"', b""))
    except OSError:
        return b"", b""  # it is named when it is read
    row = _ROW.search(head)
    return head.split(b"\n", 1)[0], row[0] if row else b""
