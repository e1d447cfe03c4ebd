"""The bound against brute force: nonlinear models, finite differences, all states in one dense inverse."""

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.cramer_rao.bound import bounds
from vical_mocks.cramer_rao.error_model import STATE, inertial_factors
from vical_mocks.cramer_rao.information import BoundOptions
from vical_mocks.lens import Lens
from vical_mocks.points import simulate
from vical_mocks.rig import ImuDensities, reference_rig
from vical_mocks.tracks import simulate_tracks
from vical_mocks.trajectory import still

STATE_PRIOR = np.repeat([3.0, 10.0, 10.0, 0.3, 2.0], 3)


def small_run(**options):
    rig = reference_rig(3, lens=Lens(distortion=(-0.1, 0.02, 1e-3, -1e-3)))
    return simulate(3, 0.5, rig=rig, camera_rate_hz=8.0, **options)


def truth(rig, t_s):
    R = Rotation.from_matrix(rig.trajectory.R_world_imu(t_s))
    return R, rig.trajectory.v_world_imu(t_s), rig.trajectory.p_world_imu(t_s)


def moved(rig, start_s, end_s, dx, gravity):
    """Errors of the propagated states when starts are wrong by dx (b, 15), gravity by (b, 3): RK4."""

    steps = 40
    h = (end_s - start_s) / steps
    rates, forces = rig.imu_motion(start_s + np.arange(2 * steps + 1) * h / 2)

    def slope(node, R, v, bias_g, bias_a):
        rate, force = rates[node], forces[node]
        w = rate - bias_g
        W = np.zeros((len(w), 3, 3))
        W[:, 0, 1], W[:, 0, 2], W[:, 1, 2] = -w[:, 2], w[:, 1], -w[:, 0]
        W -= np.swapaxes(W, 1, 2)
        a = np.einsum("bij,bj->bi", R, force - bias_a) + rig.gravity_world_mps2 + gravity
        return R @ W, a, v

    R0, v0, p0 = truth(rig, start_s)
    R = (R0 * Rotation.from_rotvec(dx[:, :3])).as_matrix()
    v, p = v0 + dx[:, 3:6], p0 + dx[:, 6:9]
    bias_g, bias_a = dx[:, 9:12], dx[:, 12:15]
    for i in range(steps):
        k1 = slope(2 * i, R, v, bias_g, bias_a)
        k2 = slope(2 * i + 1, R + h / 2 * k1[0], v + h / 2 * k1[1], bias_g, bias_a)
        k3 = slope(2 * i + 1, R + h / 2 * k2[0], v + h / 2 * k2[1], bias_g, bias_a)
        k4 = slope(2 * i + 2, R + h * k3[0], v + h * k3[1], bias_g, bias_a)
        R, v, p = (
            x + h / 6 * (a + 2 * b + 2 * c + d)
            for x, a, b, c, d in zip((R, v, p), k1, k2, k3, k4, strict=True)
        )
    R1, v1, p1 = truth(rig, end_s)
    turned = (R1.inv() * Rotation.from_matrix(R)).as_rotvec()
    return np.concatenate([turned, v - v1, p - p1, dx[:, 9:]], axis=1)


def pixels(rig, frame, points, dx, c):
    """Pixels when the imu's pose, the extrinsics, the shift and the lens are wrong by dx and c."""
    R, _, p = truth(rig, frame.t_s + c[6])
    R0, _, _p0 = truth(rig, frame.t_s)
    # the shift moves along the true path; the error of the state rides on it
    turn = R0.inv() * R
    R_err = R0 * Rotation.from_rotvec(dx[:3]) * turn
    p_err = p + dx[6:9]
    R_imu_cam = Rotation.from_matrix(rig.R_imu_cam) * Rotation.from_rotvec(c[3:6])
    in_imu = R_err.inv().apply(points - p_err)
    in_cam = R_imu_cam.inv().apply(in_imu - (rig.p_imu_cam + c[:3]))
    lens = replace(
        rig.lens,
        intrinsics=tuple(np.array(rig.lens.intrinsics) + c[10:14]),
        distortion=tuple(np.array(rig.lens.distortion) + c[14:18]),
    )
    return lens.project(in_cam)[0].ravel()


def derivative(function, steps):
    """Central differences of a function of one error vector."""
    return np.stack(
        [(function(d) - function(-d)) / (2 * step) for d, step in zip(np.diag(steps), steps, strict=True)],
        axis=-1,
    )


def propagation(rig, start_s, end_s):
    """Derivatives of the propagated state by the start (15, 15) and by gravity (15, 3)."""
    d = np.vstack([np.diag(np.full(18, 1e-5)), np.diag(np.full(18, -1e-5))])
    end = moved(rig, start_s, end_s, d[:, :15], d[:, 15:])
    J = ((end[:18] - end[18:]) / 2e-5).T
    return J[:, :15], J[:, 15:]


def dense_bound(run, sigma_px):
    """Covariance of the constants p, r, shift, gravity, lens (18) from one big information matrix."""
    rig, frames = run.rig, [f for f in run.frames if f.t_s <= run.duration_s]
    n, size = len(frames), STATE * len(frames) + 18
    information = np.zeros((size, size))
    information[:STATE, :STATE] = np.diag(STATE_PRIOR**-2.0)
    constants = slice(STATE * n, size)
    prior = np.array([1.0] * 3 + [3.0] * 3 + [1.0] + [10.0] * 3 + [100.0] * 4 + [1.0] * 4)
    information[constants, constants] = np.diag(prior**-2.0)
    lens_steps = np.array([1e-6] * 3 + [1e-6] * 3 + [1e-5] + [1.0] * 3 + [1e-2] * 4 + [1e-5] * 4)
    _, _, noise = inertial_factors(rig, np.array([f.t_s for f in frames]))
    for k, frame in enumerate(frames):
        J = np.zeros((2 * len(frame.ids), size))
        points = run.points_m[frame.ids]
        state = slice(STATE * k, STATE * (k + 1))
        see = partial(pixels, rig, frame, points)
        J[:, state] = derivative(lambda d, see=see: see(d, np.zeros(18)), np.full(STATE, 1e-5))
        J[:, constants] = derivative(lambda c, see=see: see(np.zeros(15), c), lens_steps)
        information += J.T @ J / sigma_px**2
        if k + 1 < n:
            J = np.zeros((STATE, size))
            by_state, by_gravity = propagation(rig, frame.t_s, frames[k + 1].t_s)
            J[:, state], J[:, STATE * n + 7 : STATE * n + 10] = -by_state, -by_gravity
            J[:, STATE * (k + 1) : STATE * (k + 2)] = np.eye(STATE)
            information += J.T @ np.linalg.solve(noise[k], J)
    scale = 1 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return covariance[constants, constants]


def test_forward_bound_equals_the_dense_one():
    run = small_run()
    dense = dense_bound(run, 0.5)
    bound = bounds(run, BoundOptions(gravity="free"))[0]
    forward = bound.block("p_imu_cam", "r_imu_cam", "timeshift", "gravity", "intrinsics", "distortion")
    np.testing.assert_allclose(np.sqrt(np.diag(forward)), np.sqrt(np.diag(dense)), rtol=2e-3)


def test_noise_of_a_still_imu_is_the_textbook_one():
    rig = reference_rig(1, trajectory=still(), densities=ImuDensities(1e-7, 1e-9))
    d, gap_s = rig.densities, 0.05
    _, _, noise = inertial_factors(rig, np.array([1.0, 1.0 + gap_s]))
    sigma = np.diag(noise[0])
    np.testing.assert_allclose(sigma[:3], d.gyro**2 * gap_s, rtol=1e-2)
    np.testing.assert_allclose(sigma[3:6], d.accel**2 * gap_s, rtol=3e-2)
    np.testing.assert_allclose(sigma[6:9], d.accel**2 * gap_s**3 / 3, rtol=3e-2)
    np.testing.assert_allclose(sigma[9:12], d.gyro_walk**2 * gap_s, rtol=1e-6)
    np.testing.assert_allclose(sigma[12:15], d.accel_walk**2 * gap_s, rtol=1e-6)


def test_more_knowledge_never_makes_it_worse():
    run = simulate(2, 2.5)
    sigma = {
        name: bounds(run, options)[0].sigma("p_imu_cam")
        for name, options in {
            "all": BoundOptions(gravity="free", target_scale_prior=1e-3),
            "scale known": BoundOptions(gravity="free"),
            "gravity magnitude": BoundOptions(),
            "gravity": BoundOptions(gravity="known"),
            "lens": BoundOptions(gravity="known", intrinsics=False, distortion=False),
        }.items()
    }
    steps = list(sigma.values())
    for looser, tighter in itertools.pairwise(steps):
        assert np.all(tighter <= looser * (1 + 1e-6))


def test_stamp_jitter_costs_time_shift_only():
    run = simulate(2, 2.5)
    calm, jittery = (bounds(run, BoundOptions(stamp_jitter_s=s))[0] for s in (0.0, 1e-3))
    expected = np.hypot(calm.sigma("timeshift")[0], 1e-3 / np.sqrt(len(run.frames)))
    assert jittery.sigma("timeshift")[0] == pytest.approx(expected, rel=0.25)
    assert np.all(jittery.sigma("r_imu_cam") < 1.3 * calm.sigma("r_imu_cam"))


def test_a_drift_doubles_the_sigma_of_the_newest_time_shift():
    run = simulate(3, 6.0)
    without, tiny, free = (bounds(run, BoundOptions(drift_prior=d))[0] for d in (0.0, 1e-12, 1.0))
    assert tiny.sigma("timeshift") == pytest.approx(without.sigma("timeshift"), rel=1e-6)
    # a line through even data: its end is known half as well as a mean
    assert free.sigma("timeshift") / without.sigma("timeshift") == pytest.approx(2.0, rel=0.3)
    assert free.sigma("p_imu_cam") == pytest.approx(without.sigma("p_imu_cam"), rel=0.2)


def test_target_free_bound_shrinks_with_time_and_ignores_lost_tracks():
    run = simulate_tracks(1, 3.0, max_features=20)
    early, late = bounds(run, BoundOptions(target_free=True), [1.5, 3.0])
    assert np.all(late.sigma("p_imu_cam") < early.sigma("p_imu_cam"))
    assert late.sigma("r_imu_cam").max() < np.deg2rad(2.0)
