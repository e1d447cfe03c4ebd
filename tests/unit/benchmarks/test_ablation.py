"""The ablation study takes away what it says, and only while it runs."""

import json

import numpy as np
import pytest

from benchmarks import ablation
from benchmarks.ablation_data import FAULTS
from benchmarks.ablation_disturbances import DISTURBANCES
from benchmarks.ablation_patches import SMALL, Mechanism, without
from vical_daemon.estimation.noise.consistency import Consistency


@pytest.mark.parametrize("name", ablation.MECHANISMS)
def test_each_mechanism_can_be_taken_away_and_is_back_afterwards(name):
    mechanism = ablation.MECHANISMS[name]
    before = [
        (owner, attribute, owner.__dict__.get(attribute)) for owner, attribute, *_ in mechanism.changes()
    ]
    assert before
    with without(mechanism):
        assert any(owner.__dict__.get(attribute) is not old for owner, attribute, old in before)
    assert all(owner.__dict__.get(attribute) is old for owner, attribute, old in before)
    assert set(mechanism.faults) <= set(FAULTS)
    assert set(mechanism.disturbances) <= set(DISTURBANCES)


def test_a_mechanism_that_has_gone_stops_the_study():
    gone = Mechanism(SMALL, "gone", lambda: [(Consistency, "_no_longer_there", None)])
    with pytest.raises(AttributeError), without(gone):
        pass
    of_objects = Mechanism(SMALL, "gone", lambda: [(Consistency, "_no_longer_there", None, True)])
    with pytest.raises(AttributeError), without(of_objects):
        pass


def _learnt():
    rng = np.random.default_rng(3)
    c = Consistency()
    common = 0.0
    uv = np.stack(np.meshgrid(np.linspace(100, 400, 8), np.linspace(80, 300, 6)), -1).reshape(-1, 2)
    for _ in range(400):
        common = 0.95 * common + rng.normal()
        innovation = 0.5 * rng.normal(size=uv.shape) + common
        c.learn(
            0.05 * c.images,
            uv,
            innovation,
            np.zeros((2 * len(uv), 3)),
            np.zeros((3, 3)),
            np.full(len(uv), 0.5),
        )
    return c


def test_without_a_mechanism_its_effect_is_gone():
    """Errors that last: both inflations see them, and each alone is taken away."""
    assert _learnt().factor > 2.0 and _learnt().scale > 2.0
    with without(ablation.MECHANISMS["autocorrelation"]):
        assert _learnt().factor == 1.0
    with without(ablation.MECHANISMS["noise scale"]):
        assert _learnt().scale == 1.0


def test_results_are_kept_and_shown_beside_those_of_all_mechanisms(tmp_path, capsys):
    code = ablation.runner.fingerprint("vical_daemon/estimation", "mocks/vical_mocks")
    euroc = {"arm_mm": 3.3, "shift_us": 3.0, "z": 1.3, "lens_z": [0.0, 0.0]}
    rows = [
        {"mechanism": ablation.NOTHING, "result": euroc, "code": code},
        {"mechanism": "noise scale", "result": {**euroc, "z": 7.0}, "code": code},
        {"mechanism": "lens floor", "result": {**euroc, "z": 9.0}, "code": "older"},
    ]
    lines = [json.dumps(row | {"data": "euroc", "case": "fixed", "seed": 0}) for row in rows]
    (tmp_path / "ablation.jsonl").write_text("\n".join(lines) + '\n{"interrupt', encoding="utf-8")
    assert ablation.main(["--table", "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "| noise scale | 3.30, 3, 7.0 |" in shown and "lens floor" not in shown
    assert ablation.main(["--table", "--keep-old", "--out", str(tmp_path)]) == 0
    assert "| lens floor | 3.30, 3, 9.0 |" in capsys.readouterr().out
