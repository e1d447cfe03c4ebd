"""Parts around td_icp: lens refinement, rotations from tracks, windows, curves."""

import numpy as np
import pytest
from vical_mocks.points import board_points, simulate

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_model import products
from vical_daemon.estimation.init.camera_start import starting_camera
from vical_daemon.estimation.init.intrinsics_start import estimate_intrinsics
from vical_daemon.estimation.measurements import CameraPrior, PointsFrame
from vical_daemon.estimation.temporal.delay_windows import delay_windows
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve, OrientationCurve
from vical_daemon.estimation.temporal.rotation_start import shift_costs
from vical_daemon.estimation.temporal.rotation_turns import camera_turns
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions
from vical_daemon.estimation.temporal.track_orientations import relative_rotations, track_orientations


def _rate(t):
    return np.stack([0.9 * np.sin(1.3 * t), 0.7 * np.cos(2.1 * t), 0.8 * np.sin(1.7 * t + 1)], axis=-1)


def _attitude(t, steps=8000):
    """Attitude at times t by brute force: many small steps."""
    fine = np.linspace(0.0, t[-1], steps + 1)
    dt = fine[1] - fine[0]
    return products(so3.exp(_rate(fine[:-1] + dt / 2) * dt)[None])[0, np.round(t / dt).astype(int)]


def test_a_gyro_curve_follows_the_attitude_between_samples_and_predicts_what_a_bias_does():
    t = np.arange(0.0, 4.0, 0.01)
    times = np.array([0.5, 1.2345, 2.001, 3.7775])
    curve = GyroCurve.integrate(t, _rate(t), np.zeros(3))
    R, rate, integral = curve.at(times)
    truth = _attitude(np.append(times, 4.0))[:-1]
    assert np.abs(so3.log(np.swapaxes(truth, 1, 2) @ R)).max() < 1e-3
    np.testing.assert_allclose(rate, _rate(times), atol=1e-4)
    bias = np.array([1e-4, -2e-4, 1.5e-4])
    off = GyroCurve.integrate(t, _rate(t), bias).at(times)[0]
    np.testing.assert_allclose(so3.log(off @ np.swapaxes(R, 1, 2)), -integral @ bias, atol=2e-7)
    S = 1e-4 * np.random.default_rng(1).normal(0, 1, (3, 3))
    scaled = GyroCurve.integrate(t, _rate(t) @ (np.eye(3) + S).T, np.zeros(3)).at(times)[0]
    effect = curve.matrix_effect(times) @ S.ravel()
    np.testing.assert_allclose(so3.log(scaled @ np.swapaxes(R, 1, 2)), effect, atol=2e-6)


def test_an_orientation_curve_interpolates_to_third_order():
    t = np.arange(0.0, 4.0, 0.05)
    curve = OrientationCurve.interpolate(t, so3.quat_from_matrix(_attitude(np.append(t, 4.0))[:-1]))
    times = np.array([0.5, 1.225, 2.0125, 3.7])
    R, rate, _ = curve.at(times)
    truth = _attitude(np.append(times, 4.0))[:-1]
    assert np.abs(so3.log(np.swapaxes(truth, 1, 2) @ R)).max() < 1e-3
    np.testing.assert_allclose(rate, _rate(times), atol=0.02)


def test_a_wrong_lens_is_put_right_by_the_views():
    run = simulate(5, 8.0, camera_rate_hz=3.0, corner_sigma_px=0.2, outlier_fraction=0.02)
    frames = [PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px) for f in run.frames]
    lens = run.rig.lens
    truth = np.array([*lens.intrinsics, *lens.distortion])
    wrong = truth * np.array([1.01, 1.01, 1.0, 1.0, 0.9, 0.9, 1.0, 1.0]) + np.array([0, 0, 5, -4, 0, 0, 0, 0])
    prior = CameraPrior(lens.resolution, tuple(wrong[:4]), lens.model, tuple(wrong[4:]))
    found = starting_camera(prior)
    fit = estimate_intrinsics(found, frames, board_points())
    assert len(fit.views) >= 15
    error = np.concatenate((found.intrinsics, found.distortion)) - truth
    sigma = np.array([1.8, 1.8, 0.75, 0.64, 2.2e-3, 5.0e-3, 3.0e-4, 3.6e-4])  # of these views at 0.2 px
    assert np.all(np.abs(error) < 3 * sigma)
    assert fit.corner_sigma_px == pytest.approx(0.2, rel=0.15)
    few = starting_camera(prior)
    assert estimate_intrinsics(few, frames[:3], board_points()) is None
    assert np.array_equal(few.intrinsics, wrong[:4])


def _views(seed, n=80, translation=0.15):
    rng = np.random.default_rng(seed)
    points = np.column_stack((rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(3, 9, n)))
    R, t = so3.exp(rng.normal(0, 0.05, 3)), rng.normal(0, translation, 3)
    other = (points - t) @ R
    unit = lambda p: p / np.linalg.norm(p, axis=1, keepdims=True)  # noqa: E731
    return unit(points), unit(other), R


def test_rotation_between_views_of_unknown_points_is_exact_without_noise():
    for seed in range(8):
        first, second, R = _views(seed)
        ((found, covariance),) = relative_rotations([(first, second)])
        assert np.linalg.norm(so3.log(R.T @ found)) < 1e-6
        assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_pairs_of_views_do_not_depend_on_those_they_are_solved_with():
    rng = np.random.default_rng(5)
    pairs = []
    for seed, n in enumerate([80, 12, 31] * 12):  # more than are taken at once, of odd and even numbers
        first, second, _ = _views(seed, n)
        pairs.append((first, second + 1e-3 * rng.standard_normal(second.shape)))
    for pair, (R, covariance) in zip(pairs, relative_rotations(pairs), strict=True):
        ((alone, alone_covariance),) = relative_rotations([pair])
        np.testing.assert_allclose(R, alone, atol=1e-9)
        np.testing.assert_allclose(covariance, alone_covariance, rtol=1e-6)
    assert relative_rotations([]) == []


def test_tracks_become_chains_that_end_where_features_do():
    lens, rng = np.array([450.0, 450, 320, 240]), np.random.default_rng(2)
    points = np.column_stack((rng.uniform(-2, 2, 60), rng.uniform(-1.5, 1.5, 60), rng.uniform(3, 6, 60)))
    frames = []
    for k in range(20):
        p = (points - np.array([0.01 * k, 0, 0])) @ so3.exp(np.array([0, 0.01 * k, 0.005 * k]))
        ids = np.arange(60) + (1000 if k >= 12 else 0)
        frames.append(PointsFrame("cam0", k * 100_000_000, ids, p[:, :2] / p[:, 2:] * 450 + lens[2:]))
    chains = track_orientations(frames, lens, np.zeros(4))
    assert [len(c.t_cam_ns) for c in chains] == [12, 8]
    step = so3.log(chains[0].R_world_cam[0].T @ chains[0].R_world_cam[-1])
    np.testing.assert_allclose(step, so3.log(so3.exp(np.array([0, 0.11, 0.055]))), atol=1e-6)


def test_windows_follow_the_delay_and_announce_a_jump():
    rng = np.random.default_rng(3)
    t_imu = np.arange(0.0, 24.0, 0.01)
    gyro = _rate(t_imu) + rng.normal(0, 5.2e-3, (len(t_imu), 3))
    truth = GyroCurve.integrate(t_imu, _rate(t_imu), np.zeros(3))
    t = np.arange(1.0, 20.0, 0.1)
    shift = np.where(t < 7.5, 0.010, 0.030)
    R = truth.at(t + shift)[0] @ so3.exp(rng.normal(0, 1.7e-3, (len(t), 3)))
    reports = delay_windows(t_imu, gyro, t, R, 1.7e-3, TdIcpOptions(search_s=0.5), 6.0)
    assert [r.t_s for r in reports] == pytest.approx([4.0, 7.0, 10.0, 13.0, 16.0], abs=0.1)
    assert abs(reports[0].timeshift_s - 0.010) < 5 * reports[0].timeshift_sigma_s
    assert any(r.jumped for r in reports)
    assert abs(reports[-1].timeshift_s - 0.030) < 5 * reports[-1].timeshift_sigma_s


def test_costs_of_many_shifts_are_those_of_a_few():
    """A long search compares them in parts: memory must not grow with its length."""
    run = simulate(3, 40.0)
    t_s = (run.t_imu_ns - run.t_imu_ns[0]) * 1e-9
    curve = GyroCurve.integrate(t_s, run.gyro_rps, np.zeros(3))
    t_cam_s = np.arange(12.0, 20.0, 0.1)
    turns = camera_turns(t_cam_s - 3.0, curve.quaternion(t_cam_s))
    shifts_s = np.arange(-1500, 3500) * 0.01
    costs = shift_costs(curve, t_cam_s - 3.0, turns, shifts_s, 0.1)
    assert abs(shifts_s[np.argmin(costs)] - 3.0) < 0.011
    few = slice(1200, 1900)
    np.testing.assert_array_equal(costs[few], shift_costs(curve, t_cam_s - 3.0, turns, shifts_s[few], 0.1))
