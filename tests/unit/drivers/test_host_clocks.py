"""Two host clocks are read at one moment, even where the process is interrupted between them."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from vical_drivers import host_clocks

EPOCH_NS = 1_700_000_000_000_000_000


class Computer:
    """Its clocks; each reading takes 200 ns, and longer where the process is interrupted."""

    def __init__(self, interruptions_ns: Iterator[int]) -> None:
        self._interruptions_ns = interruptions_ns
        self._t_ns = 5_000_000_000

    def monotonic_ns(self) -> int:
        self._t_ns += 200
        return self._t_ns

    def time_ns(self) -> int:
        self._t_ns += 200 + next(self._interruptions_ns, 0)
        return self._t_ns + EPOCH_NS


@pytest.mark.parametrize(
    ("interruptions_ns", "error_ns"),
    [([], 200), ([12_000_000], 200), ([30_000_000, 9_000_000, 40_000], 200), ([50_000] * 1000, 25_200)],
)
def test_an_interruption_between_the_readings_is_not_taken_for_an_offset(
    monkeypatch: pytest.MonkeyPatch, interruptions_ns: list[int], error_ns: int
) -> None:
    monkeypatch.setattr(host_clocks, "time", Computer(iter(interruptions_ns)))
    monotonic_ns, realtime_ns = host_clocks.read_host_clocks()
    assert monotonic_ns == 5_000_000_200  # the time of the call, however long it took
    assert abs(realtime_ns - EPOCH_NS - monotonic_ns) <= error_ns


def test_all_clocks_are_those_of_this_computer() -> None:
    before_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    clocks = host_clocks.read_all_clocks()
    after_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    assert before_ns - 100_000 <= clocks.boottime_ns <= after_ns + 100_000
    assert abs(clocks.realtime_ns - time.time_ns()) < 1e9
