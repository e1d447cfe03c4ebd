"""A lens that is held: the answer is that of the stated lens, with sigmas that include what it may do."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from tests.unit.estimation.test_calibrator import calibrate, errors, prior
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.snapshot import camera_estimate
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise
from vical_daemon.estimation.model import unscented
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.model.retract import retract
from vical_daemon.estimation.model.state import CameraState, State, make_layout
from vical_daemon.estimation.noise.consistency import Consistency
from vical_daemon.estimation.noise.corner_noise import CornerNoise
from vical_daemon.estimation.result import Status
from vical_daemon.estimation.selection import clock_drift, model_mixture, model_selection

NAME = "cam0"
HELD = CalibrationOptions(fix=frozenset({"intrinsics"}))
STATED = (0.4, 0.4, 0.3, 0.3)


class Linear:
    """Measurements of all errors of a filter whose lens lies `off` times its prior's sigma off."""

    def __init__(self, off: float, given: bool = False, estimate: frozenset = frozenset()):
        rng = np.random.default_rng(3)
        self.lens = FixedLens.of(
            CameraPrior(
                (640, 480), (460.0, 455.0, 325.0, 238.0), "radtan", (-0.2, 0.1, 0.0, 0.0),
                intrinsics_sigma=STATED if given else None, distortion_sigma=(1e-3,) * 4 if given else None,
            )
        )  # fmt: skip
        self.layout = make_layout(
            {NAME: "radtan"}, fix=frozenset({"intrinsics"}), estimate=estimate, held={NAME: self.lens}
        )
        n = self.layout.size
        self.where = self.layout.lens(NAME)
        self.prior = np.full(n, 1e-3)
        self.prior[self.where] = self.lens.off_sigma
        self.skew = self.layout.cameras[NAME].skew
        self.H = rng.normal(size=(2 * n, n)) / self.prior
        truth = 0.3 * self.prior * rng.normal(size=n)
        truth[self.where] = off * self.lens.off_sigma * rng.normal(size=8)
        self.noise = 0.7
        self.z = self.H @ truth + self.noise * rng.normal(size=2 * n)

    def posterior(self, lens_sigma: np.ndarray, zero: int | None = None):
        sigma = self.prior.copy()
        sigma[self.where] = np.maximum(lens_sigma, 1e-9)
        if zero is not None:
            sigma[zero] = 1e-9
        P = np.linalg.inv(np.diag(sigma**-2.0) + self.H.T @ self.H / self.noise**2)
        return P @ self.H.T @ self.z / self.noise**2, P

    def filter(self) -> CalibrationFilter:
        x, P = self.posterior(self.lens.off_sigma)
        camera = CameraState(
            np.eye(3), np.zeros(3), 0.0, self.lens.values[:4].copy(), self.lens.values[4:].copy(), "radtan",
            (640, 480),
        )  # fmt: skip
        zero = np.zeros(3)
        state = State(0.0, np.eye(3), zero, zero, zero, zero, np.array([0.0, 0.0, -9.8]), {NAME: camera})
        return CalibrationFilter(
            retract(state, self.layout, x),
            self.layout,
            unscented.upper_root(unscented.root(P)),
            ImuNoise(),
            {NAME: CornerNoise(0.5)},
            np.zeros(self.layout.size),
            {NAME: Consistency()},
        )


def arm_of(problem: Linear, x):
    return x[problem.layout.cameras[NAME].position]


def test_a_lens_that_is_as_stated_costs_nothing_and_is_known_exactly():
    problem = Linear(off=0.0)
    shown = model_selection.averaged(problem.filter())
    x, P = problem.posterior(np.zeros(8))
    np.testing.assert_allclose(shown.state.cameras[NAME].p_imu_cam, arm_of(problem, x), atol=1e-8)
    rest = np.ones(problem.layout.size, dtype=bool)
    rest[problem.where] = False
    np.testing.assert_allclose((shown.S @ shown.S.T)[np.ix_(rest, rest)], P[np.ix_(rest, rest)], rtol=0.01)
    assert shown.sigmas()[problem.where].max() < 0.02 * problem.lens.off_sigma.max()


def test_a_wrong_lens_keeps_the_answer_of_the_stated_one_and_widens_it_by_what_the_lens_does():
    problem = Linear(off=1.0)
    f = problem.filter()
    assert model_mixture.not_zero(model_selection.weights(f), model_mixture.lens_block(NAME)) > 0.99
    shown = model_selection.averaged(f)
    x, _ = problem.posterior(np.zeros(8))
    free, P = problem.posterior(problem.lens.off_sigma)
    position = problem.layout.cameras[NAME].position
    np.testing.assert_allclose(shown.state.cameras[NAME].p_imu_cam, arm_of(problem, x), atol=1e-6)
    away = x - free
    expected = P + np.outer(away, away)
    np.testing.assert_allclose(
        (shown.S @ shown.S.T)[position, position], expected[position, position], rtol=1e-3
    )
    camera = camera_estimate(shown, NAME, 0.3)
    assert camera.intrinsics == problem.lens.values[:4].tolist()
    lens_sigma = np.sqrt(np.diag(expected)[problem.where])
    np.testing.assert_allclose([*camera.intrinsics_sigma, *camera.distortion_sigma], lens_sigma, rtol=1e-3)


@pytest.mark.parametrize("asked", [False, True])
def test_with_a_wrong_lens_all_that_was_not_asked_for_is_reported_as_specified(asked):
    """Else the errors of the lens look like errors of imu and target, which other calibrators do not know."""
    problem = Linear(off=1.0, estimate=frozenset({"target_scale"}))
    f = problem.filter()
    f.off |= {"target_scale"}  # known to be off, or asked for
    shown = model_selection.averaged(f, asked={"target_scale"} if asked else set())
    size = problem.layout.target_scale
    x, _ = problem.posterior(np.zeros(8), None if asked else size)
    free, P = problem.posterior(problem.lens.off_sigma)
    np.testing.assert_allclose(shown.state.cameras[NAME].p_imu_cam, arm_of(problem, x), atol=1e-6)
    assert shown.state.target_scale - 1.0 == pytest.approx(x[size] if asked else 0.0, abs=1e-7)
    rows = problem.layout.cameras[NAME].position
    expected = P + np.outer(x - free, x - free)
    np.testing.assert_allclose((shown.S @ shown.S.T)[rows, rows], expected[rows, rows], rtol=1e-3)


def test_a_stated_sigma_is_allowed_for_even_where_nothing_contradicts_the_lens():
    problem = Linear(off=0.0, given=True)
    shown = model_selection.averaged(problem.filter())
    held, _ = problem.posterior(np.zeros(8))
    best, P = problem.posterior(problem.lens.sigma)
    position = problem.layout.cameras[NAME].position
    np.testing.assert_allclose(shown.state.cameras[NAME].p_imu_cam, arm_of(problem, held), atol=1e-6)
    away = held - best
    expected = P + np.outer(away, away)
    np.testing.assert_allclose(
        (shown.S @ shown.S.T)[position, position], expected[position, position], rtol=0.02
    )
    np.testing.assert_allclose(
        shown.sigmas()[problem.where], np.sqrt(np.diag(expected)[problem.where]), rtol=0.02
    )


def test_the_odds_of_a_stated_sigma_are_those_of_two_priors():
    rng = np.random.default_rng(8)
    H, share = rng.normal(size=(9, 4)), np.array([0.1, 0.0, 0.5, 0.2])
    z = H @ np.array([0.5, -0.4, 0.2, 0.9]) + 0.3 * rng.normal(size=9)
    P = np.linalg.inv(np.eye(4) + H.T @ H / 0.09)
    by_priors = [
        multivariate_normal(np.zeros(9), H @ np.diag(s**2) @ H.T + 0.09 * np.eye(9)).logpdf(z)
        for s in (np.ones(4), share)
    ]
    noise = share / np.sqrt(1.0 - share**2)
    found = model_mixture.log_bayes_factors(P @ H.T @ z / 0.09, P, [4], 1.0, noise)[1]
    assert found == pytest.approx(by_priors[0] - by_priors[1], abs=1e-6)


def test_the_covariance_over_lens_and_clocks_is_about_what_is_reported():
    """The clocks are judged by the lens that the images show: the given one may look like a drift."""
    problem = Linear(off=1.0)
    at = problem.skew
    shown = clock_drift.averaged(model_selection.averaged(problem.filter()))
    free, P = problem.posterior(problem.lens.off_sigma)  # images contradict the lens beyond doubt
    held, given = problem.posterior(np.zeros(8))
    p = clock_drift.probability(free[at], P[at, at])
    mean = free - (1 - p) * free[at] * P[:, at] / P[at, at]
    covariance = P - (1 - p) * (1 - p * free[at] ** 2 / P[at, at]) * np.outer(P[:, at], P[:, at]) / P[at, at]
    reported = held - (1 - p) * held[at] * given[:, at] / given[at, at]
    expected = covariance + np.outer(mean - reported, mean - reported)
    rows = problem.layout.cameras[NAME].position
    np.testing.assert_allclose(shown.state.cameras[NAME].p_imu_cam, reported[rows], atol=1e-6)
    np.testing.assert_allclose((shown.S @ shown.S.T)[rows, rows], expected[rows, rows], rtol=1e-3)


def test_what_is_said_of_the_clocks_does_not_move_a_lens_that_is_held():
    shown = clock_drift.averaged(model_selection.averaged(Linear(off=1.0).filter()))
    values = np.concatenate([shown.state.cameras[NAME].intrinsics, shown.state.cameras[NAME].distortion])
    np.testing.assert_allclose(values, Linear(off=1.0).lens.values, rtol=1e-6, atol=1e-9)


@pytest.fixture(scope="module")
def run():
    return simulate(5, 16.0, rig=reference_rig(5, timeshift_cam_imu_s=0.02))


def test_a_wrong_fixed_lens_is_announced_and_nothing_beyond_its_sigmas_is_said(run):
    right = prior(run)[NAME]
    fx, fy, cx, cy = right.intrinsics
    wrong = replace(right, intrinsics=(1.005 * fx, 1.005 * fy, cx + 5.0, cy - 4.0))
    far, events = [], []

    def each(c):
        estimate = c.estimate()
        events.extend(estimate.events)
        if estimate.cameras:
            x, sigma = errors(estimate, run)
            far.append((estimate.status, float(np.abs(x / sigma).max())))

    c = calibrate(run, HELD, {NAME: wrong}, each=each)
    assert [e.kind for e in events] == [EventKind.FIXED_LENS]
    assert events[0].value == pytest.approx(6.6, abs=3.0 * events[0].sigma)  # RMS over the image
    assert events[0].sigma < 3.0
    assert max(z for _, z in far) < 5.0
    estimate = c.estimate()
    camera = estimate.cameras[NAME]
    assert camera.intrinsics == list(wrong.intrinsics)
    assert camera.intrinsics_sigma[2] == pytest.approx(5.0, rel=0.2)
    assert estimate.status is Status.CONVERGING
    assert "the fixed lens of cam0 is not this camera's: estimate it" in estimate.reason


def test_a_fixed_lens_that_is_zoomed_is_no_bump():
    """Only other causes were tested: the lever arm ended 42 sigma off, `converged`, announced as a bump."""
    true = simulate(9001, 19.0, rig=reference_rig(9001, timeshift_cam_imu_s=0.02))
    middle, far, events = np.array(true.rig.lens.intrinsics[2:]), [], []
    zoomed = [
        f if f.t_s < 14.0 else replace(f, uv_px=middle + 1.02 * (f.uv_px - middle)) for f in true.frames
    ]

    def each(c):
        estimate = c.estimate()
        events.extend(e.kind for e in estimate.events)
        if estimate.cameras and c.filter.state.t_s > 17.0:
            x, sigma = errors(estimate, true)
            far.append(float(np.abs(x / sigma).max()))

    calibrate(replace(true, frames=zoomed), HELD, each=each)
    assert EventKind.FIXED_LENS in events
    assert not {EventKind.BUMPED, EventKind.NOT_BUMPED, EventKind.STARTED_ANEW} & set(events)
    assert max(far) < 4.0


def test_a_lens_that_may_have_jumped_is_as_likely_another_as_the_same():
    """What images have said of the distortion, which has not jumped, says nothing about the focal length."""
    lens = Linear(off=0.0).lens
    sigma = np.array([9.0, 9.0, 5.0, 5.0, 1e-3, 1e-3, 1e-4, 1e-4])
    S = sigma[:, None] * np.tril(np.full((8, 8), 0.9))  # correlated, as values of a lens are
    block = model_mixture.Block.of_lens(slice(0, 8), lens.may_have_jumped(S @ S.T), lens.values)
    for size, most, least in ((1.0, 0.5, 0.5), (0.03, 1e-4, 0.0)):  # nothing known yet; known to be as given
        p = model_mixture.hypotheses(S * np.repeat([size, 1.0], 4), {"lens": block}, 1.0)
        assert least - 1e-6 <= model_mixture.not_zero(p, "lens") <= most + 1e-6


def test_a_right_fixed_lens_is_not_doubted(run):
    c = calibrate(run, HELD)
    estimate = c.estimate()
    assert estimate.status is Status.CONVERGED
    assert estimate.events == []
    assert estimate.cameras[NAME].intrinsics_sigma == [0.0] * 4
    assert estimate.cameras[NAME].distortion_sigma == [0.0] * 4


def test_a_right_fixed_lens_and_an_accelerometer_whose_axes_are_apart():
    """Positions of the axes were states with a free lens only: 7 sigma off, `converged`."""
    rng = np.random.default_rng(35)
    apart_m = rng.normal(0.0, 4e-3, (3, 3))
    rig = reference_rig(35, timeshift_cam_imu_s=0.02, accel_positions=apart_m - apart_m.mean(axis=0))
    true = simulate(35, 20.0, rig=rig, camera_rate_hz=15.0, corner_sigma_px=0.3)
    far, events = [], []

    def each(c):
        estimate = c.estimate()
        events.extend(e.kind for e in estimate.events)
        if estimate.cameras:
            x, sigma = errors(estimate, true)
            far.append(float(np.abs(x / sigma).max()))

    c = calibrate(true, HELD, each=each)
    assert c.estimate().status is Status.CONVERGED
    assert events == [EventKind.ACCEL_POSITIONS]
    assert max(far) < 5.0
    assert far[-1] < 4.0


def test_where_nothing_is_estimated_that_a_lens_could_harm_it_is_no_state(run):
    fixed = CalibrationOptions(fix=frozenset({"intrinsics", "extrinsics", "timeshift"}))
    assert calibrate(run, fixed).rig.layout.cameras[NAME].intrinsics is None
