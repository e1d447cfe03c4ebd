"""attitude.py: MRP, GRP, yaw-pitch-roll and rates against scipy and finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.geometry import attitude as at
from vical_daemon.estimation.geometry import so3

H = 1e-6


def _rotvecs():
    rng = np.random.default_rng(11)
    axes = rng.standard_normal((200, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    special = [0.0, 1e-12, 1e-6, np.pi - 1e-9, np.pi - 1e-4, 3.0]
    return axes * np.concatenate((special, rng.uniform(0, np.pi, 194)))[:, None]


def _numeric(f, x):
    """Central differences of f at x (one vector), columns by x."""
    return np.stack([(f(x + d) - f(x - d)) / (2 * H) for d in H * np.eye(len(x))], axis=-1)


def _inner_outer():
    """MRPs of both sets, near 0, around the switch and in between."""
    axis = np.array([0.6, -0.48, 0.64])
    return [axis * r for r in (1e-9, 0.05, 0.6, 0.999999, 1.000001, 1.7)]


def test_mrp_agree_with_scipy_and_stay_inside_the_unit_ball():
    v = _rotvecs()
    s = at.mrp_from_rotvec(v)
    np.testing.assert_allclose(s, Rotation.from_rotvec(v).as_mrp(), atol=1e-14)
    assert np.all(np.linalg.norm(s, axis=1) <= 1 + 1e-15)
    np.testing.assert_allclose(at.matrix_from_mrp(s), so3.exp(v), atol=2e-15)
    np.testing.assert_allclose(at.rotvec_from_mrp(s), v, atol=1e-13)


def test_the_shadow_set_names_the_same_rotation():
    s = at.mrp_from_rotvec(_rotvecs()[1:])
    np.testing.assert_allclose(at.matrix_from_mrp(at.mrp_shadow(s)), at.matrix_from_mrp(s), atol=1e-14)
    np.testing.assert_allclose(at.mrp_switch(at.mrp_shadow(s)), s, rtol=1e-13)
    np.testing.assert_allclose(at.mrp_switch(s), s)
    for x in _inner_outer()[1:]:
        np.testing.assert_allclose(
            at.mrp_shadow_jacobian(x), _numeric(at.mrp_shadow, x), rtol=1e-6, atol=1e-7
        )


def test_composition_reads_like_matrix_products():
    v = _rotvecs()
    s, t = at.mrp_from_rotvec(v[:100]), at.mrp_from_rotvec(v[100:])
    product = at.matrix_from_mrp(s) @ at.matrix_from_mrp(t)
    np.testing.assert_allclose(at.matrix_from_mrp(at.mrp_compose(s, t)), product, atol=1e-12)
    for x in _inner_outer():
        y = np.array([0.3, 0.2, -0.5])
        by_s, by_t = at.mrp_compose_jacobians(x, y)
        np.testing.assert_allclose(
            by_s, _numeric(lambda a, y=y: at.mrp_compose(a, y), x), rtol=1e-6, atol=1e-7
        )
        np.testing.assert_allclose(
            by_t, _numeric(lambda b, x=x: at.mrp_compose(x, b), y), rtol=1e-6, atol=1e-7
        )


def test_rates_by_moving_the_rotation():
    w = np.array([0.7, -1.1, 0.4])
    for s in _inner_outer():
        R = at.matrix_from_mrp(s)
        later, earlier = R @ so3.exp(w * H), R @ so3.exp(-w * H)
        to_mrp = lambda M, s=s: _same_set(at.mrp_from_quat(so3.quat_from_matrix(M)), s)  # noqa: E731
        np.testing.assert_allclose(
            at.mrp_rate(s, w), (to_mrp(later) - to_mrp(earlier)) / (2 * H), rtol=1e-6, atol=1e-8
        )
        np.testing.assert_allclose(
            at.mrp_rate_jacobian(s, w), _numeric(lambda x: at.mrp_rate(x, w), s), atol=1e-7
        )
        np.testing.assert_allclose(at.mrp_tangent(s) @ at.mrp_rate_matrix(s), np.eye(3), atol=1e-14)
        np.testing.assert_allclose(
            at.mrp_rotate_jacobian(s, w), _numeric(lambda x: at.matrix_from_mrp(x) @ w, s), atol=1e-7
        )
        np.testing.assert_allclose(at.matrix_rate(R, w), (later - earlier) / (2 * H), atol=1e-9)
        q = so3.quat_from_matrix(R)
        dq = (so3.quat_multiply(q, so3.quat_from_rotvec(w * H)) - q) / H
        np.testing.assert_allclose(at.quat_rate(q, w), dq, atol=1e-5)


def _same_set(s, like):
    other = at.mrp_shadow(s)
    return s if np.linalg.norm(s - like) <= np.linalg.norm(other - like) else other


def test_integrating_mrp_through_a_whole_turn_with_the_switch():
    w = np.array([1.0, 0.4, -0.2])
    s, R = np.zeros(3), np.eye(3)
    dt = 1e-3
    for _ in range(7000):
        middle = s + 0.5 * dt * at.mrp_rate(s, w)
        s = at.mrp_switch(s + dt * at.mrp_rate(middle, w))
        assert s @ s <= 1.0
    R = so3.exp(w * 7.0)
    assert np.linalg.norm(so3.log(R.T @ at.matrix_from_mrp(s))) < 1e-5


@pytest.mark.parametrize("a", [0.0, 0.5, 1.0])
def test_grp_errors_are_rotation_vectors_when_small_and_invert_when_large(a):
    v = _rotvecs()
    v = v[np.linalg.norm(v, axis=1) < 3.1]
    p = at.grp_from_quat(so3.quat_from_rotvec(v), a)
    np.testing.assert_allclose(so3.rotvec_from_quat(at.quat_from_grp(p, a)), v, atol=1e-12)
    small = np.array([1e-4, -2e-4, 0.5e-4])
    np.testing.assert_allclose(at.grp_from_quat(so3.quat_from_rotvec(small), a), small, rtol=1e-7)
    np.testing.assert_allclose(
        _numeric(lambda x: at.quat_from_grp(x, a)[1:], np.zeros(3)), 0.5 * np.eye(3), atol=1e-9
    )


def test_grp_with_a_1_is_four_times_the_mrp():
    v = _rotvecs()
    np.testing.assert_allclose(
        at.grp_from_quat(so3.quat_from_rotvec(v)), 4 * at.mrp_from_rotvec(v), atol=1e-14
    )


def test_yaw_pitch_roll_agree_with_scipy():
    v = _rotvecs()
    ypr = at.ypr_from_matrix(so3.exp(v))
    np.testing.assert_allclose(ypr, Rotation.from_rotvec(v).as_euler("ZYX"), atol=1e-9)
    np.testing.assert_allclose(at.matrix_from_ypr(ypr), so3.exp(v), atol=1e-14)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_gimbal_lock_still_gives_the_rotation_back(pitch):
    R = at.matrix_from_ypr(np.array([0.4, pitch, -0.3]))
    ypr = at.ypr_from_matrix(R)
    assert ypr[2] == 0.0
    np.testing.assert_allclose(at.matrix_from_ypr(ypr), R, atol=1e-7)


def test_rates_of_yaw_pitch_roll():
    ypr = np.array([0.4, -0.9, 2.5])
    w = np.array([0.7, -1.1, 0.4])
    R = at.matrix_from_ypr(ypr)
    numeric = (at.ypr_from_matrix(R @ so3.exp(w * H)) - at.ypr_from_matrix(R @ so3.exp(-w * H))) / (2 * H)
    np.testing.assert_allclose(at.ypr_rate(ypr, w), numeric, rtol=1e-7)
    np.testing.assert_allclose(at.ypr_rate_matrix(ypr) @ at.ypr_rate(ypr, w), w, atol=1e-14)


def test_everything_broadcasts():
    s = np.zeros((4, 1, 3)) + 0.1
    t = np.zeros((1, 5, 3)) - 0.2
    assert at.mrp_compose(s, t).shape == (4, 5, 3)
    assert at.mrp_compose_jacobians(s, t)[0].shape == (4, 5, 3, 3)
    assert at.mrp_rate(s, t).shape == (4, 5, 3)
    assert at.ypr_from_matrix(at.matrix_from_ypr(s)).shape == (4, 1, 3)
