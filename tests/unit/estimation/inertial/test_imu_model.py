"""Strapdown integration and its noise against brute force."""

import numpy as np
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.inertial import imu_model as im
from vical_daemon.estimation.inertial.imu_buffer import ImuSegment
from vical_daemon.estimation.measurements import ImuNoise

G = np.array([0.3, -0.2, -9.8])


def rates(t):
    t = np.asarray(t)[..., None]
    return np.concatenate([0.9 * np.sin(3 * t), 0.7 * np.cos(2 * t), 0.5 * np.sin(4 * t + 1)], axis=-1)


def forces(t):
    t = np.asarray(t)[..., None]
    return np.concatenate([np.sin(2 * t), 9.8 + np.cos(3 * t), 0.5 * np.sin(5 * t)], axis=-1)


def brute_force(T, steps=3000):
    h = T / steps
    R, v, p = Rotation.identity(), np.zeros(3), np.zeros(3)
    for k in range(steps):
        t = (k + 0.5) * h
        middle = R * Rotation.from_rotvec(rates(t) * h / 2)
        a = middle.apply(forces(t)) + G
        p, v = p + v * h + 0.5 * a * h * h, v + a * h
        R = R * Rotation.from_rotvec(rates(t) * h)
    return R.as_matrix(), v, p


def segment(T, rate):
    t = np.linspace(0.0, T, int(T * rate) + 1)
    return ImuSegment(t, rates(t), forces(t), 1 / rate)


def integrate(seg):
    zero = np.zeros((1, 3))
    relative = im.strapdown(seg, zero, zero)
    return im.compose(im.Motion(np.eye(3)[None], zero, zero), relative, G[None])


def test_converges_with_the_square_of_the_step_to_the_brute_force_solution():
    R, v, p = brute_force(0.5, 3000)
    errors = []
    for rate in (100, 200):
        end = integrate(segment(0.5, rate))
        errors.append([np.abs(end.R[0] - R).max(), np.abs(end.v[0] - v).max(), np.abs(end.p[0] - p).max()])
    # linear interpolation errs by f'' h^2/12 over the half second
    assert np.all(np.array(errors[0]) < [7e-5, 5e-4, 2e-4])
    assert np.all(np.array(errors[1]) < 0.35 * np.array(errors[0]) + 1e-9)


def test_a_bias_is_taken_off_and_a_matrix_applied():
    seg = segment(0.1, 200)
    b, a = np.array([0.02, -0.01, 0.03]), np.array([0.1, 0.2, -0.1])
    M = np.eye(3) + 0.01 * np.arange(9).reshape(3, 3)
    biased = ImuSegment(seg.t_s, np.linalg.solve(M, seg.gyro.T).T + b, seg.accel + a, seg.gap_s)
    relative = im.strapdown(biased, b[None], a[None], M[None], np.eye(3)[None])
    plain = im.strapdown(seg, np.zeros((1, 3)), np.zeros((1, 3)))
    np.testing.assert_allclose(relative.dR, plain.dR, atol=1e-12)
    np.testing.assert_allclose(relative.dp, plain.dp, atol=1e-12)


def late_segment(T, rate, lag_s):
    """Forces of `lag_s` before their stamps, with their slopes; rates as they should be."""
    t, step = np.linspace(0.0, T, int(T * rate) + 1), 1e-6
    slopes = [
        (f(t - late + step) - f(t - late - step)) / (2 * step) for f, late in ((rates, 0), (forces, lag_s))
    ]
    return ImuSegment(t, rates(t), forces(t - lag_s), 1 / rate, *slopes)


def test_an_accelerometer_that_is_late_is_put_right():
    zero, lag_s = np.zeros((1, 3)), 1e-3
    late, right = late_segment(0.1, 200, lag_s), late_segment(0.1, 200, 0.0)
    plain, wrong = im.strapdown(right, zero, zero), im.strapdown(late, zero, zero)
    put_right = im.strapdown(late, zero, zero, accel_lag_s=np.array([lag_s]))
    assert np.abs(wrong.dv - plain.dv).max() > 1e-4
    np.testing.assert_allclose(put_right.dv, plain.dv, atol=2e-6)
    np.testing.assert_allclose(put_right.dp, plain.dp, atol=2e-7)
    np.testing.assert_array_equal(put_right.dR, plain.dR)


def apart_segment(T, rate, positions):
    """Forces as axes at some positions measure them: at the origin, plus alpha x r + omega x (omega x r)."""
    seg = late_segment(T, rate, 0.0)
    for i, r in enumerate(positions):
        felt = np.cross(seg.gyro_slope, r) + np.cross(seg.gyro, np.cross(seg.gyro, r))
        seg.accel[:, i] += felt[:, i]
    return seg


def test_axes_of_an_accelerometer_that_are_apart_are_put_right():
    zero, positions = (
        np.zeros((1, 3)),
        np.array([[-5e-3, 8e-3, -1e-3], [2e-3, -4e-3, 0.0], [3e-3, -4e-3, 1e-3]]),
    )
    plain = im.strapdown(late_segment(0.1, 200, 0.0), zero, zero)
    wrong = im.strapdown(apart_segment(0.1, 200, positions), zero, zero)
    put_right = im.strapdown(apart_segment(0.1, 200, positions), zero, zero, accel_positions=positions[None])
    assert np.abs(wrong.dv - plain.dv).max() > 1e-4
    np.testing.assert_allclose(put_right.dv, plain.dv, atol=1e-12)
    np.testing.assert_array_equal(put_right.dR, plain.dR)


def test_influence_of_a_force_agrees_with_differences_of_the_integration():
    seg, lags = late_segment(0.1, 200, 0.0), np.array([0.0, 1e-4])
    R0, zero = Rotation.from_rotvec([0.3, -0.4, 0.2]).as_matrix(), np.zeros((2, 3))
    relative = im.strapdown(seg, zero, zero, accel_lag_s=lags)
    end = im.compose(im.Motion(np.repeat(R0[None], 2, 0), zero, zero), relative, np.repeat(G[None], 2, 0))
    moved = np.concatenate([np.zeros(3), end.p[1] - end.p[0], end.v[1] - end.v[0]]) / lags[1]
    nominal = im.Strapdown(*(x[:1] for x in relative[:3]), relative.t_s)
    by_lag = im.influence(R0, nominal).by_force(seg.accel_slope)
    np.testing.assert_allclose(by_lag, moved, atol=2e-3 * np.abs(moved).max())


def test_batch_equals_loop():
    seg, rng = segment(0.1, 100), np.random.default_rng(0)
    bg, ba = 0.01 * rng.normal(size=(4, 3)), 0.1 * rng.normal(size=(4, 3))
    together = im.strapdown(seg, bg, ba)
    for k in range(4):
        alone = im.strapdown(seg, bg[k : k + 1], ba[k : k + 1])
        # the coning term is taken from the first of the batch: parts in 10^8
        np.testing.assert_allclose(together.dv[k], alone.dv[0], atol=2e-8)
        np.testing.assert_allclose(together.dR[k], alone.dR[0], atol=1e-7)


def test_process_noise_agrees_with_a_monte_carlo_of_the_integration():
    rng, T, steps, n = np.random.default_rng(2), 0.1, 40, 3000
    noise = ImuNoise(gyro_density=2e-3, accel_density=1e-2)
    seg = segment(T, 100)
    relative = im.strapdown(seg, np.zeros((1, 3)), np.zeros((1, 3)))
    R0 = Rotation.from_rotvec([0.3, -0.4, 0.2])
    Q = im.influence(R0.as_matrix(), relative).noise(noise)
    fine = segment(T, steps / T)
    h = T / steps
    zero = np.zeros((n, 3))
    R, v, p = np.repeat(R0.as_matrix()[None], n, 0), zero.copy(), zero.copy()
    for k in range(steps):
        w = 0.5 * (fine.gyro[k] + fine.gyro[k + 1]) + noise.gyro_density / np.sqrt(h) * rng.normal(
            size=(n, 3)
        )
        f = 0.5 * (fine.accel[k] + fine.accel[k + 1]) + noise.accel_density / np.sqrt(h) * rng.normal(
            size=(n, 3)
        )
        a = np.einsum("nij,nj->ni", R @ Rotation.from_rotvec(w * h / 2).as_matrix(), f) + G
        p, v = p + v * h + 0.5 * h * h * a, v + a * h
        R = R @ Rotation.from_rotvec(w * h).as_matrix()
    turned = Rotation.from_matrix(np.linalg.inv(R.mean(0)) @ R).as_rotvec()
    samples = np.cov(np.hstack([turned, p, v]).T)
    d = np.sqrt(np.diag(Q))
    np.testing.assert_allclose(np.sqrt(np.diag(samples)) / d, 1.0, atol=0.06)
    np.testing.assert_allclose(samples / np.outer(d, d), Q / np.outer(d, d), atol=0.09)


def test_influence_of_a_bias_agrees_with_differences_of_the_integration():
    seg, step = segment(0.1, 200), 1e-5
    R0 = Rotation.from_rotvec([0.3, -0.4, 0.2]).as_matrix()
    biases = np.concatenate([np.zeros((1, 6)), step * np.eye(6)])
    relative = im.strapdown(seg, biases[:, :3], biases[:, 3:])
    start = im.Motion(np.repeat(R0[None], 7, 0), np.zeros((7, 3)), np.zeros((7, 3)))
    end = im.compose(start, relative, np.repeat(G[None], 7, 0))
    turned = Rotation.from_matrix(end.R[0].T @ end.R[1:]).as_rotvec()
    moved = np.concatenate([turned, end.p[1:] - end.p[0], end.v[1:] - end.v[0]], axis=1).T / step
    nominal = im.Strapdown(*(x[:1] for x in relative[:3]), relative.t_s)
    by_bias = im.influence(R0, nominal).by_bias()
    scale = np.abs(by_bias).max(axis=1, keepdims=True)
    np.testing.assert_allclose(by_bias / scale, moved / scale, atol=2e-3)  # trapezoids over the nodes


def test_white_noise_of_a_force_that_keeps_its_direction_is_exact():
    t = np.array([0.0, 0.004, 0.01, 0.03])
    still = ImuSegment(t, np.zeros((4, 3)), np.tile([0.0, 0.0, 9.8], (4, 1)), 0.02)
    relative = im.strapdown(still, np.zeros((1, 3)), np.zeros((1, 3)))
    Q = im.influence(np.eye(3), relative).noise(ImuNoise(gyro_density=1e-9, accel_density=0.1))
    T = t[-1]
    np.testing.assert_allclose(
        Q[3:, 3:], 0.01 * np.kron([[T**3 / 3, T**2 / 2], [T**2 / 2, T]], np.eye(3)), atol=1e-15
    )


def test_many_rotation_steps_multiply_like_few():
    rng = np.random.default_rng(4)
    for batch, count in ((1, 1), (1, 64), (1, 65), (1, 1000), (3, 700)):
        steps = Rotation.from_rotvec(0.01 * rng.standard_normal((batch * count, 3))).as_matrix()
        steps = steps.reshape(batch, count, 3, 3)
        found = im.products(steps)
        R = np.broadcast_to(np.eye(3), (batch, 3, 3))
        np.testing.assert_array_equal(found[:, 0], R)
        for k in range(count):
            R = R @ steps[:, k]
            np.testing.assert_allclose(found[:, k + 1], R, atol=1e-12)
