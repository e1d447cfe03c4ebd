"""Layout, attitude errors against scipy, errors of gravity."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.model import state as st


def test_rotation_from_grp_is_scipys_rotation_from_mrp_and_back():
    p = np.random.default_rng(1).normal(size=(50, 3))
    R = st.rotation_from_grp(p)
    np.testing.assert_allclose(R, Rotation.from_mrp(p / 4.0).as_matrix(), atol=1e-13)
    np.testing.assert_allclose(st.grp_from_rotation(R), p, atol=1e-10)
    np.testing.assert_allclose([st.rotation_of_grp(x) for x in p], R, atol=1e-15)


def test_small_errors_are_rotation_vectors():
    p = np.array([1e-4, -2e-4, 3e-4])
    np.testing.assert_allclose(st.rotation_from_grp(p), Rotation.from_rotvec(p).as_matrix(), atol=1e-11)


GRAVITIES = [(0, 0, 9.8), (0, 0, -9.8), (0.1, -9.7, 1.2), (9.8, 0, 0), (0, 1e-9, -9.8)]


@pytest.mark.parametrize("gravity", GRAVITIES)
def test_errors_along_gravity_change_its_length_and_those_across_turn_it(gravity):
    g = np.array(gravity, dtype=float)
    size = np.linalg.norm(g)
    across = np.linalg.svd(g[None])[2][1:].T @ [0.2, -0.1]
    d = np.array([0.0 * g, 0.015 * g / size, across, across - 0.03 * g / size])
    moved = st.moved_gravity(g, d)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1) - size, [0.0, 0.015, 0.0, -0.03], atol=1e-12)
    np.testing.assert_allclose(np.cross(moved[:2], g), 0.0, atol=1e-12)
    angles = np.arctan2(np.linalg.norm(np.cross(moved[2:], g), axis=1), moved[2:] @ g)
    np.testing.assert_allclose(angles, np.arctan(np.hypot(0.2, 0.1) / size))
    assert np.all(moved[2:] @ across > 0)
    np.testing.assert_allclose([st.gravity_difference(x, g) for x in moved], d, atol=1e-12)


@pytest.mark.parametrize("gravity", GRAVITIES)
def test_small_errors_of_gravity_are_added(gravity):
    g, d = np.array(gravity, dtype=float), 1e-6 * np.eye(3)
    np.testing.assert_allclose(st.moved_gravity(g, d) - g, d, atol=1e-12)


def test_the_root_of_gravity_has_the_sigmas_of_direction_and_size():
    g = np.array([1.0, -9.0, 3.0])
    P = (lambda S: S @ S.T)(st.gravity_root(g, 0.1, 0.015))
    size = np.linalg.norm(g)
    assert g @ P @ g / size**2 == pytest.approx(0.015**2)
    for across in np.linalg.svd(g[None])[2][1:]:
        assert across @ P @ across == pytest.approx((0.1 * size) ** 2)
        assert across @ P @ g == pytest.approx(0.0, abs=1e-12)


def test_layout_has_no_overlap_and_covers_everything():
    layout = st.make_layout(
        {"a": "radtan", "b": "plumb_bob"},
        fix=frozenset(),
        estimate=frozenset({"imu_intrinsics", "size_effect", "accel_lag", "readout", "target_scale"}),
    )
    used = np.zeros(layout.size, dtype=int)
    used[: st.CORE] += 1
    used[layout.gyro_matrix] += 1
    used[layout.accel_matrix] += 1
    used[layout.accel_positions] += 1
    used[layout.accel_lag] += 1
    for c in layout.cameras.values():
        for s in (c.position, c.rotation, c.intrinsics, c.distortion):
            used[s] += 1
        for i in (c.timeshift, c.skew, c.readout):
            used[i] += 1
    used[layout.target_scale] += 1
    assert (used == 1).all()
    assert layout.dynamic == 40


def test_fixed_blocks_are_not_in_the_layout():
    layout = st.make_layout(
        {"a": "radtan"}, fix=frozenset({"intrinsics", "timeshift", "extrinsics"}), estimate=frozenset()
    )
    c = layout.cameras["a"]
    assert layout.size == st.CORE
    assert (c.position, c.rotation, c.timeshift, c.skew, c.intrinsics, c.distortion) == (None,) * 6
