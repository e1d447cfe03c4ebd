"""What noise makes of the best estimate: against integration by brute force, chance, and vical itself."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from vical_mocks.cramer_rao.bound import bounds
from vical_mocks.harness.feed import feed
from vical_mocks.points import simulate

from benchmarks.luck import draw_of
from benchmarks.montecarlo import CASES, bound_options, bound_sigmas, make_run, make_subject, vector_of

KNOWN = CASES["reference, lens known"]


def test_a_push_is_how_far_integrated_readings_miss():
    run = simulate(5, 1.0, camera_rate_hz=10.0)
    rig, (a, b), steps = run.rig, (run.frames[3].t_s, run.frames[4].t_s), 4000
    nodes = 0.01 * np.arange(len(run.gyro_rps))
    h = (b - a) / steps
    middles = a + h * (np.arange(steps) + 0.5)
    wrong = np.hstack([run.gyro_rps, run.specific_force_mps2]) - np.hstack(rig.imu_motion(nodes))
    bias = np.concatenate([rig.gyro_bias.value(a), rig.accel_bias.value(a)])
    off = np.array([np.interp(middles, nodes, column) for column in wrong.T]).T - bias
    rate, force = rig.imu_motion(middles)
    path = rig.trajectory
    R, v, p = Rotation.from_matrix(path.R_world_imu(a)), path.v_world_imu(a), path.p_world_imu(a)
    for w, f in zip(rate + off[:, :3], force + off[:, 3:], strict=True):
        half = R * Rotation.from_rotvec(0.5 * h * w)
        acceleration = half.apply(f) + rig.gravity_world_mps2
        p, v, R = (
            p + h * v + 0.5 * h * h * acceleration,
            v + h * acceleration,
            R * Rotation.from_rotvec(h * w),
        )
    missed = [
        (Rotation.from_matrix(path.R_world_imu(b)).inv() * R).as_rotvec(),
        v - path.v_world_imu(b),
        p - path.p_world_imu(b),
    ]
    push = draw_of(run).pushes[3]
    for part, expected in zip((push[:3], push[3:6], push[6:9]), missed, strict=True):
        assert part == pytest.approx(expected, abs=0.01 * np.abs(expected).max())
    change = np.concatenate([rig.gyro_bias.value(b), rig.accel_bias.value(b)]) - bias
    assert push[9:] == pytest.approx(-change)


def test_errors_are_those_that_the_bound_expects():
    nees = []
    for seed in range(12):
        run = make_run(KNOWN, seed, 4.0)
        (found,) = bounds(run, bound_options(KNOWN, run), [4.0], draw_of(run))
        place = [i for name in ("p_imu_cam", "r_imu_cam", "timeshift") for i in _range(found.slices[name])]
        error, P = found.error[place], found.covariance[np.ix_(place, place)]
        nees.append(error @ np.linalg.solve(P, error))
    low, high = chi2.ppf([0.001, 0.999], 12 * 7)
    assert low < sum(nees) < high


def test_they_are_the_errors_of_vical_but_for_what_it_adds():
    for seed in (0, 1):
        run = make_run(KNOWN, seed, 12.0)
        (best,) = bounds(run, bound_options(KNOWN, run), [10.0], draw_of(run))
        shot = feed(run, make_subject(KNOWN, run, seed, "vical"), until_s=10.1).at(10.0)
        sigma = np.array(bound_sigmas(best))[:7]
        apart = (np.array(shot.error)[:7] - vector_of(best, best.error)[:7]) / sigma
        assert np.abs(apart).max() < 1.0
        assert np.sqrt((apart**2).mean()) < 0.5


@pytest.mark.parametrize("what", ["stamp_jitter_s", "accel_lag_s"])
def test_errors_that_are_no_noise_are_refused(what):
    with pytest.raises(ValueError, match=what):
        draw_of(simulate(5, 1.0, **{what: 1e-3}))


def test_an_imu_that_is_off_is_no_noise():
    off = make_run(CASES["imu 1 % off"], 1, 2.0)
    true = make_run(CASES["reference"], 1, 2.0)
    assert draw_of(off).pushes == pytest.approx(draw_of(true).pushes)


def _range(place):
    return range(place.start, place.stop)
