"""Two hypotheses about a clock: against dense Gaussians, and on recordings with drift and without."""

import numpy as np
import pytest
from scipy.stats import norm
from vical_mocks.points import simulate
from vical_mocks.rig import Bump, reference_rig

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.model.priors import SKEW_SIGMA
from vical_daemon.estimation.model.state import CameraState, State, make_layout
from vical_daemon.estimation.noise.consistency import Consistency
from vical_daemon.estimation.noise.corner_noise import CornerNoise
from vical_daemon.estimation.selection.clock_drift import (
    apart,
    averaged,
    in_doubt,
    mixture,
    stamps_variance,
)

NAME = "cam0"


def some_filter(skew, factor=1.0):
    """Any filter with correlated errors and an estimated drift."""
    camera = CameraState(
        so3.exp(np.array([0.3, -0.2, 0.9])), np.array([0.03, -0.05, 0.02]), 0.004,
        np.array([460.0, 455.0, 325.0, 238.0]), np.zeros(4), "radtan", (640, 480), skew=skew,
    )  # fmt: skip
    state = State(
        1.0,
        np.eye(3),
        np.zeros(3),
        np.zeros(3),
        np.zeros(3),
        np.zeros(3),
        np.array([0.0, 0, -9.8]),
        {NAME: camera},
    )
    layout = make_layout({NAME: "radtan"}, fix=frozenset({"intrinsics"}), estimate=frozenset())
    S = 1e-4 * np.triu(np.random.default_rng(1).normal(size=(layout.size, layout.size)))
    where = layout.cameras[NAME].skew
    S[where] *= 1e-5 / np.linalg.norm(S[where])
    consistency = Consistency()
    consistency.factor = factor
    return CalibrationFilter(
        state, layout, S, ImuNoise(), {NAME: CornerNoise(0.5)}, np.zeros(layout.size), {NAME: consistency}
    )


def test_clocks_that_run_alike_are_the_gaussian_conditioned_on_no_drift():
    f = some_filter(2e-5)
    index, shift = f.layout.cameras[NAME].skew, f.layout.cameras[NAME].timeshift
    P = f.S @ f.S.T
    gain = P[:, index] / P[index, index]
    step, S, _ = mixture(f.S, np.zeros(len(P)), f.S, index, 2e-5, 0.0, 1.0)
    np.testing.assert_allclose(S @ S.T, P - np.outer(gain, P[index]), atol=1e-18)
    assert step[index] == pytest.approx(-2e-5, rel=1e-12)
    assert step[shift] == pytest.approx(-2e-5 * gain[shift], rel=1e-12)


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_odds_and_moments_are_those_of_the_mixture(factor):
    f = some_filter(4e-5, factor)
    index, shift = f.layout.cameras[NAME].skew, f.layout.cameras[NAME].timeshift
    P = factor * f.S @ f.S.T
    sigma = np.sqrt(P[index, index])
    p = apart(f, NAME)
    # Bayes' factor of a drift ~ N(0, SKEW_SIGMA^2) against none: the prior over the posterior density at zero
    bayes = norm.pdf(0.0, 0.0, SKEW_SIGMA) / norm.pdf(0.0, 4e-5, sigma)
    assert 0.01 < p < 0.999
    ratio = (p / (1.0 - p)) / bayes
    other = some_filter(1e-5, factor)
    q = apart(other, NAME)
    assert (q / (1 - q)) / (norm.pdf(0.0, 0.0, SKEW_SIGMA) / norm.pdf(0.0, 1e-5, sigma)) == pytest.approx(
        ratio
    )
    reported = averaged(f)
    gain = P[:, index] / P[index, index]
    closed = 0.004 - 4e-5 * gain[shift]
    mean = p * 0.004 + (1 - p) * closed
    variance = p * P[shift, shift] + (1 - p) * (P[shift, shift] - gain[shift] * P[index, shift])
    variance += p * (1 - p) * (0.004 - closed) ** 2
    assert reported.state.cameras[NAME].timeshift_s == pytest.approx(mean, rel=1e-12)
    assert factor * float(reported.S[shift] @ reported.S[shift]) == pytest.approx(variance, rel=1e-9)


def test_odds_go_the_way_of_the_evidence():
    none, some, much = (apart(some_filter(drift), NAME) for drift in (0.0, 3e-5, 8e-5))
    assert none < 0.02 < some < 0.99 < much
    f = some_filter(0.0)
    f.drifting.add(NAME)
    assert apart(f, NAME) == 1.0
    assert averaged(f) is f


def test_a_converged_result_is_doubted_later():
    """4 sigmas of drift keep a result from converging; a converged one is doubted once drift is likelier."""
    slight, strong = some_filter(3e-5), some_filter(4e-5)
    assert apart(slight, NAME) < 0.5 < apart(strong, NAME)
    assert in_doubt(slight, NAME, believed=False) and not in_doubt(slight, NAME, believed=True)
    assert in_doubt(strong, NAME, believed=True)


def calibrated(skew_ppm, seconds=13.0, bumps=()):
    """Every second's estimate, its events, and the truth."""
    rig = reference_rig(5, timeshift_cam_imu_s=0.01, clock_skew_ppm=skew_ppm, bumps=bumps)
    run = simulate(5, seconds, rig=rig)
    lens = CameraPrior((640, 480), tuple(rig.lens.intrinsics), "radtan", tuple(rig.lens.distortion))
    c = Calibrator(CalibrationOptions(fix=frozenset({"intrinsics"})), {NAME: lens}, run.points_m)
    items = sorted(
        [(int(t), k, None) for k, t in enumerate(run.t_imu_ns)] + [(f.t_cam_ns, -1, f) for f in run.frames],
        key=lambda item: item[0],
    )
    out, events, next_ns = [], [], run.frames[0].t_cam_ns
    for t_ns, k, frame in items:
        if frame is None:
            c.add_imu(t_ns, run.gyro_rps[k], run.specific_force_mps2[k])
            continue
        c.add_points(PointsFrame(NAME, t_ns, frame.ids, frame.uv_px))
        c.process()
        if c.filter is not None and t_ns >= next_ns:
            next_ns = t_ns + 1_000_000_000
            estimate = c.estimate()
            events += estimate.events
            camera = estimate.cameras[NAME]
            error = camera.timeshift_cam_imu_s - float(rig.timeshift_at(c.filter.state.t_s))
            out.append((error, camera.timeshift_sigma_s, estimate.status))
    return out, events


@pytest.mark.parametrize("skew_ppm", [100.0, -150.0])
def test_a_drifting_clock_is_followed_from_the_first_answer_on(skew_ppm):
    out, events = calibrated(skew_ppm)
    assert all(abs(error) < 4.0 * sigma for error, sigma, _ in out)  # taken as constant: 9 sigma at 10 s
    assert abs(out[-1][0]) < 3.0 * out[-1][1]
    assert any(e.kind is EventKind.CLOCK_DRIFT for e in events)
    assert abs(out[-1][0]) < 3e-4


def test_a_small_step_of_the_time_shift_is_no_constant_drift():
    """1 ms at 12 s: as a drift from the first second on, it is 0.2 ms and 3 sigmas off ten seconds later."""
    out, events = calibrated(0.0, 22.0, (Bump(12.0, timeshift_s=1e-3),))
    assert any(e.kind is EventKind.CLOCK_WANDER for e in events)
    assert not any(e.kind is EventKind.BUMPED for e in events)
    assert all(abs(error) < 2.5 * sigma for error, sigma, _ in out[-6:])
    assert abs(out[-1][0]) < 1e-4


def test_clocks_that_run_alike_pay_little():
    out, events = calibrated(0.0)
    assert all(abs(error) < 3.0 * sigma for error, sigma, _ in out)
    assert not any(e.kind in (EventKind.CLOCK_DRIFT, EventKind.CLOCK_WANDER) for e in events)
    assert out[-1][1] < 60e-6
    assert out[-1][2] == "converged"


def test_a_drift_too_small_to_be_seen_yet_does_not_make_it_lie():
    out, _ = calibrated(-60.0)
    assert all(abs(error) < 5.0 * sigma for error, sigma, _ in out)


def test_a_drift_that_errors_of_the_stamps_explain_is_no_drift():
    """8 us/s over 10 s, seen to 1 us/s: stamps known to 40 us explain that, but not 100 us/s."""
    assert apart(some_filter(8e-5), NAME) > 0.99
    slow, fast = some_filter(8e-6), some_filter(1e-4)
    for f in (slow, fast):
        row = f.layout.cameras[NAME].skew
        f.S[row] *= 1e-6 / np.linalg.norm(f.S[row])
        f.state.t_s, f.began_s = 12.0, 2.0
    assert apart(slow, NAME) > 0.99
    for f in (slow, fast):
        f.stamp_sigma_s = 40e-6
    assert apart(slow, NAME) < 0.05
    assert apart(fast, NAME) > 0.99


def test_stamps_variance_is_the_slope_of_a_step_halfway():
    t = np.linspace(0.0, 10.0, 2001)
    slope = np.polyfit(t, np.where(t < 5.0, 0.0, 40e-6), 1)[0]  # least squares: 1.5 steps over the length
    assert np.sqrt(stamps_variance(40e-6, 10.0)) == pytest.approx(slope, rel=0.4)
