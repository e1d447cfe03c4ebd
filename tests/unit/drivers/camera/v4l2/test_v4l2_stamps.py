"""Stamps of the V4L2 grabber against the fake camera's truth: exact, and moved by half an exposure."""

from __future__ import annotations

import numpy as np
import pytest
from vical_drivers.camera.losses import SequenceCounter, StampGaps
from vical_drivers.camera.stamps import Anchor, Shutter, exposure_middle
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.kernel_stamp import kernel_stamp
from vical_drivers.camera.v4l2.node import DequeuedBuffer
from vical_drivers.host_clocks import HostClocks
from vical_mocks.v4l2_camera import CID_EXPOSURE_ABSOLUTE, CID_EXPOSURE_AUTO, FakeCamera

READOUT_S = 0.008


@pytest.mark.parametrize("anchor", list(Anchor))
@pytest.mark.parametrize("rolling", [False, True])
def test_middle_row_is_dated_by_first_principles(anchor: Anchor, rolling: bool) -> None:
    start, exposure, readout, rows = 10_000_000, 3_000_000, 7_999_000, 480
    line = readout // (rows - 1) if rolling else 0
    middles = [start + row * line + exposure / 2 for row in range(rows)]
    marks = {
        Anchor.START_OF_EXPOSURE: start,
        Anchor.END_OF_FRAME: start + exposure + readout,
        Anchor.FIRST_PACKET: start + exposure,
        Anchor.SHUTTER_CLOSED: start + exposure,
    }
    if anchor not in marks or (rolling and anchor is Anchor.SHUTTER_CLOSED):
        return
    made = exposure_middle(marks[anchor], anchor, exposure, Shutter(rolling, readout))
    assert made.t_exposure_mid_ns == pytest.approx(sum(middles) / rows, abs=readout / rows)
    assert made.rule.startswith(anchor.value)


def test_without_exposure_the_raw_stamp_is_passed_on() -> None:
    made = exposure_middle(123, Anchor.END_OF_FRAME, None, Shutter(readout_ns=50))
    assert (made.t_exposure_mid_ns, made.rule) == (123, "raw-eof")


@pytest.mark.parametrize("stamps", ["soe", "eof"])
@pytest.mark.parametrize("rolling", [False, True])
def test_kernel_stamp_becomes_the_exact_middle_of_exposure(open_fake, stamps: str, rolling: bool) -> None:
    camera = FakeCamera(stamps=stamps, rolling=rolling)
    source = open_fake(camera, exposure_s=0.004, readout_s=READOUT_S, rolling_shutter=rolling)
    for _ in range(20):
        frame = source.read(1.0)
        truth = camera.truth[frame.sequence]
        assert abs(frame.t_exposure_mid_ns - truth.t_mid_ns) < 1000  # the kernel's stamp holds whole us
        assert frame.exposure_ns == 4_000_000
        assert frame.readout_ns == (8_000_000 if rolling else 0)


@pytest.mark.parametrize(
    ("stamps", "rule", "sign"), [("soe", "soe+exposure/2", 1), ("eof", "eof-readout-exposure/2", -1)]
)
def test_a_changed_exposure_moves_the_stamp_by_exactly_half_of_it(
    open_fake, stamps: str, rule: str, sign: int
) -> None:
    camera = FakeCamera(stamps=stamps)
    source = open_fake(camera, exposure_s=0.004, readout_s=READOUT_S)
    readout_ns = 8_000_000 if stamps == "eof" else 0
    offsets: dict[int, set[int]] = {}
    for number in range(30):
        frame = source.read(1.0)
        if number == 10:
            assert source.set_exposure(0.0101) == pytest.approx(0.0101)
        raw = camera.truth[frame.sequence].t_stamp_ns - readout_ns
        assert frame.stamp_rule == rule
        offsets.setdefault(frame.exposure_ns, set()).add(frame.t_exposure_mid_ns - raw)
    assert offsets == {4_000_000: {sign * 2_000_000}, 10_100_000: {sign * 5_050_000}}


def test_frames_already_exposing_keep_the_old_exposure(open_fake) -> None:
    camera = FakeCamera(stamps="soe")
    source = open_fake(camera, exposure_s=0.004, rate_hz=60)
    for number in range(40):
        frame = source.read(1.0)
        if number % 7 == 3:
            source.set_exposure(0.002 + 0.0001 * number)
        assert frame.exposure_ns == camera.truth[frame.sequence].exposure_ns
        assert abs(frame.t_exposure_mid_ns - camera.truth[frame.sequence].t_mid_ns) < 1000


def test_exposure_changed_by_another_program_is_noticed(open_fake, kernel) -> None:
    camera = FakeCamera(stamps="soe")
    source = open_fake(camera, exposure_s=0.004)
    source.read(1.0)
    kernel.set_by_other_process(camera, CID_EXPOSURE_ABSOLUTE, 80)
    frames = [source.read(1.0) for _ in range(4)]
    assert [f.exposure_ns for f in frames] == [camera.truth[f.sequence].exposure_ns for f in frames]
    assert frames[-1].exposure_ns == 8_000_000
    kernel.set_by_other_process(camera, CID_EXPOSURE_AUTO, 3)
    frames = [source.read(1.0) for _ in range(4)]
    assert frames[-1].exposure_ns is None
    assert frames[-1].stamp_rule == "raw-soe"


def test_automatic_exposure_leaves_the_kernel_stamp_unchanged(open_fake) -> None:
    camera = FakeCamera()
    source = open_fake(camera)
    frame = source.read(1.0)
    assert frame.stamp_rule == "raw-eof"
    assert frame.t_exposure_mid_ns == camera.truth[frame.sequence].t_stamp_ns


def test_stamp_raw_carries_the_kernel_stamp_and_still_tells_the_exposure(open_fake) -> None:
    camera = FakeCamera()
    frame = open_fake(camera, exposure_s=0.005, stamp="raw").read(1.0)
    assert frame.t_exposure_mid_ns == camera.truth[frame.sequence].t_stamp_ns
    assert frame.exposure_ns == 5_000_000


def test_assumed_exposure_serves_a_camera_without_the_control(open_fake) -> None:
    camera = FakeCamera(controls=[])
    frame = open_fake(camera, assume_exposure_s=0.005, readout_s=READOUT_S).read(1.0)
    assert frame.t_exposure_mid_ns == camera.truth[frame.sequence].t_stamp_ns - 8_000_000 - 2_500_000


@pytest.mark.parametrize("step_s", [-5.0, 5.0, -3e8, 1.7e9])
def test_an_image_that_waits_while_the_wall_clock_is_set_is_dated_by_its_arrival(step_s: float) -> None:
    """By NTP, after a start without a battery-backed clock: 5 s were taken for a stamp in the future."""
    now_ns, wall_ns = 100 * 10**9, 1_600_000_000 * 10**9
    buffer = DequeuedBuffer(0, 0, abi.BUF_FLAG_TIMESTAMP_MONOTONIC, wall_ns + now_ns - 30_000_000, 1)
    for moved_s, anchor in ((0.0, Anchor.END_OF_FRAME), (step_s, Anchor.ARRIVAL)):
        now = HostClocks(now_ns, wall_ns + now_ns + round(1e9 * moved_s), now_ns)
        made = kernel_stamp(buffer, driver="x", now=now, before_ns=now_ns - 63_000_000)
        assert made.anchor is anchor
        assert now_ns - made.t_raw_ns == (0 if moved_s else 30_000_000)


def test_realtime_stamps_are_brought_to_the_monotonic_clock(open_fake) -> None:
    camera = FakeCamera(stamps="soe", stamp_offset_ns=1_700_000_000_000_000_000)
    frame = open_fake(camera, exposure_s=0.004).read(1.0)
    assert abs(frame.t_exposure_mid_ns - camera.truth[frame.sequence].t_mid_ns) < 1000
    assert frame.stamp_rule == "soe(realtime)+exposure/2"


@pytest.mark.parametrize("suspended_s", [1.0, 8.0, 3000.0])
def test_stamps_that_count_suspended_time_are_brought_to_the_monotonic_clock(
    open_fake, kernel, suspended_s: float
) -> None:
    """Android drivers stamp with CLOCK_BOOTTIME; that can look plausible after a short suspension."""
    kernel.suspended_ns = round(suspended_s * 1e9)
    camera = FakeCamera(stamps="soe", stamp_offset_ns=kernel.suspended_ns)
    source = open_fake(camera, exposure_s=0.004)
    for _ in range(5):
        frame = source.read(1.0)
        assert abs(frame.t_exposure_mid_ns - camera.truth[frame.sequence].t_mid_ns) < 1000
        assert frame.stamp_rule == "soe(boottime)+exposure/2"


@pytest.mark.parametrize("suspended_s", [0.0, 1.0, 8.0, 3000.0])
@pytest.mark.parametrize("stalled_s", [0.0, 3.0, 15.0])
def test_monotonic_stamps_stay_what_they_are_after_a_suspension(
    open_fake, kernel, suspended_s: float, stalled_s: float
) -> None:
    camera = FakeCamera(stamps="soe")
    source = open_fake(camera, exposure_s=0.004, buffers=16)
    source.read(1.0)
    kernel.suspended_ns = round(suspended_s * 1e9)
    kernel.clock.sleep_until(kernel.clock.now_ns + round(stalled_s * 1e9))
    for _ in range(20):
        frame = source.read(1.0)
        assert abs(frame.t_exposure_mid_ns - camera.truth[frame.sequence].t_mid_ns) < 1000
        assert frame.stamp_rule == "soe+exposure/2"


def test_unflagged_but_plausible_stamps_are_used_and_said_to_be(open_fake) -> None:
    camera = FakeCamera(stamps="eof", flags=abi.BUF_FLAG_TIMESTAMP_UNKNOWN)  # v4l2loopback
    frame = open_fake(camera).read(1.0)
    assert frame.stamp_rule == "raw-eof(unflagged)"
    assert frame.t_exposure_mid_ns == camera.truth[frame.sequence].t_stamp_ns


def test_nonsense_stamps_are_replaced_by_the_arrival(open_fake) -> None:
    frame = open_fake(FakeCamera(stamp_offset_ns=10**15), exposure_s=0.004).read(1.0)
    assert frame.stamp_rule == "raw-arrival"
    assert frame.t_exposure_mid_ns == frame.t_arrival_ns


@pytest.mark.parametrize("offset_ns", [0, 1_700_000_000_000_000_000])
def test_images_that_waited_through_a_long_stall_keep_their_stamps(open_fake, kernel, offset_ns: int) -> None:
    """A process that was stopped for 15 s finds a full ring: by their arrival these images were of now."""
    camera = FakeCamera(stamps="soe", stamp_offset_ns=offset_ns)
    source = open_fake(camera, exposure_s=0.004, buffers=16)
    source.read(1.0)
    kernel.clock.sleep_until(kernel.clock.now_ns + 15_000_000_000)
    frames = [source.read(1.0) for _ in range(20)]
    late_s = [1e-9 * (f.t_arrival_ns - f.t_exposure_mid_ns) for f in frames]
    assert late_s[0] > 14.0 > 1.0 > late_s[-1]
    for frame in frames:
        assert abs(frame.t_exposure_mid_ns - camera.truth[frame.sequence].t_mid_ns) < 1000


def test_forced_anchor_overrides_a_lying_flag(open_fake) -> None:
    camera = FakeCamera(stamps="eof", flags=0x12000)  # claims start of exposure
    frame = open_fake(camera, exposure_s=0.004, readout_s=READOUT_S, stamp="eof").read(1.0)
    assert abs(frame.t_exposure_mid_ns - camera.truth[frame.sequence].t_mid_ns) < 1000


def test_sequence_counter_knows_gaps_wraps_and_restarts() -> None:
    counter = SequenceCounter(32)
    numbers = [5, 6, 9, (1 << 32) - 1, 0, 2, 2]
    assert [counter.missing_before(n) for n in numbers] == [0, 0, 2, 0, 0, 1, 0]
    gige = SequenceCounter(16, skips_zero=True)
    assert [gige.missing_before(n) for n in (65534, 65535, 1, 2, 4)] == [0, 0, 0, 0, 1]


PERIOD_NS = 33_366_700  # 29.97 Hz


def losses_found(stamps_ns: np.ndarray, missing: dict[int, int] | None = None) -> int:
    gaps = StampGaps()
    return sum(gaps.found(int(t), (missing or {}).get(k, 0)) for k, t in enumerate(stamps_ns))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("jitter_ns", [0, 3_000_000])
def test_every_frame_lost_inside_a_camera_is_counted(seed: int, jitter_ns: int) -> None:
    rng = np.random.default_rng(seed)
    all_of_them = np.arange(3000) * PERIOD_NS + rng.normal(0.0, jitter_ns, 3000)
    kept = np.ones(3000, dtype=bool)
    for start in rng.choice(np.arange(40, 2900, 40), 30, replace=False):
        kept[start : start + rng.integers(1, 14)] = False
    assert losses_found(all_of_them[kept]) == 3000 - kept.sum()


def test_late_stamps_and_another_pace_are_no_losses() -> None:
    even = np.arange(600) * PERIOD_NS
    late = even.copy()
    late[100::50] += 25_000_000  # three quarters of a period, caught up by the next frame
    assert losses_found(late) == 0
    bunched = even.copy()
    bunched[200:206] = bunched[206]  # six stamps at once
    assert losses_found(bunched) == 0
    darker = np.concatenate([even, even[-1] + 2 * PERIOD_NS * np.arange(1, 300)])  # half the rate in the dark
    assert losses_found(darker) == 0
    slowly = np.cumsum(PERIOD_NS * np.linspace(1.0, 2.0, 600))
    assert losses_found(slowly) == 0
    assert losses_found(np.cumsum(np.random.default_rng(3).exponential(PERIOD_NS, 40))) >= 0  # a trigger


def test_what_the_numbers_tell_is_not_counted_twice() -> None:
    stamps = np.delete(np.arange(200) * PERIOD_NS, [50, 51, 52, 80])
    assert losses_found(stamps, {50: 3, 77: 1}) == 0
    assert losses_found(stamps, {50: 1}) == 3
