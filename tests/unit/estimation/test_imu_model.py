"""Strapdown integration and its noise against brute force."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation import imu_model as im
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
    return im.ImuSegment(t, rates(t), forces(t), 1 / rate)


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
    biased = im.ImuSegment(seg.t_s, np.linalg.solve(M, seg.gyro.T).T + b, seg.accel + a, seg.gap_s)
    relative = im.strapdown(biased, b[None], a[None], M[None], np.eye(3)[None])
    plain = im.strapdown(seg, np.zeros((1, 3)), np.zeros((1, 3)))
    np.testing.assert_allclose(relative.dR, plain.dR, atol=1e-12)
    np.testing.assert_allclose(relative.dp, plain.dp, atol=1e-12)


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
    Q = im.process_noise(R0.as_matrix(), relative, noise).covariance
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


def filled(n=500, base=0):
    buffer = im.ImuBuffer(base)
    for k in range(n):
        t = 0.01 * k
        assert buffer.append(t, rates(t), forces(t))
    return buffer


def test_segment_starts_and_ends_exactly_where_asked():
    seg = filled().segment(0.123, 0.456)
    assert seg.t_s[0] == 0.123
    assert seg.t_s[-1] == 0.456
    straight = rates(0.12) + 0.3 * (rates(0.13) - rates(0.12))
    assert np.abs(seg.gyro[0] - rates(0.123)).max() < 0.02 * np.abs(straight - rates(0.123)).max()
    assert (np.diff(seg.t_s) > 0).all()


def test_a_quick_shake_is_not_shortened_by_straight_lines_between_samples():
    w, dt = 2 * np.pi * 3.0, 0.01
    buffer = im.ImuBuffer(0)
    for k in range(60):
        shake = np.array([np.sin(w * k * dt), 0.0, 0.0])
        buffer.append(k * dt, np.zeros(3), shake)
    seg = buffer.segment(0.1033, 0.1533)
    gained = im.strapdown(seg, np.zeros((1, 3)), np.zeros((1, 3))).dv[0, -1, 0]
    exact = (np.cos(w * 0.1033) - np.cos(w * 0.1533)) / w
    assert gained == pytest.approx(exact, rel=2e-4)
    plain = im.strapdown(seg._replace(gyro_slope=None, accel_slope=None), np.zeros((1, 3)), np.zeros((1, 3)))
    assert abs(plain.dv[0, -1, 0] / exact - 1.0) > 1.5e-3


def test_a_hole_in_the_data_is_bridged_by_straight_lines():
    buffer = im.ImuBuffer(0)
    for t in (0.0, 0.01, 0.02, 0.2, 0.21, 0.22):
        buffer.append(t, np.full(3, 1.0 + t), np.full(3, 5.0 * t))
    seg = buffer.segment(0.015, 0.205)
    np.testing.assert_allclose(seg.gyro_slope, 1.0, atol=1e-9)
    np.testing.assert_allclose(seg.accel[:, 0], 5.0 * seg.t_s, atol=1e-9)


@pytest.mark.parametrize(("a", "b"), [(-0.1, 0.2), (0.2, 5.2), (0.3, 0.2)])
def test_segment_outside_the_data_is_none(a, b):
    assert filled().segment(a, b) is None


def test_segment_on_sample_instants_has_no_empty_interval():
    seg = filled().segment(0.1, 0.2)
    assert (np.diff(seg.t_s) > 0).all()
    np.testing.assert_allclose(seg.gyro[-1], rates(0.2), atol=1e-12)


def test_buffer_refuses_what_is_not_newer_and_stays_bounded_when_trimmed():
    buffer = im.ImuBuffer(0)
    for k in range(30_000):
        buffer.append(0.01 * k, np.zeros(3), np.zeros(3))
        buffer.trim(0.01 * k - 1.0)
    assert len(buffer) < 110
    assert len(buffer._rows) <= 4096
    assert not buffer.append(buffer.newest_s, np.zeros(3), np.zeros(3))
    assert buffer.segment(buffer.newest_s - 0.5, buffer.newest_s) is not None
