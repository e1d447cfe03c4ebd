"""Layout, attitude errors and gravity's tilt against scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.model import state as st
from vical_daemon.estimation.model.retract import retract


def test_rotation_from_grp_is_scipys_rotation_from_mrp_and_back():
    p = np.random.default_rng(1).normal(size=(50, 3))
    R = st.rotation_from_grp(p)
    np.testing.assert_allclose(R, Rotation.from_mrp(p / 4.0).as_matrix(), atol=1e-13)
    np.testing.assert_allclose(st.grp_from_rotation(R), p, atol=1e-10)
    np.testing.assert_allclose([st.rotation_of_grp(x) for x in p], R, atol=1e-15)


def test_small_errors_are_rotation_vectors():
    p = np.array([1e-4, -2e-4, 3e-4])
    np.testing.assert_allclose(st.rotation_from_grp(p), Rotation.from_rotvec(p).as_matrix(), atol=1e-11)


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (0.1, -9.7, 1.2), (9.8, 0, 0), (0, 1e-9, -1)])
def test_tilt_basis_is_orthonormal_and_across_gravity(direction):
    g = 9.8 * np.array(direction, dtype=float) / np.linalg.norm(direction)
    B = st.tilt_basis(g)
    np.testing.assert_allclose(B.T @ B, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(g @ B, 0.0, atol=1e-12)


def test_tilting_keeps_the_length_and_turns_by_the_angle():
    g = np.array([1.0, -9.0, 3.0])
    tilted = st.tilted_gravity(g, st.tilt_basis(g), np.array([[0.0, 0.0], [0.02, -0.01]]))
    np.testing.assert_allclose(tilted[0], g)
    assert np.linalg.norm(tilted[1]) == pytest.approx(np.linalg.norm(g), rel=1e-14)
    angle = np.arccos(tilted[1] @ g / (g @ g))
    assert angle == pytest.approx(np.hypot(0.02, 0.01), rel=1e-4)


@pytest.mark.parametrize("direction", [(0.0, 1.0, 1e-4), (1.0, 0.0, 1e-4), (0.6, -0.8, 1e-4)])
def test_the_directions_of_tilt_turn_with_gravity_and_never_jump(direction):
    layout = st.make_layout({}, fix=frozenset(), estimate=frozenset())
    z, eye = np.zeros(3), np.eye(3)
    state = st.State(0.0, eye, z, z, z, z, 9.8 * np.array(direction), {})
    first = state.tilt
    for step in np.linspace(-1e-3, 1e-3, 11):  # back and forth through the horizontal
        dx = np.zeros(layout.size)
        dx[st.GRAVITY] = first.T @ np.cross(state.gravity / 9.8, [0.0, 0.0, step])
        state = retract(state, layout, dx)
        np.testing.assert_allclose(state.tilt.T @ state.tilt, np.eye(2), atol=1e-12)
        np.testing.assert_allclose(state.gravity @ state.tilt, 0.0, atol=1e-12)
        np.testing.assert_allclose(state.tilt, first, atol=5e-3)
    assert state.gravity[2] * direction[2] < 0 or abs(state.gravity[2]) < 0.02


def test_layout_has_no_overlap_and_covers_everything():
    layout = st.make_layout(
        {"a": "radtan", "b": "plumb_bob"},
        fix=frozenset(),
        estimate=frozenset({"imu_intrinsics", "size_effect", "accel_lag", "readout", "target_scale"}),
    )
    used = np.zeros(layout.size, dtype=int)
    used[:17] += 1
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
    assert layout.dynamic == 39


def test_fixed_blocks_are_not_in_the_layout():
    layout = st.make_layout(
        {"a": "radtan"}, fix=frozenset({"intrinsics", "timeshift", "extrinsics"}), estimate=frozenset()
    )
    c = layout.cameras["a"]
    assert layout.size == 17
    assert (c.position, c.rotation, c.timeshift, c.skew, c.intrinsics, c.distortion) == (None,) * 6
