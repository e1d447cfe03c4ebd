"""Text of tables as spreadsheets, loggers and apps write it: separators, decimal commas, dates, titles."""

from __future__ import annotations

import re

FIRST_ROW = re.compile(rb"^[ \t]*[-+]?\.?\d[^\r\n]*", re.MULTILINE)
_FOR_EXCEL = re.compile(rb"\Asep=.\r?\n", re.IGNORECASE)
SPACED_DATE = re.compile(rb"(\d{4}-\d\d-\d\d) +(?=\d\d:\d\d)")
_SPACED_UNIT = re.compile(rb" *(\[[^\]]*\]|\([^)]*\))")


def with_commas(text: bytes) -> bytes:
    """Return a table with commas between its cells, points in its numbers, and T in its dates.

    Its first row tells how it was written: cells between semicolons or tabs may have decimal commas.
    """
    text = _FOR_EXCEL.sub(b"", text)
    first = FIRST_ROW.search(text)
    row = first[0].strip() if first else b""
    if SPACED_DATE.search(row):
        text, row = (SPACED_DATE.sub(rb"\1T", part) for part in (text, row))
    for mark in (b";", b"\t"):
        if mark in row.strip(b";") and b"," + mark not in row:
            return text.translate(bytes.maketrans(b"," + mark, b".,"))
    if b"," in row or not row.split()[1:]:
        return text
    begin = FIRST_ROW.search(text).start()  # type: ignore[union-attr]
    title = _title_with_commas(text[:begin], len(row.split()))
    return title + re.sub(rb"(?<=\S)[ \t]+(?=[^\s])", b",", text[begin:])


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
