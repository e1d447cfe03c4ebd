"""Live images stamped on arrival get the stamps of their camera's even grid; others pass as they come."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from vical_daemon.calibrate.arrival_stamps import ArrivalStamps, LiveStamps
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.wording import event_text

BEGIN_NS = 1_700_000_000_123_456_789
IDS = np.arange(12)
CORNERS_PX = np.random.default_rng(1).uniform(100.0, 600.0, (12, 2))
MOST_LATE_S = 1.0  # that an image waits: 0.3 s for others, 0.5 s for the next fit, and a period


def frame(taken_s: float, stamp_s: float, *, still: bool = False) -> PointsFrame:
    """Twelve points that a hand moves, with 0.1 px of noise."""
    t_s = 0.0 if still else taken_s
    move = [130.0 * np.sin(3.1 * t_s) + 60.0 * np.cos(5.0 * t_s), 110.0 * np.cos(4.3 * t_s)]
    noise = np.random.default_rng(round(taken_s * 1e9)).normal(0.0, 0.1, (12, 2))
    return PointsFrame("cam0", BEGIN_NS + round(stamp_s * 1e9), IDS, CORNERS_PX + move + noise)


def in_order(arrival_s: np.ndarray) -> np.ndarray:
    """One after the other, at least 0.1 ms apart."""
    spread_s = 1e-4 * np.arange(len(arrival_s))
    return np.maximum.accumulate(arrival_s - spread_s) + spread_s


def late(taken_s: np.ndarray, mean_s: float = 4e-3, seed: int = 700) -> np.ndarray:
    """Stamps on arrival: delays are exponential, one image in a hundred is 60 ms late."""
    rng = np.random.default_rng(seed)
    delay_s = rng.exponential(mean_s, len(taken_s)) + 0.06 * (rng.random(len(taken_s)) < 0.01)
    return in_order(taken_s + delay_s)


@dataclass
class Run:
    """What came out: time taken and stamp, of images after the decision and of all before."""

    stamps: ArrivalStamps
    begin_s: float = np.nan
    errors_s: list[float] = field(default_factory=list)
    waited_s: list[float] = field(default_factory=list)
    raw: int = 0


def play(taken_s: np.ndarray, stamps_s: np.ndarray, *, still: bool = False) -> Run:
    run = Run(ArrivalStamps())
    taken_of: dict[int, float] = {}
    for taken, stamp in zip(taken_s.tolist(), stamps_s.tolist(), strict=True):
        new = frame(taken, stamp, still=still)
        taken_of[new.t_cam_ns] = taken
        decided = run.stamps.found is not None
        for out in run.stamps.push(new):
            came_ns = run.stamps.original_ns(out.t_cam_ns)
            if not decided:
                assert out.t_cam_ns == came_ns
                run.raw += 1
                continue
            run.errors_s.append((out.t_cam_ns - BEGIN_NS) * 1e-9 - taken_of[came_ns])
            run.waited_s.append(stamp - (came_ns - BEGIN_NS) * 1e-9)
        if not decided and run.stamps.found is not None:
            run.begin_s = taken
    return run


@pytest.mark.parametrize("rate_hz", [15.0, 20.0, 60.0])
@pytest.mark.parametrize("seed", [700, 701])
def test_a_camera_that_stamps_on_arrival(rate_hz: float, seed: int) -> None:
    taken_s = np.arange(round(60.0 * rate_hz)) / rate_hz
    run = play(taken_s, late(taken_s, min(4e-3, 0.1 / rate_hz), seed))
    assert run.begin_s < 20.0
    assert len(run.errors_s) > 0.9 * (len(taken_s) - run.raw) - 1.5 * rate_hz
    assert np.percentile(np.abs(run.errors_s), 99) < 1.5e-3
    assert max(run.waited_s) < MOST_LATE_S
    assert run.stamps.found is not None and run.stamps.found.sigma_s < 1e-3


@pytest.mark.parametrize("seed", range(6))
def test_stamps_that_are_early_and_late_alike_stay_as_they_are(seed: int) -> None:
    """In stretches of 6 to 28 s, as a robot at work makes them; 1 ms of jitter."""
    rng = np.random.default_rng([seed, 42])
    stretches = [600.0 * k + np.arange(round(10.0 * rng.uniform(6.0, 28.0))) / 10.0 for k in range(6)]
    taken_s = np.concatenate(stretches)
    run = play(taken_s, taken_s + 1e-3 * rng.standard_normal(len(taken_s)))
    assert run.stamps.found is None and run.raw == len(taken_s)
    assert not run.stamps.in_doubt


@pytest.mark.parametrize("most_hz", [20.0, 22.0])
def test_a_rate_that_is_limited_leaves_out_some_images(most_hz: float) -> None:
    taken_s = np.arange(1500) / 25.0
    arrived_s, kept, next_s = late(taken_s), [], 0.0
    for k, t_s in enumerate(arrived_s.tolist()):  # as `DetectRole` does
        if 0.5 / most_hz < next_s - t_s:
            continue
        next_s = max(next_s + 1.0 / most_hz, t_s)
        kept.append(k)
    run = play(taken_s[kept], arrived_s[kept])
    assert np.percentile(np.abs(run.errors_s), 99) < 2e-3


def test_a_stalled_computer_delivers_six_images_at_once() -> None:
    taken_s = np.arange(1200) / 20.0
    late_s = np.random.default_rng(3).exponential(1e-3, 1200)
    for k in range(50, 1190, 130):
        late_s[k : k + 6] = taken_s[k + 6] - taken_s[k : k + 6]
    run = play(taken_s, in_order(taken_s + late_s))
    assert len(run.errors_s) > 300
    assert np.percentile(np.abs(run.errors_s), 99) < 1e-3


@pytest.mark.parametrize("case", ["even", "software trigger", "at rest", "short"])
def test_stamps_that_pass_as_they_come(case: str) -> None:
    count = 50 if case == "short" else 900
    taken_s = np.arange(count) / 20.0
    stamps_s = taken_s if case == "even" else late(taken_s)
    if case == "software trigger":
        taken_s = stamps_s
    run = play(taken_s, stamps_s, still=case == "at rest")
    assert run.stamps.found is None and run.raw == count
    assert not run.stamps.in_doubt


def test_doubt_lasts_until_there_are_enough_images() -> None:
    stamps, taken_s = ArrivalStamps(), np.arange(400) / 20.0
    in_doubt = []
    for stamp in late(taken_s).tolist():
        stamps.push(frame(stamp, stamp, still=True))
        in_doubt.append(stamps.in_doubt)
    assert not any(in_doubt[:59]) and all(in_doubt[60:299]) and not any(in_doubt[300:])


def test_a_clock_that_is_set_back_and_a_pause() -> None:
    taken_s = np.arange(2400) / 20.0
    stamps_s = late(taken_s)
    stamps_s[800:] += 100.0  # 100 s without images
    taken_s[800:] += 100.0
    stamps_s[1600:] -= 3600.0
    run = play(taken_s, stamps_s)
    errors = np.array(run.errors_s)
    errors = np.where(errors < -1000.0, errors + 3600.0, errors)
    assert len(errors) > 1800
    assert np.percentile(np.abs(errors), 98) < 2e-3


def test_every_camera_is_announced_once() -> None:
    stamps, taken_s = LiveStamps(), np.arange(400) / 20.0
    news = []
    for taken, stamp in zip(taken_s.tolist(), late(taken_s).tolist(), strict=True):
        stamps.push(frame(taken, stamp))
        news += stamps.news()
    (event,) = news
    assert event.kind is EventKind.STAMPED_ON_ARRIVAL
    assert 2e-3 < event.value < 12e-3
    assert "cam0: its stamps jitter by" in event_text(event)
    assert 0.0 < stamps.sigma_s < 1e-3
    assert len(stamps.flush()) > 0 and stamps.flush() == []


def test_another_process_goes_on_with_even_stamps() -> None:
    taken_s = np.arange(1200) / 20.0
    taken_s[600:] += 5.0  # the process was killed, and another one began
    stamps_s = late(taken_s)
    first = LiveStamps()
    for taken, stamp in zip(taken_s[:600].tolist(), stamps_s[:600].tolist(), strict=True):
        first.push(frame(taken, stamp))
    second, taken_of, errors_s = LiveStamps(first.known_ns()), {}, []
    for taken, stamp in zip(taken_s[600:].tolist(), stamps_s[600:].tolist(), strict=True):
        new = frame(taken, stamp)
        taken_of[new.t_cam_ns] = taken
        for out in second.push(new):
            came_ns = second._cameras["cam0"].original_ns(out.t_cam_ns)
            errors_s.append((out.t_cam_ns - BEGIN_NS) * 1e-9 - taken_of[came_ns])
    assert second.news() == [] and not second.in_doubt
    assert len(errors_s) > 550 and np.abs(errors_s).max() < 2e-3
    assert LiveStamps().known_ns() == {}
