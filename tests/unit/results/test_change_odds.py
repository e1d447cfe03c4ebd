"""Odds of a change: sizes, blocks, and looks as often as one likes; Gaussians drawn by numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal, multivariate_t

from vical_daemon.results.change_odds import (
    DOF_PER_S,
    FALSE_ALARM,
    MISSED,
    SAME,
    VISIBLE,
    Counts,
    odds,
    visible_sigmas,
)

COUNTS = Counts().of_errors(460.0, 15)
SURE = math.log(1.0 / FALSE_ALARM)


def test_counts_are_in_the_units_of_the_errors():
    assert COUNTS[:7] == pytest.approx([2e-3] * 3 + [np.deg2rad(0.2)] * 3 + [1e-3])
    assert COUNTS[7:11] == pytest.approx([2.3] * 4)
    assert len(Counts().of_errors(460.0, 7)) == 7


def test_odds_are_ratios_of_gaussians():
    """All ways alike: the mean of the ratios of densities over subsets of blocks and sizes, by scipy."""
    rng = np.random.default_rng(3)
    mixed = rng.standard_normal((7, 7))
    P, e = mixed @ mixed.T + np.eye(7), rng.standard_normal(7)  # in units of what counts
    blocks = [(0, 1, 2), (3, 4, 5), (6,)]
    ratios = []
    for k in range(1, 8):
        W = np.zeros(7)
        W[[i for b, block in enumerate(blocks) if k >> b & 1 for i in block]] = 1.0
        for size in (1.0, 3.0, 10.0):
            logs = [multivariate_normal.logpdf(e, np.zeros(7), V) for V in (P + size**2 * np.diag(W), P)]
            ratios.append(np.exp(logs[0] - logs[1]))
    d, S = e * COUNTS[:7], P * np.outer(COUNTS[:7], COUNTS[:7])
    found = odds(d, S, 0.1 * S, COUNTS[:7])
    assert found.log_changed == pytest.approx(np.log(np.mean(ratios)), rel=1e-6)


@pytest.mark.parametrize(
    ("block", "places"), [("position", [0, 1, 2]), ("rotation", [3]), ("time shift", [6]), ("lens", [7, 8])]
)
def test_a_change_that_counts_is_found_named_and_sized(block, places):
    S = np.diag((COUNTS / 12.0) ** 2)
    d = np.zeros(15)
    d[places] = COUNTS[places]
    found = odds(d, S, 0.5 * S, COUNTS)
    assert found.log_changed > SURE
    assert found.blocks == (block,)
    assert found.moved[places] == pytest.approx(d[places], rel=0.01)
    assert block in found.undecided
    same = odds(np.zeros(15), S, 0.5 * S, COUNTS)
    assert not same.undecided
    assert same.probability < 0.01


def test_a_block_is_named_only_if_the_recording_cannot_be_explained_without_it():
    """A turn far beyond doubt, and a time shift of three sigmas, which chance explains as well."""
    sigma = np.where(np.arange(15) == 6, 1e-4, COUNTS / 12.0)
    d = np.zeros(15)
    d[4], d[6] = 4.0 * COUNTS[4], 3.0 * sigma[6]
    assert odds(d, np.diag(sigma**2), 0.1 * np.diag(sigma**2), COUNTS).blocks == ("rotation",)
    d[6] = 8.0 * sigma[6]
    assert odds(d, np.diag(sigma**2), 0.1 * np.diag(sigma**2), COUNTS).blocks == ("rotation", "time shift")


def test_a_lens_that_was_focused_is_found_where_a_new_lens_could_not_be():
    """Odds of a lens are those of a new one, or of a change of what counts alone; both by scipy."""
    sigma = np.where(np.arange(15) < 11, 1.0 / 7.5, 1.0 / 50.0)  # in units of what counts
    e = np.zeros(15)
    e[7:9] = 0.7  # 7.4 sigmas along that direction
    P = np.diag(sigma**2)
    ways = np.zeros((3, 15))
    ways[0, 7:9] = ways[1, 9] = ways[2, 10] = 1.0
    new = np.diag(np.where(np.arange(15) >= 7, 1.0, 0.0))
    null = multivariate_normal.logpdf(e, np.zeros(15), P)
    logs = {
        kind: np.logaddexp.reduce(
            [multivariate_normal.logpdf(e, np.zeros(15), P + n**2 * W) - null for n in (1, 3, 10)]
        )
        - np.log(3.0)
        for kind, W in (("focused", ways.T @ ways), ("new", new))
    }
    d, S = e * COUNTS, P * np.outer(COUNTS, COUNTS)
    found = odds(d, S, 0.1 * S, COUNTS)
    assert logs["new"] < SURE + np.log(15.0) < np.logaddexp(*logs.values()) - np.log(2.0)
    assert found.log_changed > SURE
    assert found.blocks == ("lens",)
    assert found.moved[7:9] == pytest.approx(d[7:9], rel=0.05)


@pytest.mark.parametrize("times", [1.0, 10.0, 100.0])
def test_a_change_of_any_size_is_named_alone(times):
    """A turn far larger than what counts is not explained by further blocks."""
    rng = np.random.default_rng(5)
    mixed = rng.standard_normal((15, 15))
    S = (mixed @ mixed.T + 3.0 * np.eye(15)) * np.outer(COUNTS, COUNTS) / 30.0**2
    d = np.zeros(15)
    d[3:6] = times * COUNTS[3] * np.array([0.6, -0.6, 0.53])
    found = odds(d, S, 0.1 * S, COUNTS)
    assert found.blocks == ("rotation",)
    assert found.moved[3:6] == pytest.approx(d[3:6], rel=0.1)


def test_what_is_not_visible_is_not_decided():
    """A sigma as large as what counts: neither `holds` nor `changed`; a stored sigma raises what counts."""
    S = np.diag(COUNTS**2)
    found = odds(np.zeros(15), S, 0.01 * S, COUNTS)
    assert found.undecided == ["position", "rotation", "time shift", "lens"]
    assert found.log_changed < 0.0
    assert found.visible["time shift"] == pytest.approx(VISIBLE)
    stored = np.diag((COUNTS * np.where(np.arange(15) < 3, 2.0, 0.01)) ** 2)
    assert odds(np.zeros(15), stored + 1e-6 * S, stored, COUNTS).floor["position"] == pytest.approx(
        2.0 * VISIBLE
    )


def test_looking_every_time_raises_no_more_false_alarms_and_misses_than_promised():
    """Data come one by one, and the first decision counts: the bounds hold for all looks together [Ville]."""
    rng = np.random.default_rng(11)
    stored = np.diag((COUNTS[:7] / 20.0) ** 2)
    wrong = {0.0: 0, 1.0: 0}
    for truth in wrong:
        for _ in range(60):
            offset = truth * COUNTS[:7] * (np.arange(7) == 5) + rng.normal(0.0, COUNTS[:7] / 20.0)
            seen = offset + rng.normal(0.0, 3.0 * COUNTS[:7], (400, 7))
            for n in range(10, 401, 30):
                S = stored + np.diag((3.0 * COUNTS[:7]) ** 2 / n)
                found = odds(seen[:n].mean(axis=0), S, stored, COUNTS[:7])
                if not found.undecided or found.log_changed > SURE:
                    wrong[truth] += found.undecided == [] if truth else found.undecided != []
                    break
    assert wrong[0.0] <= 1  # FALSE_ALARM * 60 = 0.06
    assert wrong[1.0] <= 4  # MISSED * 60 = 0.6: the probability of 5 or more is below 0.001
    assert MISSED == 0.01


def test_where_the_model_does_not_fit_odds_are_ratios_of_students_densities():
    """With a small difference of its own, and one unknown factor of all sigmas; by scipy, one block."""
    rng, seconds = np.random.default_rng(7), 6.0
    mixed = rng.standard_normal((7, 7))
    P, e = mixed @ mixed.T + np.eye(7), 3.0 * rng.standard_normal(7)  # in units of what counts
    d, S = e * COUNTS[:7], P * np.outer(COUNTS[:7], COUNTS[:7])
    found = odds(d, S, 0.1 * S, COUNTS[:7], seconds)
    near, dof = P + SAME**2 * np.eye(7), DOF_PER_S * seconds
    late = np.zeros(7)
    late[6] = max(1.0, found.floor["time shift"])
    logs = [multivariate_t.logpdf(e, at, near, df=dof) for at in (np.zeros(7), late, -late)]
    assert found.log_holds["time shift"] == pytest.approx(logs[0] - max(logs[1:]), rel=1e-9)
    ratios = []
    for k in range(1, 8):
        at = [i for b, block in enumerate([(0, 1, 2), (3, 4, 5), (6,)]) if k >> b & 1 for i in block]
        W = np.diag(np.isin(np.arange(7), at).astype(float))
        ratios += [
            multivariate_t.logpdf(e, np.zeros(7), near + n**2 * W, df=dof) - logs[0] for n in (1, 3, 10)
        ]
    assert found.log_changed == pytest.approx(np.log(np.mean(np.exp(ratios))), rel=1e-9)


def test_a_misfit_in_all_directions_is_no_change_where_the_model_does_not_fit():
    """Chi-square of seven times its degrees of freedom, as at times on EuRoC; one block is a change."""
    rng, sigma = np.random.default_rng(2), COUNTS / 10.0
    S = np.diag(sigma**2)
    d = math.sqrt(7.0) * sigma * rng.choice([-1.0, 1.0], 15)
    assert odds(d, S, 0.1 * S, COUNTS).log_changed > SURE
    assert odds(d, S, 0.1 * S, COUNTS, 4.0).log_changed < SURE
    d[3:6] = 5.0 * COUNTS[3]
    moved = odds(d, S, 0.1 * S, COUNTS, 4.0)
    assert moved.log_changed > SURE and moved.blocks == ("rotation",)


def test_what_is_visible_needs_more_where_sigmas_are_known_less_well():
    assert pytest.approx(5.1, abs=0.01) == VISIBLE
    assert visible_sigmas(15, 1e9) == pytest.approx(VISIBLE)
    assert visible_sigmas(15, 20.0) > visible_sigmas(15, 40.0) > VISIBLE
