"""The clock of a GenICam camera is set while it runs (PTP finds its master, or another one)."""

from __future__ import annotations

import numpy as np
import pytest
from vical_drivers.camera.aravis.dating import CameraClock

RATE_HZ = 30.0
SET_AT_S = 30.0
HOST_NS = 10**12


def dated(jump_s: float, *, late: slice = slice(0, 0), late_s: float = 0.0) -> tuple[CameraClock, np.ndarray]:
    """Rows of (true time, error of the stamp, sigma; NaN where the first packet dates the frame), s."""
    rng = np.random.default_rng(1)
    clock, rows = CameraClock("aravis:Acme-1"), []
    delays_s = rng.exponential(5e-4, round(90 * RATE_HZ))
    delays_s[late] += late_s
    for k, delay_s in enumerate(delays_s):
        t_s = k / RATE_HZ
        device_s = 100.0 + t_s * (1 + 30e-6) + (jump_s if t_s > SET_AT_S else 0.0)
        found = clock.date(round(device_s * 1e9), HOST_NS + round((t_s + delay_s) * 1e9))
        t_ns, sigma_ns = found or (np.nan, np.nan)
        rows.append((t_s, (t_ns - HOST_NS) * 1e-9 - t_s, sigma_ns * 1e-9))
    return clock, np.array(rows)


@pytest.mark.parametrize("jump_s", [1.7e9, 5.0, 0.2, 0.03, 0.01, -0.01, -0.03, -5.0])
def test_a_clock_that_is_set_is_announced_and_stamps_are_right_soon_after(
    jump_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    clock, rows = dated(jump_s)
    assert clock.settings == 1
    t_s, error_s, _ = rows.T
    assert not np.isnan(error_s[(t_s > 1.1) & (t_s < SET_AT_S)]).any()
    after = (t_s > SET_AT_S + 4.0) if jump_s < 0.0 else (t_s > SET_AT_S)
    assert np.nanmax(np.abs(error_s[after])) < 2e-4
    assert np.isnan(error_s[t_s > SET_AT_S + 4.0]).sum() == 0
    line = f"the clock of aravis:Acme-1 was set by {jump_s:+.2f} s:"
    assert [r.getMessage()[: len(line)] for r in caplog.records] == [line]


def test_frames_that_are_late_are_no_clock_that_was_set() -> None:
    seconds = round(RATE_HZ)
    for late in (slice(1000, 1000 + seconds), slice(0, 10 * seconds), slice(1000, 2000, 2)):
        clock, _ = dated(0.0, late=late, late_s=0.1)
        assert clock.settings == 0
