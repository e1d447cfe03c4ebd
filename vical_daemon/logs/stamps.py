"""Converts stamps from text to nanoseconds, exactly, from any unit."""

from __future__ import annotations

import re
from calendar import timegm
from collections.abc import Iterable
from datetime import datetime
from decimal import Decimal, InvalidOperation

import numpy as np

from vical_daemon.estimation.measurements import IntArray

FACTOR_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
UNIT_WORDS = {"ns": "nanoseconds", "us": "microseconds", "ms": "milliseconds", "s": "seconds"}
_NAMED = {"ns": "ns", "nsec": "ns", "us": "us", "µs": "us", "usec": "us", "ms": "ms", "msec": "ms"}
_NAMED |= {"s": "s", "sec": "s"} | {word: unit for unit, word in UNIT_WORDS.items()}
_DATE = re.compile(
    r"((?:19|20)\d\d-\d\d-\d\d[Tt ]\d\d:\d\d:\d\d)(?:[.,](\d+))? *([Zz]|UTC|[+-]\d\d(?::?\d\d)?)?", re.ASCII
)
_NAMED_DATE = re.compile(
    r"(?:.*?\D)?((?:19|20)\d\d)([-_.]?)(\d\d)\2(\d\d)[-_.T ]*(\d\d)([-_.:]?)(\d\d)\6(\d\d)[-_.,]*"
    r"(\d{9}|\d{6}|\d{3})(?:\D.*)?",
    re.ASCII,
)
"""A date in a file's name: year, month, day, hour, minute, second, and a fraction of ms, us or ns."""
_NAMED_STAMP = re.compile(r"\d{13,}(?:\.\d+)?|\d{10,}\.\d+", re.ASCII)
"""In a file's name: UNIX time has 13 digits in ms, 16 in us, 19 in ns; 10 in s, with a fraction."""
_UNIX_DIGITS = (13, 16, 19)
_LATEST_NS = 4_102_444_800 * FACTOR_NS["s"]  # the year 2100: no stamp lies behind it
_APART_NS = 600 * FACTOR_NS["s"]
"""From the other stamps of a recording: ten minutes, longer than anyone rests within one."""
_NEIGHBOURS = 5  # messages on either side of a step
_BACK_S = 1.0  # more than any buffer delays a message of one sensor
_FEW = 0.05
"""Share of the messages that may lie so far away and be mistakes: the first 3 s of a minute."""


class StampError(ValueError):
    """A stamp that is not a number; has its index in the column, from 0."""

    def __init__(self, index: int) -> None:
        super().__init__(f"stamp {index} is no number")
        self.index = index


def numbers(texts: Iterable[str]) -> list[int] | list[Decimal]:
    """Read stamps exactly: as integers where all are, as dates (in ns), else as decimal fractions.

    Raises:
        StampError: One is no finite number; among dates, no date.
    """
    texts = list(texts)
    try:
        return [int(text) for text in texts]
    except ValueError:
        pass
    if date_ns(texts[0]) is not None:
        dates = [date_ns(text) for text in texts]
        if None in dates:
            raise StampError(dates.index(None))
        return [date for date in dates if date is not None]
    values = []
    for i, text in enumerate(texts):
        try:
            value = Decimal(text.strip())
        except InvalidOperation:
            raise StampError(i) from None
        if not value.is_finite():
            raise StampError(i)
        values.append(value)
    return values


def date_ns(text: str) -> int | None:
    """Read a date of ISO 8601 with its time of day as UNIX time, ns; without a zone as UTC; None: it is none.

    >>> date_ns("1970-01-01T01:00:00.000000001+01:00"), date_ns("1970-01-01 00:00:01.5"), date_ns("1.5")
    (1, 1500000000, None)
    """
    match = _DATE.fullmatch(text.strip())
    if match is None:
        return None
    try:
        seconds = timegm(datetime.fromisoformat(match[1].upper()).timetuple())
    except ValueError:
        return None  # the 31st of February
    zone = re.sub(r"[A-Za-z:]", "", match[3] or "")
    if zone:
        seconds -= int(zone[0] + "1") * (3600 * int(zone[1:3]) + 60 * int(zone[3:] or 0))
    return seconds * FACTOR_NS["s"] + int((match[2] or "0")[:9].ljust(9, "0"))


def stamp_in_name(name: str) -> str:
    """Return the stamp that a file's name (without its ending) holds: a number or a date; empty: none.

    >>> stamp_in_name("left_1403636579763555584"), stamp_in_name("20260131_120000_250"), stamp_in_name("0012")
    ('1403636579763555584', '2026-01-31T12:00:00.250', '')
    """
    found = _NAMED_STAMP.findall(name)
    if match := _NAMED_DATE.fullmatch(name):
        year, _, month, day, hour, _, minute, second, fraction = match.groups()
        date = f"{year}-{month}-{day}T{hour}:{minute}:{second}.{fraction}"
        if date_ns(date) is not None and not (found and len(found[0]) in _UNIX_DIGITS):
            return date
    return found[0] if len(found) == 1 else ""


def not_a_stamp(text: str) -> str:
    """Say that a stamp cannot be read, and of dates how they are written."""
    text = text.strip()[:40]
    dated = re.search(r"\d[-:/.]\d+[-:/.]\d", text)
    advice = "; day or month first? nothing shows it" if re.match(r"\d\d?/\d\d?/\d{4}", text) else ""
    advice += "; write dates like 2026-01-31T12:00:00.123 (ISO 8601), or as ns since 1970" if dated else ""
    return f"its stamp is no number: {text!r}{advice}"


def to_ns(values: list[int] | list[Decimal], unit: str) -> IntArray:
    """Return stamps of a unit of `FACTOR_NS` in ns.

    Raises:
        StampError: One does not fit into 64 bits.
    """
    factor = FACTOR_NS[unit]
    whole = [value * factor if isinstance(value, int) else round(value * factor) for value in values]
    for i, value in enumerate(whole):
        if abs(value) >= 2**63:
            raise StampError(i)
    return np.array(whole, dtype=np.int64)


def resolution_ns(values: list[int] | list[Decimal], unit: str) -> float:
    """Return the value of the last digit that stamps of a unit of `FACTOR_NS` are written with, ns.

    >>> resolution_ns([Decimal("1.25"), Decimal("1.5")], "s")
    10000000.0
    """
    finest = min((v.as_tuple().exponent for v in values if isinstance(v, Decimal)), default=0)
    return FACTOR_NS[unit] * 10.0 ** int(finest)


def rounded_to_ns(t_ns: IntArray) -> int:
    """Return the power of ten, ns, of which all stamps are multiples: a program rounded them to it.

    1 where all intervals are multiples of the shortest: a simulation, or nothing that shows a rounding.

    >>> rounded_to_ns(np.array([0, 2_000_000, 5_000_000, 7_000_000]))
    1000000
    >>> rounded_to_ns(np.array([0, 5_000_000, 10_000_000, 20_000_000]))
    1
    """
    distinct = np.unique(t_ns)
    steps = np.diff(distinct)
    if len(steps) < 2 or (steps % steps.min() == 0).all():
        return 1
    step_ns = 1
    while step_ns < FACTOR_NS["s"] and (distinct % (10 * step_ns) == 0).all():
        step_ns *= 10
    return step_ns


def unit_named(title: str) -> str | None:
    """Return the unit that the title of a column names: `timestamp [ns]`, `time_us`; None: none.

    >>> unit_named("#timestamp [ns]"), unit_named("t_ms"), unit_named("time")
    ('ns', 'ms', None)
    """
    words = re.split(r"[^a-zµ]+", title.lower().strip())
    return next((_NAMED[word] for word in reversed(words) if word in _NAMED), None)


def unit_by_spacing(
    values: list[int] | list[Decimal], slowest_hz: float, fastest_hz: float, usual_hz: float
) -> str:
    """Return the unit in which the spacing of the stamps is plausible.

    Nanoseconds wherever they do; else the unit whose rate comes closest to the usual one. Two stamps of a
    stream are never so far in the future that a unit could be excluded by its size alone, but the latest is.

    Args:
        values: Stamps in any order; repeated ones do not count.
        slowest_hz: Lowest rate that such a stream has.
        fastest_hz: Highest.
        usual_hz: Typical rate.
    """
    ordered = np.unique(np.array(values, dtype=object))
    if len(ordered) < 2:
        return "ns"
    step_ns = float(np.median(np.diff(ordered).astype(np.float64)))
    if 0.9e9 / fastest_hz <= step_ns <= 1.1e9 / slowest_hz:
        return "ns"
    latest = max(abs(ordered[0]), abs(ordered[-1]))
    possible = [unit for unit, factor in FACTOR_NS.items() if latest * factor <= _LATEST_NS] or ["ns"]
    return min(possible, key=lambda unit: abs(np.log(step_ns * FACTOR_NS[unit] * usual_hz * 1e-9)))


def main_stretch(t_ns: IntArray) -> tuple[int, int] | None:
    """Return first and last stamp of a recording of which a few stamps lie far away; None: there are none.

    Drivers send their first messages with stamp 0, or before the computer's clock was set.

    >>> main_stretch(np.array([0, *range(10**18, 10**18 + 99)])) == (10**18, 10**18 + 98)
    True
    """
    if not len(t_ns):
        return None
    ordered = np.sort(t_ns)
    ends = np.flatnonzero(np.diff(ordered) > _APART_NS) + 1
    begins = np.concatenate([[0], ends])
    lengths = np.diff(np.append(begins, len(ordered)))
    largest = int(np.argmax(lengths))
    if len(lengths) == 1 or lengths[largest] < (1.0 - _FEW) * len(ordered):
        return None
    begin = int(begins[largest])
    return int(ordered[begin]), int(ordered[begin + int(lengths[largest]) - 1])


def set_back(t_ns: IntArray) -> tuple[int, int] | None:
    """Return from which stamp to which a clock was set back while it stamped these messages, ns: (to, from).

    None: it was not. Some messages of another order, or with wrong stamps, do not count, nor do copies.

    Args:
        t_ns: In the order of the log, shape (n,).

    >>> set_back(np.array([*range(20), *range(-5, 15)]) * 10**9)
    (-5000000000, 19000000000)
    >>> set_back(np.array([*range(20), 10**6, *range(21, 40)]) * 10**9)
    """
    if len(t_ns) < 2 * _NEIGHBOURS:
        return None
    at = int(np.argmin(np.diff(t_ns))) + 1
    if t_ns[at] == t_ns[0]:
        return None  # a copy
    before, after = t_ns[max(at - _NEIGHBOURS, 0) : at], t_ns[at : at + _NEIGHBOURS]
    back_s = float(np.median(before) - np.median(after)) * 1e-9
    sure = min(len(before), len(after)) == _NEIGHBOURS and back_s > _BACK_S
    return (int(after.min()), int(before.max())) if sure else None
