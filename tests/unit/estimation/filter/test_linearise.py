"""Derivatives of the two models: against differences of the models themselves, and against sigma points."""

from dataclasses import replace

import numpy as np
import pytest

from vical_daemon.estimation.filter.linearise import (
    Image,
    LinearityMonitor,
    bend_by_jitter,
    by_derivatives,
    by_sigma_points,
    move_rows_by_noise,
    project_errors,
    rows_by_noise,
    view_derivatives,
)
from vical_daemon.estimation.filter.propagate import move_by_derivatives, move_by_sigma_points
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.model.rates import Rates
from vical_daemon.estimation.model.state import CameraState, State, make_layout
from vical_daemon.estimation.model.target_modes import MODES

BOARD = np.stack([*np.meshgrid(np.arange(5) * 0.05, np.arange(4) * 0.05), np.zeros((4, 5))], axis=-1)


def scene(model: str, estimate=frozenset({"target_scale", "target_shape"})):
    """A camera half a metre in front of a board, in motion, with everything estimated."""
    camera = CameraState(
        so3.exp(np.array([0.3, -0.2, 0.9])),
        np.array([0.03, -0.05, 0.02]),
        0.004,
        np.array([460.0, 455.0, 325.0, 238.0]),
        np.array([-0.28, 0.07, 2e-4, -3e-4, -0.03])[: len(COEFFICIENTS[model])],
        model,
        (640, 480),
    )
    R = so3.exp(np.array([0.1, 3.0, 0.2])) @ camera.R_imu_cam.T
    state = State(
        1.0,
        R,
        np.array([0.1, 0.1, 0.5]) - R @ camera.p_imu_cam,
        np.array([0.4, -0.3, 0.2]),
        np.array([0.01, -0.02, 0.005]),
        np.array([0.05, 0.02, -0.1]),
        np.array([1.0, 9.0, -3.7]),
        {"cam0": camera},
        target_scale=1.01,
        target_shape=1e-3 * np.random.default_rng(6).standard_normal(MODES),
    )
    layout = make_layout({"cam0": model}, fix=frozenset(), estimate=estimate, target_m=BOARD.reshape(-1, 3))
    rates = Rates(np.array([0.7, -1.1, 0.5]), np.array([1.0, 2.0, -1.5]))
    points = BOARD.reshape(-1, 3).copy()
    uv = np.zeros((len(points), 2))
    # the state does not stand at the image's instant: what a late image and a moving shift look like
    image = Image(
        "cam0",
        0,
        0.999,
        np.arange(len(points)),
        points,
        uv,
        np.full(len(points), 0.3),
    )
    return state, layout, rates, image


@pytest.mark.parametrize("model", ["radtan", "plumb_bob", "equidistant"])
def test_derivatives_of_the_view_are_those_of_the_projection(model):
    state, layout, rates, image = scene(model)
    uv, ways, by_error = view_derivatives(state, layout, rates, image)
    H = ways @ by_error
    assert ways.shape == (2 * len(image.points), 6 + 4 + len(COEFFICIENTS[model]) + 1 + MODES)
    steps = 1e-6 * np.eye(layout.size)
    arguments = (state, layout, rates, "cam0", image.t_cam_s, image.points, None)
    differences = (project_errors(*arguments, steps) - project_errors(*arguments, -steps)) / 2e-6
    np.testing.assert_allclose(uv, project_errors(*arguments, np.zeros((1, layout.size)))[0], atol=1e-9)
    expected = np.moveaxis(differences, 0, -1).reshape(H.shape)
    np.testing.assert_allclose(H, expected, rtol=1e-5, atol=2e-3)
    by_shift = H[:, layout.cameras["cam0"].timeshift].reshape(-1, 2)
    assert np.abs(by_shift).min(axis=0).max() > 1.0  # it does depend on all


def test_both_ways_to_linearise_agree_when_the_spread_is_small():
    state, layout, rates, image = scene("radtan")
    S = np.diag(np.full(layout.size, 1e-5))
    points = by_sigma_points(state, layout, rates, image, np.zeros(layout.size), S)
    straight = by_derivatives(state, layout, rates, image, S)
    np.testing.assert_allclose(
        straight.ways @ straight.spread, points.ways @ points.spread, rtol=1e-4, atol=1e-7
    )
    np.testing.assert_allclose(straight.z, points.z, atol=1e-4)
    assert straight.curved.shape == (2 * len(image.points), 0)


def test_stamps_that_jitter_move_the_mean_of_the_pixels():
    """Against the mean over stamps, of a motion that is integrated in small steps."""
    state, layout, _, image = scene("radtan")
    rates = Rates(np.array([3.0, -4.0, 2.0]), np.array([20.0, 10.0, -15.0]), np.array([30.0, 20.0, -40.0]))
    cam, jitter_s = state.cameras["cam0"], 4e-3

    def pixels(late_s):
        step = (image.t_cam_s + cam.timeshift_s + late_s - state.t_s) / 400
        R = state.R_world_imu
        for k in range(400):
            R = R @ so3.exp(step * (rates.omega + (k + 0.5) * step * rates.alpha))
        ahead_s = 400 * step
        p = state.p_world_imu + ahead_s * state.v_world_imu + 0.5 * ahead_s**2 * rates.accel
        moved = replace(state, t_s=state.t_s + ahead_s, R_world_imu=R, p_world_imu=p)
        moved.cameras["cam0"] = replace(cam, timeshift_s=moved.t_s - image.t_cam_s)
        arguments = (moved, layout, rates, "cam0", image.t_cam_s, image.points, None)
        return project_errors(*arguments, np.zeros((1, layout.size)))[0]

    now, (nodes, weights) = pixels(0.0), np.polynomial.hermite_e.hermegauss(5)
    mean = sum(w * pixels(jitter_s * x) for x, w in zip(nodes, weights, strict=True)) / weights.sum()
    state.cameras["cam0"] = cam
    lin = by_derivatives(state, layout, rates, image, np.eye(layout.size))
    lin.shared, lin.by_shared = lin.shared.copy(), np.zeros((len(lin.by_error), 3))
    before = replace(lin)
    bend_by_jitter(lin, state, layout, rates, image, jitter_s)
    bent = lin.z - before.z
    assert np.abs(bent).max() > 0.1
    np.testing.assert_allclose(bent, mean - now, atol=0.02 * np.abs(bent).max())
    # what is left of an image k jitters late: bent (k^2 - 1), of variance 2 bent^2
    np.testing.assert_allclose((lin.ways @ lin.shared).ravel() ** 2, 2.0 * bent.ravel() ** 2)
    np.testing.assert_array_equal(lin.ways @ lin.spread, before.ways @ before.spread)
    same = replace(before)
    bend_by_jitter(same, state, layout, rates, image, 1e-4)
    assert same.z is before.z


def test_rows_of_a_rolling_shutter_put_no_noise_of_the_corners_into_derivatives():
    """An image of which only the noise differs has the same derivatives: noise is no information."""
    state, layout, rates, image = scene("radtan")
    state.cameras["cam0"].readout_s = 0.02
    nominal, S = np.zeros(layout.size), np.diag(np.full(layout.size, 1e-3))
    seen = project_errors(state, layout, rates, "cam0", image.t_cam_s, image.points, None, nominal[None])[0]
    noise = np.random.default_rng(3).standard_normal(seen.shape)
    clean, noisy = (
        by_sigma_points(state, layout, rates, replace(image, uv=uv), nominal, S)
        for uv in (seen, seen + noise)
    )
    np.testing.assert_array_equal(noisy.ways, clean.ways)
    np.testing.assert_array_equal(noisy.curved, clean.curved)
    # the innovation is the noise, but for what a corner moves until the row in which it seems to be
    np.testing.assert_allclose(seen - clean.z, 0.0, atol=0.05)
    np.testing.assert_allclose(seen + noise - noisy.z, noise, atol=0.15)
    assert np.abs(noisy.z - clean.z).max() > 0.01


def test_points_behind_the_camera_are_invalid_either_way():
    state, layout, rates, image = scene("radtan")
    image.points[3] = state.p_world_imu - 2.0 * (image.points[3] - state.p_world_imu)
    S = np.diag(np.full(layout.size, 1e-5))
    points = by_sigma_points(state, layout, rates, image, np.zeros(layout.size), S)
    straight = by_derivatives(state, layout, rates, image, S)
    np.testing.assert_array_equal(straight.valid, points.valid)
    assert not straight.valid[3]
    assert np.isfinite(straight.ways @ straight.spread).all()


def test_points_beside_the_camera_are_invalid_either_way():
    """Their pixels are as uncertain as they are far out: one passed its gate, the time shift was a day."""
    state, layout, rates, image = scene("radtan")
    start, along = image.points[0].copy(), np.linspace(0.0, 1.5, len(image.points))[:, None]
    image.points[:] = start + along * (state.p_world_imu - start)
    image.points[:, 0] += 0.3 * along[:, 0]
    S = np.diag(np.full(layout.size, 1e-5))
    uv = view_derivatives(state, layout, rates, image)[0]
    beside = np.isfinite(uv).all(axis=1) & (np.abs(uv) > 1e5).any(axis=1)
    assert beside.any()
    points = by_sigma_points(state, layout, rates, image, np.zeros(layout.size), S)
    straight = by_derivatives(state, layout, rates, image, S)
    np.testing.assert_array_equal(straight.valid, points.valid)
    assert straight.valid.any() and not straight.valid[beside].any()
    assert np.abs(straight.z).max() < 1e5


@pytest.mark.parametrize("estimate", [frozenset(), frozenset({"imu_intrinsics"})])
def test_derivatives_of_the_motion_agree_with_sigma_points(estimate):
    state, layout, _, _ = scene("radtan", estimate=estimate)
    if estimate:
        rng = np.random.default_rng(8)
        state.gyro_matrix = np.eye(3) + 0.01 * rng.standard_normal((3, 3))
        state.accel_matrix = np.eye(3) + np.tril(0.01 * rng.standard_normal((3, 3)))
    buffer = ImuBuffer(0)
    t = np.arange(0.9, 1.3, 0.005)
    for now in t:
        w = np.array([np.sin(9 * now), 1.2 * np.cos(7 * now), 0.4])
        buffer.append(float(now), w, np.array([2 * np.sin(8 * now), -9.0, 3.7 + np.cos(5 * now)]))
    segment = buffer.segment(1.0, 1.0987)
    d = layout.dynamic
    S = np.triu(np.random.default_rng(4).normal(size=(d, d))) * 1e-5
    points = move_by_sigma_points(state, layout, S, segment)
    straight = move_by_derivatives(state, layout, S, segment)
    # trapezoids over the nodes for the derivatives by the biases: a thousandth
    np.testing.assert_allclose(straight.linear, points.linear, atol=2e-3 * np.abs(points.linear).max())
    for name in ("R", "p", "v"):
        np.testing.assert_allclose(getattr(straight, name), getattr(points, name), atol=1e-8)


def test_straightness_is_measured_again_when_a_sigma_grows_or_time_passes():
    s = LinearityMonitor()
    sigmas = np.array([1.0, 2.0])
    assert not s.holds(sigmas)
    s.measured(sigmas, 0.001)
    assert s.holds(1.4 * sigmas)
    assert not s.holds(1.6 * sigmas)
    assert sum(s.holds(sigmas) for _ in range(200)) < 100
    s.measured(sigmas, 0.5)
    assert not s.holds(sigmas)


def test_rows_of_a_rolling_shutter_are_turned_by_the_noise_of_the_gyro():
    """Against random walks of the attitude from the middle row to the first and the last."""
    density, readout_s, draws = 5e-3, 0.02, 4000
    state, layout, rates, image = scene("radtan", frozenset({"readout"}))
    camera = replace(state.cameras["cam0"], readout_s=readout_s)
    state = replace(state, cameras={"cam0": camera})
    rolling = (state, layout, rates._replace(omega=np.zeros(3), accel=np.zeros(3)))
    uv = np.array([[100.0, 0.0], [100.0, 480.0]])
    # at the instant of the state
    ends = replace(image, t_cam_s=0.996, ids=image.ids[:2], points=image.points[[0, 0]], uv=uv)
    ends = replace(ends, sigma_px=image.sigma_px[:2])
    ways = rows_by_noise(*rolling, ends, density)
    turns = density * np.sqrt(readout_s / 2.0) * np.random.default_rng(5).standard_normal((2, draws, 3))
    errors, walked, middle = np.zeros((draws, layout.size)), [], np.full((2, 2), 240.0)
    for turn in turns:
        errors[:, :3] = turn
        walked.append(project_errors(*rolling, "cam0", 0.996, ends.points, middle, errors)[:, 0])
    expected = np.cov(np.concatenate(walked, axis=1).T)
    np.testing.assert_allclose(ways @ ways.T, expected, rtol=0.1, atol=0.02 * np.trace(expected))
    lin = by_sigma_points(*rolling, ends, np.zeros(layout.size), np.diag(np.full(layout.size, 1e-5)))
    more = replace(lin)
    move_rows_by_noise(more, *rolling, ends, density)
    before, after = (x.ways @ x.moves for x in (lin, more))
    np.testing.assert_allclose(after @ after.T - before @ before.T, ways @ ways.T, atol=1e-9)
    global_shutter = replace(state, cameras={"cam0": replace(camera, readout_s=0.0)})
    assert rows_by_noise(global_shutter, layout, rates, ends, density).shape == (4, 0)
