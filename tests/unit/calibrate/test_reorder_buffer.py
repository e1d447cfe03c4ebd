"""Sorting by stamp behind a lag: order, lateness, bounds, and nothing lost."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from vical_daemon.calibrate.reorder_buffer import ReorderBuffer

MS = 1_000_000


def test_waits_for_the_lag_and_sorts() -> None:
    order: ReorderBuffer[str] = ReorderBuffer(lag_s=0.1)
    order.push(1000 * MS, "imu 1000")
    order.push(950 * MS, "frame 950")
    assert order.pop_due() == []
    order.push(1050 * MS, "imu 1050")
    assert order.pop_due() == ["frame 950"]
    order.push(1200 * MS, "imu 1200")
    assert order.pop_due() == ["imu 1000", "imu 1050"]
    assert order.pop_all() == ["imu 1200"]


def test_what_comes_after_its_successors_goes_out_next_and_is_counted() -> None:
    order: ReorderBuffer[str] = ReorderBuffer(lag_s=0.1)
    order.push(1000 * MS, "a")
    order.push(1200 * MS, "b")
    assert order.pop_due() == ["a"]
    order.push(900 * MS, "late")
    assert order.pop_due() == ["late"] and order.pop_all() == ["b"]
    assert order.late == 1


def test_memory_is_bounded() -> None:
    order: ReorderBuffer[int] = ReorderBuffer(lag_s=1000.0, max_items=10)
    for i in range(25):
        order.push(i * MS, i)
    assert order.pop_due() == list(range(15)) and len(order) == 10


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 2_000), max_size=60), st.integers(1, 7))
def test_nothing_is_lost_or_reordered_within_the_lag(stamps_ms: list[int], chunk: int) -> None:
    order: ReorderBuffer[tuple[int, int]] = ReorderBuffer(lag_s=3.0)  # longer than any disorder here
    out = []
    for i, stamp in enumerate(stamps_ms):
        order.push(stamp * MS, (stamp, i))
        if i % chunk == 0:
            out += order.pop_due()
    out += order.pop_all()
    assert out == sorted((stamp, i) for i, stamp in enumerate(stamps_ms))
