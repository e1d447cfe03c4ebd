"""Stamps of a table in nanoseconds, whatever unit they were written in; the unit is reported."""

from __future__ import annotations

from decimal import Decimal
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.logs.stamps import (
    UNIT_WORDS,
    resolution_ns,
    rounded_to_ns,
    to_ns,
    unit_by_spacing,
    unit_named,
)

_IMU_HZ = (5.0, 20_000.0, 200.0)
"""Slowest, fastest and typical rate, Hz: a gyro below 10 Hz is of no use; the fastest MEMS IMUs give 32 kHz
raw, drivers a tenth."""
_CAMERA_HZ = (0.5, 400.0, 20.0)
"""Likewise of images; one a second in microseconds would be 1 kHz in nanoseconds."""


_COARSE_NS = 100_000
"""Steps in which stamps are written from which on it is reported, ns: at 1 rad/s and f = 500 px, half of it
is 0.025 px, a tenth of what corners have."""


_XSENS_BITS, _COUNTER_BITS = 32, 16  # MT Low Level Communication Protocol: SampleTimeFine, PacketCounter
_DAY_S = 86_400
_EPOCHS = (719_529, 25_569)
"""1970 in days of MATLAB (from the year 0), and of spreadsheets (from 1899-12-30); others have their
own zero."""
_XSENS, _XSENS_STEP = "sampletimefine", 5000
"""A counter of Xsens: an MTi counts 0.1 ms, a DOT us. So step by step it grows by less than this (2 Hz of an
MTi, 200 Hz of a DOT, which has at most 120), or by more."""


class StampColumn(NamedTuple):
    """The stamps of a table.

    Attributes:
        t_ns: In ns, shape (n,).
        report: On their unit; empty where they are nanoseconds.
        sigma_s: By how much all may be off together as they are written in steps of their last digit (that is
            not always zero), s: one step over the root of 12 (GUM, JCGM 100:2008, F.2.2.1). 0 where that is
            a nanosecond.
    """

    t_ns: IntArray
    report: str
    sigma_s: float


def column_ns(values: list[int] | list[Decimal] | IntArray, title: str, *, imu: bool) -> StampColumn:
    """Read the stamps of a table.

    The spacing decides, not the title: EuRoC's title, which says ns, is copied above any numbers. It says ns
    wherever ns are plausible.

    Args:
        values: In any order; repeated ones do not count. Fractions are seconds, ms or us.
        title: Of the table or its first column; its unit counts where the spacing leaves a choice.
        imu: Of inertial readings, else of images.

    Raises:
        StampError: One does not fit into 64 bits.
    """
    slowest, fastest, usual = _IMU_HZ if imu else _CAMERA_HZ
    if _XSENS in title.lower() and len(values) > 1:
        ticks = unwrapped(np.array(values, dtype=np.float64), _XSENS_BITS)
        tenths = float(np.median(np.diff(ticks))) < _XSENS_STEP
        title, values = "us", np.round(ticks * (100 if tenths else 1)).astype(np.int64)
    if not isinstance(values, np.ndarray) and (dates := _days(values, slowest, fastest)):
        t_ns = to_ns(dates, "s")
        coarse, sigma_s = coarseness(t_ns, _DAY_S * resolution_ns(values, "s"))
        read_as = "by their spacing the stamps are days; read as such"
        return StampColumn(t_ns, "; ".join(filter(None, [read_as, coarse])), sigma_s)
    if isinstance(values, np.ndarray):
        distinct: list[int] = np.unique(values).tolist()
        unit = unit_by_spacing(distinct, slowest, fastest, usual)
    else:
        unit = unit_by_spacing(values, slowest, fastest, usual)
    named = unit_named(title.split(",")[0])
    if named is not None and named != "ns" and unit != "ns":
        unit = named
    if isinstance(values, np.ndarray) and unit == "ns":
        t_ns, step_ns = values, 1.0
    else:
        listed = values.tolist() if isinstance(values, np.ndarray) else values
        t_ns, step_ns = to_ns(listed, unit), resolution_ns(listed, unit)
    coarse, sigma_s = coarseness(t_ns, step_ns)
    read_as = "" if unit == "ns" else f"by their spacing the stamps are {UNIT_WORDS[unit]}; read as such"
    return StampColumn(t_ns, "; ".join(filter(None, [read_as, coarse])), sigma_s)


def _days(values: list[int] | list[Decimal], slowest_hz: float, fastest_hz: float) -> list[Decimal]:
    """Return the UNIX time, s, of stamps in days, as spreadsheets and MATLAB write dates; []: they are not.

    Only days make such short steps plausible: as seconds they would be 40 kHz and more.
    """
    ordered = np.unique(np.array(values, dtype=np.float64))
    step_s = _DAY_S * float(np.median(np.diff(ordered))) if len(ordered) > 1 else 0.0
    if not 0.9 / fastest_hz <= step_s <= 1.1 / slowest_hz:
        return []
    epoch = next((day for day in _EPOCHS if ordered[0] > day), 0)
    return [(Decimal(value) - epoch) * _DAY_S for value in values]


def unwrapped(ticks: FloatArray, bits: int) -> FloatArray:
    """Return a counter of so many bits that goes on where it began anew, shape (n,)."""
    whole = float(2**bits)
    return ticks + whole * np.append(0, np.cumsum(np.diff(ticks) < -0.5 * whole))


def counter_ns(ticks: IntArray, rate_hz: float) -> IntArray:
    """Return the stamps, ns, of readings that are counted with 16 bits, at a rate that is known."""
    counted = unwrapped(ticks.astype(np.float64), _COUNTER_BITS)
    t_ns: IntArray = np.round((counted - counted[0]) * (1e9 / rate_hz)).astype(np.int64)
    return t_ns


def coarseness(t_ns: IntArray, step_ns: float = 1.0) -> tuple[str, float]:
    """Return (report, sigma_s) of stamps that are written in steps, see `StampColumn`.

    Args:
        t_ns: Stamps, ns, in any order.
        step_ns: Value of the last digit that they were written with, ns.
    """
    step_ns = max(step_ns, rounded_to_ns(t_ns))
    report = f"stamps are written in steps of {1e-6 * step_ns:g} ms, which limits the time shift"
    sigma_s = 1e-9 * step_ns / 12.0**0.5 if step_ns > 1.0 else 0.0
    return report if step_ns >= _COARSE_NS else "", sigma_s
