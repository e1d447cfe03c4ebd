"""Which of several independent calibrations disagrees."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.result import CameraEstimate, PoseEstimate
from vical_daemon.estimation.tools.agreement import CALIBRATIONS_DISAGREE, Agreement, agreements, calibrations

ARM = np.array([0.1, -0.05, 0.02])
TURN = Rotation.from_rotvec([1.0, -2.0, 0.5])


def covariance(rng: np.random.Generator) -> np.ndarray:
    """Of lever arm and rotation, correlated; 1 to 3 mm, 0.03 to 0.1 deg."""
    size = np.array([1e-3] * 3 + [5e-4] * 3) * rng.uniform(1.0, 3.0)
    A = rng.standard_normal((6, 6)) + 2.0 * np.eye(6)
    P = A @ A.T
    scale = size / np.sqrt(np.diag(P))
    return P * np.outer(scale, scale)


def camera(
    rng: np.random.Generator, *, moved_m: float = 0.0, turned_rad: float = 0.0, late_s: float = 0.0
) -> dict[str, CameraEstimate]:
    P = covariance(rng)
    error = rng.multivariate_normal(np.zeros(6), P)
    R = TURN * Rotation.from_rotvec([error[3] + turned_rad, *error[4:]])
    pose = PoseEstimate(
        (ARM + error[:3] + np.array([0.0, moved_m, 0.0])).tolist(),
        np.roll(R.as_quat(), 1).tolist(),
        P.tolist(),
    )
    shift_s = 0.01 + late_s + 1e-4 * rng.standard_normal()
    lens = [500.0 + rng.standard_normal(), 500.0, 320.0, 240.0]
    fixed = [0.0] * 4
    return {
        "cam0": CameraEstimate(pose, shift_s, 1e-4, lens, [1.0, 0.0, 0.0, 0.0], "radtan", fixed, fixed, 0.3)
    }


def verdicts(estimates: list, *, common_clock: bool = True) -> list[Agreement]:
    return agreements(calibrations(estimates, common_clock=common_clock))


def test_false_alarms_are_as_rare_as_promised(rng) -> None:
    alarms = [any(a.agrees is False for a in verdicts([camera(rng) for _ in range(6)])) for _ in range(100)]
    assert sum(alarms) <= 2  # 0.1 expected


@pytest.mark.parametrize("change", [{"moved_m": 0.04}, {"turned_rad": 0.03}, {"late_s": 2e-3}])
@pytest.mark.parametrize("count", [3, 8])
def test_the_one_that_differs_is_named_with_what_differs(rng, change, count) -> None:
    for wrong in range(count):
        found = verdicts([camera(rng, **(change if k == wrong else {})) for k in range(count)])
        assert [k for k, a in enumerate(found) if a.agrees is False] == [wrong]
        worst = min(found[wrong].differences, key=lambda d: d.probability)
        assert worst.what == {"m": "lever arm", "t": "rotation", "l": "time shift"}[next(iter(change))[0]]
        assert np.linalg.norm(worst.value) == pytest.approx(next(iter(change.values())), rel=0.5)


def test_two_that_differ_alike_do_not_win_against_four(rng) -> None:
    estimates = [camera(rng, moved_m=0.02 if k > 3 else 0.0) for k in range(6)]
    assert [a.agrees for a in verdicts(estimates)] == [True] * 4 + [False] * 2


def test_of_two_nobody_can_tell_which_is_wrong(rng) -> None:
    assert [a.agrees for a in verdicts([camera(rng), camera(rng, turned_rad=0.02)])] == [False, False]


def test_one_without_a_result_cannot_be_compared(rng) -> None:
    found = verdicts([camera(rng), None, camera(rng)])
    assert [a.agrees for a in found] == [True, None, True]
    assert [a.agrees for a in verdicts([camera(rng), None])] == [None, None]


def test_clocks_apart_are_not_compared(rng) -> None:
    estimates = [camera(rng), camera(rng), camera(rng, late_s=0.5)]
    assert [a.agrees for a in verdicts(estimates)] == [True, True, False]
    assert all(a.agrees for a in verdicts(estimates, common_clock=False))


def test_chances_are_those_of_chi_square(rng) -> None:
    """Of 200 differences, as many are below a probability as it says."""
    chances = [d.probability for _ in range(20) for d in verdicts([camera(rng), camera(rng)])[0].differences]
    assert len(chances) == 20 * 4  # lever arm, rotation, time shift, one number of the lens
    assert np.mean(np.array(chances) < 0.5) == pytest.approx(0.5, abs=0.2)
    assert min(chances) > CALIBRATIONS_DISAGREE
