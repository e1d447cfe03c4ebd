"""Clocks, links and faults of the emulation."""

from __future__ import annotations

import numpy as np
import pytest
from vical_mocks.clock import LINKS, FtdiLink, SkewedClock, UartLink, UsbLink, make_link
from vical_mocks.faults import ByteFaults, FaultyLink, drop_some


def test_skewed_clock_inverts_itself():
    clock = SkewedClock(100.0, 80.0, 5.0, 300.0)
    for t_s in (100.0, 150.0, 4000.0):
        assert clock.host_s(clock.device_s(t_s)) == pytest.approx(t_s, abs=1e-9)
    assert clock.device_s(1100.0) == pytest.approx(1000.08, abs=0.01)


@pytest.mark.parametrize("kind", LINKS)
def test_links_keep_bytes_and_order_and_never_arrive_early(kind):
    link = make_link(kind, np.random.default_rng(0))
    sent, got, last_s = b"", b"", 0.0
    for i in range(400):
        t_s = i * 0.01
        data = i.to_bytes(2, "big") * 15
        link.push(data, t_s)
        sent += data
        for arrival_s, chunk in link.poll(t_s):
            assert arrival_s >= last_s
            last_s, got = arrival_s, got + chunk
    got += b"".join(chunk for _, chunk in link.poll(1e9))
    assert got == sent
    assert link.next_s() is None


def test_uart_takes_ten_bits_a_byte_and_drops_what_never_fits():
    link = UartLink(np.random.default_rng(0), 115_200, jitter_s=0.0)
    link.push(bytes(31), 1.0)
    ((arrival_s, _),) = link.poll(9.0)
    assert arrival_s == pytest.approx(1.0 + 310 / 115_200)
    for i in range(1000):
        link.push(bytes(31), 10.0 + i * 1e-3)
    assert link.dropped > 500


def test_ftdi_waits_for_its_timer_or_62_bytes():
    slow = FtdiLink(np.random.default_rng(0), 921_600)
    delays = []
    for i in range(200):
        slow.push(bytes(31), i * 0.1)
        delays += [t_s - i * 0.1 for t_s, _ in slow.poll(i * 0.1 + 0.05)]
    assert 0.012 < max(delays) < 0.0175
    fast = FtdiLink(np.random.default_rng(0), 921_600)
    for i in range(20):
        fast.push(bytes(31), i * 1e-3)
    sizes = [len(data) for _, data in fast.poll(0.02)]
    assert sizes.count(62) >= len(sizes) - 2  # the timer's first firing cuts one packet short


def test_usb_polls_every_one_to_two_milliseconds():
    link = UsbLink(np.random.default_rng(0))
    for i in range(1000):
        link.push(b"x", i * 1e-3)
    times = np.unique([t_s for t_s, _ in link.poll(10.0)])
    assert np.diff(times).min() > 0.99e-3
    assert np.diff(times).max() < 4.01e-3


def test_byte_faults_are_repeatable_and_of_the_stated_rate():
    data = bytes(100_000)
    faults = {"lose": 0.01, "flip": 0.02, "double": 0.01}
    once, again = (ByteFaults(**faults, seed=4).apply(data) for _ in range(2))
    assert once == again
    assert len(once) == pytest.approx(100_000, abs=300)
    assert sum(v != 0 for v in once) == pytest.approx(2000, abs=250)
    assert ByteFaults().apply(b"abc") == b"abc"
    assert len(ByteFaults(at_start=50).apply(b"abc")) == 53


def test_stalls_hold_everything_back_and_then_deliver_it():
    link = FaultyLink(make_link("direct", np.random.default_rng(0)), stall_every_s=0.5, stall_s=0.2)
    got, delays = b"", []
    for i in range(1000):
        t_s = i * 0.01
        link.push(bytes([i % 256]), t_s)
        for arrival_s, data in link.poll(t_s):
            got += data
            delays.append(t_s - arrival_s)
    assert len(got) > 950
    assert got == bytes(i % 256 for i in range(len(got)))


def test_frames_are_lost_at_the_stated_rate():
    assert len(list(drop_some(range(10_000), 0.2))) == pytest.approx(8000, abs=150)
