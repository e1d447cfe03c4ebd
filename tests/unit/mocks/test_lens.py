"""The simulated lens shows what a lens of glass could."""

import cv2
import numpy as np
import pytest
from vical_mocks.lens import Lens

WIDE = Lens((488.0, 491.0, 369.0, 232.0), (-0.29, -0.004, 0.0, 0.0), (752, 480))


def test_nothing_is_seen_beyond_the_radius_at_which_the_polynomial_turns_back():
    r = np.linspace(0.0, 2.0, 4001)
    uv, seen = WIDE.project(np.column_stack([-r, np.zeros_like(r), np.ones_like(r)]))
    away = 369.0 - uv[:, 0]
    assert r[seen].max() == pytest.approx(r[np.argmax(away)], abs=1e-3)
    assert 1.0 < r[seen].max() < 1.1
    assert (np.diff(away[seen]) > 0.0).all()


def test_a_pixel_has_one_ray():
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-1.5, 1.5, (4000, 2)), np.ones(4000)])
    uv, seen = WIDE.project(rays)
    inner = seen & (np.hypot(*rays[:, :2].T) < 1.0)
    assert WIDE.unproject(uv[inner]) == pytest.approx(rays[inner], abs=1e-9)
    assert 500 < np.count_nonzero(inner) < np.count_nonzero(seen) < 2500


def test_a_lens_that_does_not_turn_back_is_limited_by_its_picture_alone():
    euroc = Lens((458.7, 457.3, 367.2, 248.4), (-0.283, 0.074, 2e-4, 2e-5), (752, 480))
    corners = np.array([[1.0, 1.0], [750.0, 1.0], [750.0, 478.0], [1.0, 478.0]])
    assert euroc.project(euroc.unproject(corners))[1].all()


def test_the_term_of_the_sixth_power_is_opencvs_k3():
    lens = Lens(distortion=(-0.2, 0.05, 1e-3, -5e-4), sixth_power=0.03)
    fx, fy, cx, cy = lens.intrinsics
    points = np.random.default_rng(3).uniform([-0.4, -0.3, 0.9], [0.4, 0.3, 1.1], (50, 3))
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([*lens.distortion, 0.03]))
    found, _ = lens.project(points)
    assert np.allclose(found, expected[:, 0], atol=1e-9)
