"""Scores against numbers worked out by hand; trials that are interrupted and resumed."""

import argparse
import json

import numpy as np
import pytest
from vical_mocks.harness.feed import nees

from benchmarks import runner, scores
from benchmarks.montecarlo import lying


def result(error, sigma, bound):
    covariance = np.diag(np.square(sigma))
    at = {"error": error, "sigma": sigma, "bound": bound, "nees": nees(error, covariance, 7)}
    trace = {"t_s": [1.0, 2.0], "error": [error, error], "sigma": [sigma, sigma], "nees": [1.0, 1.0]}
    return {"at": {"10": at}, "trace": trace | {"status": ["converging", "converged"]}}


def test_score_of_errors_at_twice_the_bound():
    rng = np.random.default_rng(0)
    bound = np.linspace(1.0, 2.0, 15)
    results = [result(2 * bound * rng.standard_normal(15), 2 * bound, bound) for _ in range(400)]
    s = scores.score(results, 10.0, 7)
    np.testing.assert_allclose(s.ratio, 2.0, rtol=0.15)
    np.testing.assert_allclose(s.sigma_ratio, 2.0)
    low, high = scores.band(400, 7, 0.999)
    assert low < s.anees < high
    inside, worst = scores.coverage(results, 7)
    assert worst <= inside
    assert inside == pytest.approx(0.9973, abs=0.003)


def test_nees_is_nan_when_something_is_held_fixed():
    assert np.isnan(nees(np.ones(15), np.zeros((15, 15)), 7))
    assert nees(2 * np.ones(15), np.eye(15), 7) == pytest.approx(28.0)


def test_trials_without_an_answer_are_counted_not_averaged():
    ones = np.ones(15)
    results = [result(ones, ones, ones), {"at": {"10": None}, "trace": {"error": [], "sigma": []}}]
    s = scores.score(results, 10.0, 7)
    assert (s.trials, s.asked) == (1, 2)
    assert "| 1/2 |" in scores.row("name", s, scores.coverage(results, 7))


def test_a_lie_is_converged_beyond_five_sigma():
    ones = np.ones(15)
    assert not lying(result(4 * ones, ones, ones))
    assert lying(result(6 * ones, ones, ones))


def options(folder, jobs=1, keep_old=False):
    return argparse.Namespace(out=folder, jobs=jobs, keep_old=keep_old)


def test_interrupted_trials_go_on_where_they_stopped(tmp_path):
    calls = []

    def trial(seed):
        calls.append(seed)
        return {"value": np.float64(seed) ** 2, "list": np.arange(seed)}

    runner.run_trials("study", trial, range(3), options(tmp_path), "code1")
    with (tmp_path / "study.jsonl").open("a") as file:
        file.write('{"seed": 3, "co')  # killed while writing
    results = runner.run_trials("study", trial, range(5), options(tmp_path), "code1")
    assert calls == [0, 1, 2, 3, 4]
    assert [r["value"] for r in results] == [0, 1, 4, 9, 16]
    assert results[3]["list"] == [0, 1, 2]


def test_results_of_other_code_are_not_used(tmp_path):
    runner.run_trials("study", lambda _: {"v": 1}, range(2), options(tmp_path), "code1")
    fresh = runner.run_trials("study", lambda _: {"v": 2}, range(2), options(tmp_path), "code2")
    assert [r["v"] for r in fresh] == [2, 2]
    kept = runner.run_trials("study", lambda _: {"v": 3}, range(2), options(tmp_path, keep_old=True), "code3")
    assert {r["v"] for r in kept} <= {1, 2}
    lines = (tmp_path / "study.jsonl").read_text().splitlines()
    assert len(lines) == 4
    assert json.loads(lines[0])["code"] == "code1"


def test_fingerprint_changes_with_the_source():
    assert runner.fingerprint("benchmarks/bound.py") != runner.fingerprint("benchmarks/scores.py")
    assert len(runner.fingerprint("benchmarks")) == 12
