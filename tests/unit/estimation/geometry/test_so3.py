"""so3.py against scipy and finite differences, near 0, near pi and in between."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.geometry import so3


def _rotvecs():
    rng = np.random.default_rng(3)
    axes = rng.standard_normal((400, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    axes[:6] = np.vstack((np.eye(3), -np.eye(3)))
    angles = np.concatenate(
        (
            [0.0, 1e-300, 1e-160, 1e-20, 1e-12, 1e-8, 1e-5, 1e-3, 0.29999, 0.3001],
            np.pi - np.array([1e-15, 1e-12, 1e-9, 1e-7, 1e-4, 1e-2]),
            rng.uniform(0, np.pi, 384),
        )
    )
    return axes * angles[:, None]


def _to_scipy_quat(q):
    return np.roll(q, -1, axis=-1)


def test_exp_and_log_agree_with_scipy_everywhere():
    v = _rotvecs()
    R = so3.exp(v)
    np.testing.assert_allclose(R, Rotation.from_rotvec(v).as_matrix(), atol=1e-15)
    back = so3.log(R)
    # near pi the sign of the axis is free: compare the rotations, and the vectors elsewhere
    np.testing.assert_allclose(so3.exp(back), R, atol=2e-15)
    away = np.linalg.norm(v, axis=1) < np.pi - 1e-8
    np.testing.assert_allclose(back[away], v[away], atol=1e-14, rtol=1e-13)


def test_exp_of_one_vector_is_exp():
    v = np.random.default_rng(3).normal(size=(50, 3)) * np.logspace(-12, 0.9, 50)[:, None]
    np.testing.assert_allclose([so3.exp_one(x) for x in v], so3.exp(v), atol=4e-16)
    np.testing.assert_array_equal(so3.exp_one(np.zeros(3)), np.eye(3))


def test_log_is_accurate_to_a_relative_error_near_zero():
    v = np.array([[1e-9, -2e-9, 3e-9], [0, 1e-12, 0]])
    np.testing.assert_allclose(so3.log(so3.exp(v)), v, rtol=1e-12)


def test_quaternions_agree_with_scipy():
    v = _rotvecs()
    q = so3.quat_from_rotvec(v)
    np.testing.assert_allclose(_to_scipy_quat(q), Rotation.from_rotvec(v).as_quat(), atol=1e-15)
    np.testing.assert_allclose(so3.matrix_from_quat(q), so3.exp(v), atol=2e-15)
    np.testing.assert_allclose(so3.rotvec_from_quat(q), v, atol=1e-14)
    np.testing.assert_allclose(so3.rotvec_from_quat(-q), v, atol=1e-14)
    q_back = so3.quat_from_matrix(so3.exp(v))
    assert np.all(q_back[:, 0] >= 0)
    assert np.all(np.minimum(np.abs(q_back - q).max(1), np.abs(q_back + q).max(1)) < 1e-14)


def test_products_rotations_and_broadcasting():
    v = _rotvecs()
    p, q = so3.quat_from_rotvec(v[:200]), so3.quat_from_rotvec(v[200:])
    Rp, Rq = so3.exp(v[:200]), so3.exp(v[200:])
    np.testing.assert_allclose(so3.matrix_from_quat(so3.quat_multiply(p, q)), Rp @ Rq, atol=4e-15)
    np.testing.assert_allclose(so3.matrix_from_quat(so3.quat_conjugate(p)), np.swapaxes(Rp, 1, 2), atol=4e-15)
    outer = so3.quat_multiply(p[:5, None], q[None, :7])
    assert outer.shape == (5, 7, 4)
    np.testing.assert_allclose(outer[4, 6], so3.quat_multiply(p[4], q[6]))
    assert so3.exp(np.zeros((2, 0, 3))).shape == (2, 0, 3, 3)
    assert so3.log(so3.exp(np.array([0.1, 0.2, 0.3]))).shape == (3,)


def test_hat_is_the_cross_product():
    v = np.array([1.0, 2.0, 3.0])
    u = np.array([-0.5, 0.2, 4.0])
    np.testing.assert_allclose(so3.hat(v) @ u, np.cross(v, u))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.2999, 0.3001, 1.0, 3.0, np.pi, 4.5])
def test_right_jacobian_by_finite_differences(angle):
    axis = np.array([0.6, -0.48, 0.64])
    v = axis * angle
    h = 1e-6
    steps = h * np.eye(3)
    numeric = np.stack(
        [
            (so3.log(so3.exp(v).T @ so3.exp(v + d)) - so3.log(so3.exp(v).T @ so3.exp(v - d))) / (2 * h)
            for d in steps
        ],
        axis=1,
    )
    J = so3.right_jacobian(v)
    np.testing.assert_allclose(J, numeric, atol=3e-9)
    np.testing.assert_allclose(so3.right_jacobian_inverse(v) @ J, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(so3.right_jacobian(-v), J.T, atol=1e-15)


def test_right_jacobian_has_no_step_where_the_series_takes_over():
    axis = np.array([0.6, -0.48, 0.64])
    for f in (so3.right_jacobian, so3.right_jacobian_inverse):
        below, above = f(axis * (0.3 - 1e-13)), f(axis * (0.3 + 1e-13))
        np.testing.assert_allclose(below, above, atol=1e-12)


def test_turn_between_two_orientations_is_that_of_scipy_in_the_frame_of_the_first():
    a, b = Rotation.random(50, rng=4), Rotation.random(50, rng=5)
    found = so3.turn_between(*(np.roll(x.as_quat(), 1, axis=-1) for x in (a, b)))
    np.testing.assert_allclose(found, (a.inv() * b).as_rotvec(), atol=1e-13)
