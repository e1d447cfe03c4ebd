"""A converged calibration does not flicker; what matters shows at once."""

from __future__ import annotations

import pytest

from vical_daemon.estimation.guidance import Block, Guidance, Verb, WeakDirection
from vical_daemon.estimation.result import Status
from vical_daemon.estimation.status.evaluator import SteadyStatus, Verdict

CONVERGED = Verdict(Status.CONVERGED)
DOUBT = Verdict(Status.CONVERGING, "the time shift still moves", Guidance(Verb.TURN, ("x",)))


def test_a_doubt_of_one_second_is_not_shown():
    steady = SteadyStatus()
    shown = [steady.follow(v, 0.2 * k) for k, v in enumerate([CONVERGED] * 5 + [DOUBT] * 6 + [CONVERGED] * 5)]
    assert set(shown) == {CONVERGED}


def test_a_doubt_that_stays_is_shown_with_its_reason_and_then_has_to_go_for_good():
    steady = SteadyStatus()
    steady.follow(CONVERGED, 0.0)
    shown = [steady.follow(DOUBT, 1.0 + 0.2 * k) for k in range(20)]
    assert shown[0] == CONVERGED and shown[-1] == DOUBT
    assert shown == sorted(shown, key=lambda v: v == DOUBT)  # one change
    assert steady.follow(CONVERGED, 6.0) == CONVERGED
    assert steady.follow(DOUBT, 6.2) == CONVERGED  # patience begins anew


@pytest.mark.parametrize("status", [Status.INCONSISTENT, Status.DEGENERATE, Status.WAITING])
def test_whatever_is_worse_shows_at_once(status):
    steady = SteadyStatus()
    steady.follow(CONVERGED, 0.0)
    assert steady.follow(Verdict(status, "why"), 0.1) == Verdict(status, "why")


def test_a_sigma_may_grow_to_twice_its_limit_before_it_counts_again():
    steady, nothing = SteadyStatus(), Guidance()
    weak = [WeakDirection(Block.TIMESHIFT, (0.0, 0.0, 0.0), s, 1e-3, nothing) for s in (2.1e-3, 1.9e-3)]
    assert steady.counted(weak) == weak
    steady.follow(CONVERGED, 0.0)
    assert steady.counted(weak) == weak[:1]


def test_a_changed_rig_is_not_converged_for_another_moment():
    steady = SteadyStatus()
    steady.follow(CONVERGED, 0.0)
    steady.reset(Status.CONVERGING)
    assert steady.status is Status.CONVERGING
    assert steady.follow(DOUBT, 0.1) == DOUBT
