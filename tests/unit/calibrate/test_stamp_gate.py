"""A stamp of nonsense is refused and holds nobody up; a real jump is followed, and nothing is lost."""

from __future__ import annotations

import numpy as np
import pytest

from vical_daemon.calibrate.stamp_gate import StampGate

MS = 1_000_000
NOW = 1_800_000_000_000_000_000
NONSENSE = [0, 1, -(10**9), 2**31 * 10**9 - 1, NOW + 3600 * 10**9, NOW - 3600 * 10**9, NOW + 10 * 10**9]


def passed(gate: StampGate[int], stamps: list[int]) -> list[int]:
    return [stamp for stamp in stamps for stamp, _ in gate.push(stamp, 0)]


@pytest.mark.parametrize("period_ms", [1, 5, 33, 1000])
def test_a_stream_loses_nothing_at_its_beginning(period_ms: int) -> None:
    stamps = [NOW + k * period_ms * MS for k in range(10)]
    assert passed(StampGate(), stamps) == stamps


@pytest.mark.parametrize("first", NONSENSE)
def test_nonsense_at_the_beginning_does_not_stop_the_stream(first: int) -> None:
    """The estimator's frame count once stood still for ever after a first stamp of zero."""
    stamps = [NOW + k * 33 * MS for k in range(50)]
    gate: StampGate[int] = StampGate()
    assert passed(gate, [first, *stamps]) == stamps
    assert gate.refused == 1 and gate.jumps == 0


def test_nonsense_among_good_stamps_is_refused(rng: np.random.Generator) -> None:
    stamps, mixed = [NOW + k * 5 * MS for k in range(400)], []
    for stamp in stamps:
        mixed += [int(rng.choice(NONSENSE)) for _ in range(rng.integers(0, 4))] + [stamp]
    gate: StampGate[int] = StampGate()
    assert passed(gate, mixed) == stamps
    assert gate.refused + len(stamps) == len(mixed)


@pytest.mark.parametrize("jump_s", [3.0, 3600.0, -3600.0, 1.8e9, -1.7e9])
def test_a_clock_that_is_set_is_followed_and_nothing_is_lost(jump_s: float) -> None:
    jump = round(jump_s * 1e9)
    stamps = [NOW + k * 5 * MS + (jump if k >= 400 else 0) for k in range(800)]
    gate: StampGate[int] = StampGate()
    assert passed(gate, stamps) == stamps
    assert gate.refused == 0 and gate.jumps == 1


def test_a_clock_that_is_set_is_followed_among_nonsense(rng: np.random.Generator) -> None:
    stamps = [NOW + k * 66 * MS + (7200 * 10**9 if k >= 40 else 0) for k in range(80)]
    mixed = []
    for stamp in stamps:
        mixed += [int(rng.integers(-(2**62), 2**62)) for _ in range(5)] + [stamp]
    assert passed(StampGate(), mixed) == stamps


def test_two_streams_on_one_key_do_not_take_it_from_the_first() -> None:
    gate: StampGate[int] = StampGate()
    first = [NOW + k * 10 * MS for k in range(300)]
    second = [NOW + 1000 * 10**9 + k * 10 * MS for k in range(300)]
    got = passed(gate, [stamp for pair in zip(first, second, strict=True) for stamp in pair][4:])
    assert got == first[2:]


def test_what_is_held_is_bounded(rng: np.random.Generator) -> None:
    gate: StampGate[int] = StampGate()
    passed(gate, [NOW + k for k in range(3)])
    for k in range(20_000):
        gate.push(int(rng.integers(-(2**62), 2**62)), 0)
        gate.push(k * 50_000 % 400_000_000, 0)  # go on from each other, and never get anywhere
    assert sum(len(chain.held) for chain in gate._chains) < 10_000


def test_the_end_of_the_data_gives_out_what_was_held() -> None:
    gate: StampGate[int] = StampGate()
    assert passed(gate, [NOW, NOW + MS]) == []
    assert [stamp for stamp, _ in gate.flush()] == [NOW, NOW + MS]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(24)
