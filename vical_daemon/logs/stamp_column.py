"""Stamps of a table in nanoseconds, whatever unit they were written in; the unit is reported."""

from __future__ import annotations

from decimal import Decimal

import numpy as np

from vical_daemon.estimation.measurements import IntArray
from vical_daemon.logs.stamps import UNIT_WORDS, to_ns, unit_by_spacing, unit_named

_IMU_HZ = (5.0, 20_000.0, 200.0)
"""Slowest, fastest and typical rate, Hz: a gyro below 10 Hz is of no use; the fastest MEMS IMUs give 32 kHz
raw, drivers a tenth."""
_CAMERA_HZ = (0.5, 400.0, 20.0)
"""Likewise of images; one a second in microseconds would be 1 kHz in nanoseconds."""


def column_ns(values: list[int] | list[Decimal] | IntArray, title: str, *, imu: bool) -> tuple[IntArray, str]:
    """Return the stamps of a table in ns, and what to report: empty where they are nanoseconds already.

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
    if isinstance(values, np.ndarray):
        distinct: list[int] = np.unique(values).tolist()
        unit = unit_by_spacing(distinct, slowest, fastest, usual)
        if unit == "ns":
            return values, ""
    else:
        unit = unit_by_spacing(values, slowest, fastest, usual)
    named = unit_named(title.split(",")[0])
    if named is not None and named != "ns" and unit != "ns":
        unit = named
    stamps = to_ns(values.tolist() if isinstance(values, np.ndarray) else values, unit)
    report = "" if unit == "ns" else f"by their spacing the stamps are {UNIT_WORDS[unit]}; read as such"
    return stamps, report
