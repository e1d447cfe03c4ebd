"""Pauses between checks: the share of a core holds from the start of the process on."""

from __future__ import annotations

import pytest

from vical_daemon.calibrate.pause import LONGEST_S, Pause


class Process:
    """A process with a clock and CPU time of its own, which checks and rests."""

    def __init__(self, share, start_cpu_s):
        self.now_s, self.cpu_s = 1000.0, start_cpu_s
        self.pause = Pause(share, lambda: self.now_s, lambda: self.cpu_s)
        self.begin_s = self.now_s - start_cpu_s  # a start takes at least its CPU time

    def work(self, cpu_s, seconds):
        self.now_s, self.cpu_s = self.now_s + seconds, self.cpu_s + cpu_s

    def rest(self, idle_share=0.006, at_most_s=1e9):
        begin_s = self.now_s
        while not self.pause.over and self.now_s - begin_s < at_most_s:
            self.work(0.2 * idle_share, 0.2)
        return self.now_s - begin_s

    @property
    def share(self):
        return self.cpu_s / (self.now_s - self.begin_s)


@pytest.mark.parametrize("slower", [1.0, 5.0])
def test_start_checks_and_idling_together_stay_within_the_share(rng, slower):
    process = Process(0.03, 2.5 * slower)
    for check in range(20):
        if check:  # the first is made at once, and paid for later
            assert process.share <= 0.03
        process.pause.begin()
        process.work(slower * rng.uniform(2.0, 10.0), 30.0)
        process.rest()
    assert 0.028 < process.share <= 0.03  # and the share is used


def test_a_check_that_is_asked_for_is_paid_for_later():
    process = Process(0.03, 1.0)
    for _ in range(2):  # a suspicion is looked at again at once
        process.pause.begin()
        process.work(6.0, 30.0)
    process.rest()
    assert process.share <= 0.03


def test_a_long_rest_is_not_saved_up():
    process = Process(0.03, 1.0)
    process.work(0.0, 86400.0)
    process.pause.begin()
    process.work(6.0, 30.0)
    assert process.rest(idle_share=0.0) == pytest.approx(6.0 / 0.03 - 30.0, abs=1.0)


def test_calibrating_on_demand_is_not_paid_for_with_a_pause():
    process = Process(0.03, 0.0)
    assert process.pause.over
    process.work(90.0, 120.0)
    process.pause.excuse()
    process.pause.begin()
    process.work(3.0, 30.0)
    assert process.rest(idle_share=0.0) < 3.0 / 0.03


def test_other_work_in_the_process_does_not_starve_the_checks():
    process = Process(0.03, 1.0)
    process.pause.begin()
    assert process.rest(idle_share=0.2) == pytest.approx(LONGEST_S, abs=1.0)
