"""Pieces of the target-free calibration, each against something that does not share its code."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.rig import STANDARD_GRAVITY_MPS2, reference_rig
from vical_mocks.tracks import simulate_tracks

from tests.unit.estimation.some_layout import NAME, POSE_AND_CLOCK, window_layout
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.geometry.so3 import tangents
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import COLUMNS, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.model.camera_rays import unproject
from vical_daemon.estimation.model.inertial_links import make_links
from vical_daemon.estimation.model.priors import WINDOW_START
from vical_daemon.estimation.model.retract import camera_difference, moved_camera
from vical_daemon.estimation.model.start_sigmas import start_sigmas
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.smoother.bundle import Bundle, correlation
from vical_daemon.estimation.smoother.inertial import ImageOffsets, Order, moves
from vical_daemon.estimation.smoother.marginal_prior import CORE, first_carry, initial_prior, later
from vical_daemon.estimation.smoother.normal import ImageNoise
from vical_daemon.estimation.smoother.track_start import ArmPrior, TrackStart
from vical_daemon.estimation.temporal.epipolar_fit import epipolar_fit

SHIFT_S = 0.013


def off_truth(carry, scene):
    """Errors of gravity and camera, shape (n,)."""
    error = camera_difference(carry.camera, scene.camera, carry.layout.camera, carry.layout.size)[CORE:]
    error[0] = carry.imu[0] - STANDARD_GRAVITY_MPS2
    return error


def bundle_of(window, layout, sigma_px):
    """A window about which next to nothing is known, to be adjusted."""
    sigmas = start_sigmas(
        layout, {NAME: window.camera}, WINDOW_START, imu_sigma=0.01, gravity_sigma_mps2=0.015
    )
    return Bundle(window, first_carry(window, window.camera, layout, sigmas), ImageNoise(sigma_px))


class Scene:
    """Four seconds of tracks, and the truth in the form of a camera."""

    def __init__(self, seed=3, seconds=4.5):
        rig = reference_rig(seed, timeshift_cam_imu_s=SHIFT_S)
        self.run = simulate_tracks(seed, seconds, rig=rig)
        base = int(self.run.t_imu_ns[0])
        self.buffer = ImuBuffer(base)
        for t, w, f in zip(self.run.t_imu_ns, self.run.gyro_rps, self.run.specific_force_mps2, strict=True):
            self.buffer.append((int(t) - base) * 1e-9, w, f)
        self.frames = [
            ((f.t_cam_ns - base) * 1e-9, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px))
            for f in self.run.frames
        ]
        self.frames = [x for x in self.frames if 0.1 < x[0] < seconds - 0.2]
        lens = rig.lens
        self.camera = CameraState(
            rig.R_imu_cam,
            rig.p_imu_cam,
            SHIFT_S,
            np.array(lens.intrinsics),
            np.array(lens.distortion),
            lens.model,
            lens.resolution,
            0.0,
        )
        d = rig.densities
        self.noise = ImuNoise(d.gyro, d.gyro_walk, d.accel, d.accel_walk)
        self.rig = rig

    def window(self, numbers=0, frames=None):
        start = replace(self.camera, p_imu_cam=np.zeros(3))
        imu = np.concatenate([self.rig.gyro_bias.value(0.0), np.zeros(3 + numbers)])
        linear = TrackStart(self.buffer, frames or self.frames, start, imu, self.noise, 9.80665)
        return linear.window(ArmPrior(np.zeros(3)))


def _link(buffer, from_s, to_s, imu, noise):
    return make_links(buffer, np.array([from_s, to_s]), imu[None], noise)


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.mark.parametrize("numbers", [6, 22, 28])
def test_links_derivatives_agree_with_differences(scene, numbers):
    zero = np.zeros(numbers)
    links = make_links(scene.buffer, np.linspace(0.3, 0.45, 4), np.tile(zero, (3, 1)), scene.noise)
    rng = np.random.default_rng(1)
    R = Rotation.from_rotvec(0.4 * rng.standard_normal((4, 3))).as_matrix()
    p, v = rng.standard_normal((2, 4, 3))
    bias = 0.01 * rng.standard_normal((3, numbers))
    gravity = np.array([0.0, 0.0, -9.8])
    e0, J = links.errors(R, p, v, bias, gravity)
    h = 1e-6
    for k in range(18 + numbers):
        R2, p2, v2, b2 = R.copy(), p.copy(), v.copy(), bias.copy()
        image, axis = (1 if k < 9 else 2), k % 9
        if k >= 18:
            b2[1, k - 18] += h
        elif axis < 3:
            R2[image] = R[image] @ Rotation.from_rotvec(h * np.eye(3)[axis]).as_matrix()
        elif axis < 6:
            p2[image, axis - 3] += h
        else:
            v2[image, axis - 6] += h
        change = (links.errors(R2, p2, v2, b2, gravity)[0][1] - e0[1]) / h
        np.testing.assert_allclose(J[1, :, k], change, rtol=2e-3, atol=1e-3 * np.abs(J[1]).max())


def test_link_carries_the_true_motion(scene):
    biases = np.concatenate([scene.rig.gyro_bias.value(1.2), scene.rig.accel_bias.value(1.2)])
    link = _link(scene.buffer, 1.0, 1.5, biases, scene.noise)
    offset = (scene.run.t_imu_ns[0] - scene.run.options.epoch_ns) * 1e-9
    move, g = scene.rig.trajectory, scene.rig.gravity_world_mps2
    a, b = 1.0 + offset, 1.5 + offset
    R = move.R_world_imu(a).T @ move.R_world_imu(b)
    dv = move.R_world_imu(a).T @ (move.v_world_imu(b) - move.v_world_imu(a) - 0.5 * g)
    e = np.concatenate([Rotation.from_matrix(link.dR[0].T @ R).as_rotvec(), dv - link.dv[0]])
    assert np.abs(link.root[0, :6, :6] @ e).max() < 4.5


def test_a_link_is_not_made_over_a_hole_in_the_readings():
    buffer = ImuBuffer(0)
    for t in (0.0, 0.01, 0.02, 0.2, 0.21):
        buffer.append(t, np.zeros(3), np.zeros(3))
    assert _link(buffer, 0.0, 0.02, np.zeros(6), ImuNoise()) is not None
    assert _link(buffer, 0.01, 0.205, np.zeros(6), ImuNoise()) is None
    assert _link(buffer, 0.0, 0.3, np.zeros(6), ImuNoise()) is None


def test_epipolar_fit_finds_mounting_delay_and_bias_without_knowing_any(scene):
    rows = scene.buffer.rows
    start = scene.camera.R_imu_cam @ Rotation.from_rotvec([0.15, -0.1, 0.2]).as_matrix()
    lens = (scene.camera.intrinsics * [1.03, 1.03, 1.0, 1.0], np.zeros(4), "radtan")
    fit = epipolar_fit(rows[:, 0], rows[:, 1:4], scene.frames, lens, start, -0.02, fit_lens=True)
    off = Rotation.from_matrix(scene.camera.R_imu_cam.T @ fit.R_imu_cam).as_rotvec()
    assert np.all(np.abs(off) < np.maximum(4.5 * np.sqrt(np.diag(fit.rotation_covariance)), 2e-3))
    assert abs(fit.timeshift_s - SHIFT_S) < max(4.5 * fit.timeshift_sigma_s, 3e-4)
    np.testing.assert_allclose(fit.gyro_bias, scene.rig.gyro_bias.value(2.0), atol=3e-3)
    assert fit.intrinsics[0] == pytest.approx(scene.camera.intrinsics[0], rel=0.015)
    assert fit.inliers > 0.9


@pytest.mark.parametrize("seed", [3, 5, 7])
def test_a_rolling_shutter_does_not_take_the_start_far_from_the_lens_that_is_given(seed):
    """Pairs share sightings, and errors of a shutter last: as independent ones they outvote the prior."""
    rig = reference_rig(seed, timeshift_cam_imu_s=SHIFT_S, readout_s=0.03, readout_axis=COLUMNS)
    run = simulate_tracks(seed, 6.0, rig=rig, camera_rate_hz=10.0)
    t = (run.t_imu_ns - run.t_imu_ns[0]) * 1e-9
    frames = [((f.t_cam_ns - int(run.t_imu_ns[0])) * 1e-9, f) for f in run.frames]
    frames = [(s, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px)) for s, f in frames if 0.1 < s < 5.8]
    lens = (np.array(rig.lens.intrinsics) * [1.03, 1.03, 1.0, 1.0], np.zeros(4), "radtan")
    fit = epipolar_fit(t, run.gyro_rps, frames, lens, rig.R_imu_cam, 0.01, fit_lens=True)
    off = np.abs(fit.intrinsics / np.array(rig.lens.intrinsics) - 1.0)
    turn = Rotation.from_matrix(rig.R_imu_cam.T @ fit.R_imu_cam).magnitude()
    assert off.max() < 0.05
    assert np.rad2deg(turn) < 1.5  # 3.1 and 2.0 deg when they did, for the first two


@pytest.mark.parametrize("given", [(400.0, 401.0, 320.0, 240.0), None])
def test_the_first_prior_is_about_what_was_given_and_not_about_what_the_same_data_gave(scene, given):
    window = scene.window()
    found = window.camera.intrinsics * 1.5
    window.camera = replace(window.camera, intrinsics=found, p_imu_cam=np.array([0.9, -1.0, 0.4]))
    layout = window_layout()
    carry = initial_prior(window, None, layout, None, 2e-3, 0.015, CameraPrior((640, 480), given))
    np.testing.assert_array_equal(carry.camera.p_imu_cam, np.zeros(3))
    middle = [319.5, 239.5]  # of the picture
    np.testing.assert_allclose(carry.camera.intrinsics, given or [*found[:2], *middle])
    np.testing.assert_array_equal(carry.camera.R_imu_cam, window.camera.R_imu_cam)
    assert carry.sigma(layout.camera.intrinsics.start) == pytest.approx(0.05 * carry.camera.intrinsics[0])


@pytest.mark.parametrize("seed", [0, 4, 9])
def test_features_that_fit_no_motion_give_no_lens_without_an_image(seed):
    """Points that jump about: the lens ran away until no pixel had a ray, and a matrix was singular."""
    rng = np.random.default_rng(seed)
    t = np.arange(-0.5, 4.5, 0.01)
    gyro = 0.3 * np.stack([np.sin(2.0 * t), np.cos(3.0 * t), np.sin(5.0 * t + 1.0)], axis=1)
    uv = rng.uniform([0.0, 0.0], [320.0, 240.0], (40, 2)) + np.cumsum(rng.normal(0, 8, (40, 40, 2)), axis=0)
    frames = [(0.1 * k, PointsFrame("cam0", k * 10**8, np.arange(40), uv[k])) for k in range(40)]
    lens = (np.array([216.0, 215.0, 158.0, 116.0]), np.array([-0.14, 0.07, 0.0, 0.0]), "radtan")
    fit = epipolar_fit(t, gyro, frames, lens, np.eye(3), 0.0, fit_lens=True)
    edges = np.array([[0.0, 0.0], [320.0, 0.0], [0.0, 240.0], [320.0, 240.0]])
    assert fit is None or unproject(edges, fit.intrinsics, fit.distortion, "radtan")[1].all()


def test_start_finds_lever_arm_and_speed_linearly(scene):
    window = scene.window()
    assert np.linalg.norm(window.camera.p_imu_cam - scene.camera.p_imu_cam) < 0.03
    offset = (scene.run.t_imu_ns[0] - scene.run.options.epoch_ns) * 1e-9
    t = np.array([s for s, _ in window.frames]) + SHIFT_S + offset
    speed = np.linalg.norm(scene.rig.trajectory.v_world_imu(t), axis=1)
    assert np.abs(np.linalg.norm(window.v, axis=1) - speed).max() < 0.1


@pytest.mark.parametrize("positions", [0, 6])
def test_links_follow_the_matrices_as_integrating_anew_does(scene, positions):
    """What a link says of other biases, matrices, positions and lags, against one integrated for them."""
    rng = np.random.default_rng(3)
    at = np.concatenate([[0.01, -0.02, 0.01], [0.1, 0.0, -0.1], 0.02 * rng.standard_normal(15), [2e-4]])
    at = np.insert(at, 21, 2e-3 * rng.standard_normal(positions))
    link = _link(scene.buffer, 1.0, 1.25, at, scene.noise)
    for k in range(len(at)):
        step = np.zeros(len(at))
        step[k] = 1e-4
        up, down = (_link(scene.buffer, 1.0, 1.25, at + s * step, scene.noise) for s in (1.0, -1.0))
        turn = Rotation.from_matrix(down.dR[0].T @ up.dR[0]).as_rotvec()
        change = np.concatenate([turn, (up.dv - down.dv)[0], (up.dp - down.dp)[0]]) / 2e-4
        by_imu = link.by_imu[0]
        scale = np.repeat(np.abs(by_imu).max(axis=1).reshape(3, 3).max(axis=1), 3)
        np.testing.assert_allclose(by_imu[:, k] / scale, change / scale, atol=6e-3)


@pytest.mark.parametrize(("readout_s", "model"), [(0.0, "radtan"), (0.02, "radtan"), (0.02, "plumb_bob")])
def test_bundle_gradient_agrees_with_differences_of_the_cost(scene, readout_s, model):
    window = scene.window(numbers=16)
    coefficients = len(COEFFICIENTS[model])
    distortion = np.resize([*window.camera.distortion, 0.01], coefficients)
    window.camera = replace(window.camera, readout_s=readout_s, distortion=distortion, distortion_model=model)
    window.own_lens = 1e-6 * np.ones(4 + coefficients)
    layout = window_layout(model)
    problem = bundle_of(window, layout, 50.0).problem
    seen = window.observe()
    normal, order = problem.normal(problem.view(seen)), problem.order()
    rng = np.random.default_rng(2)
    of_lens = np.array([0.01] * 4 + [1e-5] * coefficients)
    scales = np.array([1e-5] + [1e-6] * 15 + [1e-5] + [1e-4] * 6 + [1e-5] * 2 + [*of_lens, 1e-5])
    for k, at in enumerate(order.constants):
        step = np.zeros(layout.size)
        size = step[CORE + k] = scales[k] * rng.choice([-1.0, 1.0])
        camera, imu, costs = window.camera, window.imu, []
        for d in (step, -step):
            window.camera, window.imu = moved_camera(camera, layout.camera, d), imu + d[layout.inertial]
            costs.append(problem.normal(problem.view(seen)).cost)
        window.camera, window.imu = camera, imu
        up, down = costs
        slope = (up - down) / 2.0 / size / 2.0
        assert slope == pytest.approx(normal.g[at], rel=0.02, abs=0.02 * np.sqrt(normal.H[at, at])), k
    own = window.own_lens
    for k, size in enumerate(of_lens):
        step, costs = size * np.eye(len(own))[k], []
        for d in (step, -step):
            window.own_lens = own + d
            costs.append(problem.normal(problem.view(seen)).cost)
        slope, at = (costs[0] - costs[1]) / 4.0 / size, order.own[k]
        assert slope == pytest.approx(normal.g[at], rel=0.02, abs=0.02 * np.sqrt(normal.H[at, at])), k


def test_a_step_is_the_best_within_the_bounds_of_the_distances(scene):
    """Against the quadratic model itself: no gradient where it is free, and few held for nothing."""
    window = scene.window(numbers=16)
    bundle = bundle_of(window, window_layout("radtan"), 0.3)
    seen = window.observe()
    window.landmarks.inverse[::3] = 0.01  # 100 m, of a room of 6 m
    normal, order = bundle.problem.normal(bundle.problem.view(seen)), bundle.problem.order()
    step = bundle._step(normal, 0.0, settle=True)
    n, marks = len(normal.g), len(normal.gl)
    pixels = np.concatenate([order.frames[:, :6].ravel(), order.camera])
    M = np.zeros((n + 3 * marks, n + 3 * marks))
    M[:n, :n] = np.triu(normal.H) + np.triu(normal.H, 1).T
    for k in range(marks):
        at = slice(n + 3 * k, n + 3 * k + 3)
        M[at, at], M[at, pixels], M[pixels, at] = normal.V[k], normal.W[k], normal.W[k].T
    x = np.concatenate([step.states, step.landmarks.ravel()])
    gradient = np.concatenate([normal.g, normal.gl.ravel()]) + M @ x
    before = window.landmarks.inverse
    low, high = 0.2 * before, 5.0 * before + 0.01
    after = before + step.landmarks[:, 2]
    held = np.isclose(after, low) | np.isclose(after, high)
    assert 3 <= held.sum() < marks / 2
    assert (after >= low - 1e-12).all() and (after <= high + 1e-12).all()
    free = np.ones(n + 3 * marks, bool)
    free[n + 2 :: 3] = ~held
    scale = np.sqrt(np.diag(M))
    assert np.abs(gradient / scale)[free].max() < 1e-4 * np.abs(normal.gl[:, 2] / scale[n + 2 :: 3]).max()
    inward = np.where(after < before, gradient[n + 2 :: 3], -gradient[n + 2 :: 3])[held]
    assert (inward > 0.0).mean() > 0.8  # some of the first ones would come back
    lower = -(2.0 * np.concatenate([normal.g, normal.gl.ravel()]) @ x + x @ M @ x)
    assert step.predicted_reduction == pytest.approx(lower, rel=1e-6)


def test_accelerations_at_images_are_those_of_the_motion_however_far_images_are_apart(scene):
    window = scene.window(frames=scene.frames[::5])
    t_s = np.array([t for t, _ in window.frames]) + SHIFT_S
    force = np.matvec(np.swapaxes(window.R, 1, 2), window.accelerations()[1] - window.gravity)
    true = scene.rig.imu_motion(t_s)[1] + scene.rig.accel_bias.value(0.0)
    np.testing.assert_allclose(force, true, atol=0.08)  # noise; differences of velocities: 1.3


def errors_where_images_are_off(window, offsets):
    """Errors of the links if image k was taken offsets[k, 0] s late, and lies offsets[k, 1:] px off."""
    rates, push = window.rates(), window.accelerations()[1]
    late, (right, down), camera = offsets[:, :1], offsets[:, 1:].T, window.camera
    # a camera that turns about its x axis sees everything lower, about its y axis more to the left
    turn = np.column_stack([down / camera.intrinsics[1], -right / camera.intrinsics[0], 0.0 * down])
    R = window.R @ so3.exp(-late * rates - turn @ camera.R_imu_cam.T)
    p, v = window.p - late * window.v, window.v - late * push
    return window.links.errors(R, p, v, window.bias[window.knots()], window.gravity)[0]


@pytest.mark.parametrize("sigmas", [[5e-4, 0.0, 0.0], [0.0, 0.3, 0.3], [5e-4, 0.3, 0.3]])
def test_images_that_are_off_are_eliminated_as_unknowns_of_their_own(scene, sigmas):
    window, sigmas = scene.window(), np.array(sigmas)
    ways, knots = np.flatnonzero(sigmas), window.knots()
    e, J = window.links.errors(window.R, window.p, window.v, window.bias[knots], window.gravity)
    order = Order(len(window.frames), len(window.bias), 0)
    at = np.concatenate([order.frames[:-1], order.frames[1:], order.knots[knots]], axis=1)
    F, n, step = len(window.frames), len(ways), np.array([1e-5, 1e-3, 1e-3])
    B = np.zeros((e.size, F, n))
    for k in range(F):
        for column, way in enumerate(ways):
            alone = np.zeros((F, 3))
            alone[k, way] = step[way]
            B[:, k, column] = (errors_where_images_are_off(window, alone) - e).ravel() / step[way]
    B = B.reshape(e.size, F * n)
    off = np.random.default_rng(4).normal(0.0, 1.0, (F, 3)) * step * (sigmas > 0.0)
    together = (errors_where_images_are_off(window, off) - e).ravel()
    np.testing.assert_allclose(B @ off[:, ways].ravel(), together, atol=2e-3 * np.abs(together).max())
    wide = np.zeros((e.size, order.size))
    for k in range(F - 1):
        wide[9 * k : 9 * k + 9, at[k]] += J[k]
    gain = np.linalg.solve(B.T @ B + np.diag(np.tile(sigmas[ways] ** -2.0, F)), B.T)
    H, g = wide.T @ wide, wide.T @ e.ravel()
    wanted_H, wanted_g = H - wide.T @ B @ gain @ wide, g - wide.T @ B @ gain @ e.ravel()
    window.moves = moves(window)
    offsets = ImageOffsets(window, e, J, sigmas)
    offsets.eliminate(H, g, J, at)
    np.testing.assert_allclose(H, wanted_H, atol=1e-4 * np.abs(wanted_H).max())
    np.testing.assert_allclose(g, wanted_g, atol=1e-4 * np.abs(wanted_g).max())
    assert offsets.explained() == pytest.approx(e.ravel() @ B @ gain @ e.ravel(), rel=1e-3)
    wanted = (-gain @ e.ravel()).reshape(F, n)
    np.testing.assert_allclose(offsets.likely()[0], wanted, atol=3e-3 * np.abs(wanted).max())
    left = (e.ravel() + B @ wanted.ravel()).reshape(e.shape)
    np.testing.assert_allclose(offsets.left(e), left, atol=3e-3 * np.abs(left).max())


@pytest.mark.parametrize("case", ["step", "jitter"])
def test_images_that_are_late_alike_are_no_jitter(scene, case):
    window = scene.window()
    count, knots = len(window.frames), window.knots()
    off = np.zeros((count, 3))
    off[:, 0] = 1e-3 * np.random.default_rng(8).standard_normal(count)
    if case == "step":
        off[:, 0] = np.where(np.arange(count) < count // 2, -1e-3, 1e-3)
    right, J = window.links.errors(window.R, window.p, window.v, window.bias[knots], window.gravity)
    e = errors_where_images_are_off(window, off) - right
    window.moves = moves(window)
    alike = ImageOffsets(window, e, J, np.array([1e-3, 0.0, 0.0])).alike()
    assert alike > 0.8 if case == "step" else abs(alike) < 0.4


@pytest.mark.parametrize("off", ["late", "shifted", "both", "neither"])
def test_a_window_tells_late_images_from_shifted_ones(scene, off):
    """Neither is taken for the other, although 1 ms moves these images by about as much."""
    rng = np.random.default_rng(11)
    jitter_s = 1e-3 if off in ("late", "both") else 0.0
    shift_px = 0.4 if off in ("shifted", "both") else 0.0
    frames = [
        (
            t_s + jitter_s * rng.standard_normal(),
            replace(frame, uv_px=frame.uv_px + shift_px * rng.standard_normal(2)),
        )
        for t_s, frame in scene.frames
    ]
    layout = POSE_AND_CLOCK
    fit = bundle_of(scene.window(frames=frames), layout, 1.0).solve(scene.buffer, 25)
    assert fit.noise.jitter_s == pytest.approx(jitter_s, rel=0.35, abs=1e-4)
    assert fit.noise.shift_px == pytest.approx(shift_px, rel=0.35, abs=0.06)
    error = off_truth(fit.carry, scene)
    P = fit.carry.covariance()[CORE:, CORE:]
    assert error @ np.linalg.solve(P, error) < 27.9  # chi-square, 9 degrees of freedom, 99.9 %


def test_at_rest_no_image_can_be_seen_to_be_late(scene):
    window = scene.window()
    problem = bundle_of(window, POSE_AND_CLOCK, 1.0).problem
    window.moves = window.moves * [0.0, 1.0, 1.0]
    assert problem.suspected(problem.view(window.observe())).jitter_s == 0.0


def test_adjusted_window_is_right_within_its_own_sigmas(scene):
    window = scene.window()
    layout = POSE_AND_CLOCK
    fit = bundle_of(window, layout, 1.0).solve(scene.buffer, 25)
    error = off_truth(fit.carry, scene)
    P = fit.carry.covariance()[CORE:, CORE:]
    assert error @ np.linalg.solve(P, error) < 27.9  # chi-square, 9 degrees of freedom, 99.9 %
    assert np.sqrt(np.diag(P))[1:4].max() < 2e-3
    assert fit.noise.sigma_px == pytest.approx(0.5, rel=0.06)
    assert fit.noise.spread < 1.15


def test_many_features_that_move_are_told_before_the_window_is_adjusted_to_the_end(scene):
    """With the noise as measured with them it was adjusted twice, in 10 steps instead of 7."""
    rng, way = np.random.default_rng(4), {}
    frames = []
    for t_s, frame in scene.frames:
        for name in frame.ids.tolist():
            way.setdefault(name, 30.0 * rng.standard_normal(2) * (rng.random() < 0.3))
        shifts = t_s * np.array([way[name] for name in frame.ids.tolist()])
        frames.append((t_s, replace(frame, uv_px=frame.uv_px + shifts)))
    fit = bundle_of(scene.window(frames=frames), POSE_AND_CLOCK, 1.0).solve(scene.buffer, 25)
    assert fit.settled and fit.steps < 9
    assert fit.noise.sigma_px == pytest.approx(0.5, rel=0.1)
    error, P = off_truth(fit.carry, scene), fit.carry.covariance()[CORE:, CORE:]
    assert error @ np.linalg.solve(P, error) < 27.9  # chi-square, 9 degrees of freedom, 99.9 %


def test_a_drift_carries_into_the_time_shift_of_the_next_window(scene):
    window = scene.window()
    fit = bundle_of(window, POSE_AND_CLOCK, 1.0).solve(scene.buffer, 25)
    first, carry = window.camera, fit.carry
    assert carry.camera.timeshift_s == pytest.approx(
        first.timeshift_s + first.skew * window.span_s, abs=1e-12
    )
    at_end, shift, drift = carry.covariance(), carry.layout.camera.timeshift, carry.layout.camera.skew
    back = later(carry.layout, -window.span_s)
    at_first = back @ at_end @ back.T
    # drift and shift: an uncertain slope about the middle of the data
    assert at_end[shift, drift] > 0.0 > at_first[shift, drift]
    assert abs(first.skew) < 4.0 * np.sqrt(at_end[drift, drift])


def test_where_north_and_origin_are_changes_nothing(scene):
    results = []
    for turn in (0.0, 2.0):
        window = scene.window()
        world = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
        window.R, window.v = world @ window.R, window.v @ world.T
        window.p = window.p @ world.T + turn * np.array([3.0, -1.0, 0.5])
        results.append(bundle_of(window, POSE_AND_CLOCK, 0.5).solve(scene.buffer, 25))
    a, b = (np.sqrt(np.diag(r.carry.covariance())) for r in results)
    np.testing.assert_allclose(a, b, rtol=0.02)
    layout = POSE_AND_CLOCK
    change = camera_difference(*(r.carry.camera for r in results), layout.camera, layout.size)[CORE:]
    assert np.abs(change / a[CORE:]).max() < 0.05


def test_errors_that_last_are_counted_once():
    rng = np.random.default_rng(5)
    frames, marks, memory = 60, 40, 0.8
    e = rng.standard_normal((marks, frames, 2))
    for k in range(1, frames):
        e[:, k] = memory * e[:, k - 1] + np.sqrt(1 - memory**2) * e[:, k]

    class Seen:
        landmark = np.repeat(np.arange(marks), frames)
        frame = np.tile(np.arange(frames), marks)

    wanted = (1 + memory) / (1 - memory)
    assert correlation(e.reshape(-1, 2), Seen) == pytest.approx(wanted, rel=0.15)
    white = rng.standard_normal((marks * frames, 2))
    assert correlation(white, Seen) < 1.15


def test_tangents_are_orthonormal_everywhere():
    bearings = np.random.default_rng(7).standard_normal((500, 3))
    bearings = np.vstack([bearings, np.eye(3), -np.eye(3)])
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    frame = np.concatenate([bearings[..., None], tangents(bearings)], axis=2)
    np.testing.assert_allclose(
        np.swapaxes(frame, 1, 2) @ frame, np.broadcast_to(np.eye(3), frame.shape), atol=1e-12
    )
