"""One offset per boot: whoever comes first makes it, everybody reads the same, steps change nothing."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest

from vical_daemon.service import wall_clock
from vical_daemon.service.wall_clock import (
    FILE_NAME,
    WallClock,
    WallClockError,
    boot_id,
    measure_offset_ns,
    private_clock,
    shared_clock,
)


def test_offset_is_unix_minus_monotonic() -> None:
    clock = private_clock()
    assert abs(clock.unix_ns(time.monotonic_ns()) - time.time_ns()) < 50_000_000
    assert clock.unix_ns(123) == 123 + clock.offset_ns


@pytest.mark.parametrize("left", [None, b'{"offset_ns": 5, "boot_id": "old"}'])
def test_all_processes_agree_even_when_they_start_together(tmp_path: Path, left: bytes | None) -> None:
    if left is not None:
        (tmp_path / FILE_NAME).write_bytes(left)
    with ThreadPoolExecutor(16) as pool:
        clocks = list(pool.map(lambda _: shared_clock(tmp_path), range(64)))
    assert len({clock.offset_ns for clock in clocks}) == 1
    assert [p.name for p in tmp_path.iterdir()] == [FILE_NAME]


def test_a_step_of_the_wall_clock_changes_nothing_but_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = shared_clock(tmp_path)
    real = time.time_ns
    monkeypatch.setattr(wall_clock.time, "time_ns", lambda: real() + 3_600_000_000_000)
    second = shared_clock(tmp_path)
    assert second == first
    assert abs(second.step_ns() - 3_600_000_000_000) < 50_000_000
    assert float(second.status_values()["wall_clock_step_s"]) == pytest.approx(3600, abs=0.1)


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"offset_ns": "x"}', b"\xff\xfe", b'{"offset_ns": 5, "boot_id": "old"}']
)
def test_a_file_of_another_boot_or_a_broken_one_is_replaced(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE_NAME).write_bytes(content)
    assert abs(shared_clock(tmp_path).offset_ns - measure_offset_ns()) < 50_000_000


def test_stamps_of_two_sensors_stay_together() -> None:
    clock = WallClock(1_700_000_000_000_000_000)
    assert clock.unix_ns(2_000) - clock.unix_ns(1_000) == 1_000


@pytest.mark.parametrize("year_s", [2_240_000_000, -1_000])
def test_a_date_that_no_stamp_can_have_is_named_and_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, year_s: int
) -> None:
    """It was kept until the next boot, also after NTP had set the clock: the service did not start again."""
    wrong_ns = year_s * 1_000_000_000 - time.monotonic_ns()
    with monkeypatch.context() as patched:
        patched.setattr(wall_clock, "measure_offset_ns", lambda: wrong_ns)
        with pytest.raises(WallClockError, match=r"date is \d{4}-12-\d\d, .* 2038-01-19; set it"):
            shared_clock(tmp_path)
    left = WallClock(wrong_ns, boot_id())
    (tmp_path / FILE_NAME).write_bytes(msgspec.json.encode(left))  # by an earlier version
    assert abs(shared_clock(tmp_path).now_ns() - time.time_ns()) < 50_000_000
