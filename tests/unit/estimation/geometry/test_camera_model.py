"""camera_model.py and camera_rays.py against OpenCV and finite differences."""

import cv2
import numpy as np
import pytest

from vical_daemon.estimation.geometry import camera_model as cm
from vical_daemon.estimation.model import camera_rays as cr

K = np.array([458.6, 457.3, 367.2, 248.4])
D_RADTAN = np.array([-0.2834, 0.0739, 0.00019, 1.76e-05])
D_PLUMB_BOB = np.array([-0.3244, 0.1537, 9e-5, 5e-5, -0.0415])
D_FISHEYE = np.array([-0.013, 0.021, -0.015, 0.004])
LENSES = [(cm.RADTAN, D_RADTAN), (cm.PLUMB_BOB, D_PLUMB_BOB), (cm.EQUIDISTANT, D_FISHEYE)]
KM = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])


def _points(n=300, spread=0.7):
    rng = np.random.default_rng(5)
    z = rng.uniform(0.3, 4.0, n)
    xy = rng.uniform(-spread, spread, (n, 2)) * z[:, None]
    xy[0] = 0.0
    return np.column_stack((xy, z))


def _opencv(points, model, D):
    zero = np.zeros(3)
    if model != cm.EQUIDISTANT:
        return cv2.projectPoints(points, zero, zero, KM, D)[0][:, 0]
    return cv2.fisheye.projectPoints(points[:, None], zero, zero, KM, D)[0][:, 0]


@pytest.mark.parametrize(("model", "D"), LENSES)
def test_projection_agrees_with_opencv(model, D):
    points = _points()
    np.testing.assert_allclose(cm.project(points, K, D, model), _opencv(points, model, D), atol=1e-9)


@pytest.mark.parametrize(("model", "D"), LENSES)
def test_unproject_inverts_project_to_machine_precision(model, D):
    points = _points(spread=3.0 if model == cm.EQUIDISTANT else 0.95)
    rays, ok = cr.unproject(cm.project(points, K, D, model), K, D, model)
    assert ok.all()
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-12)
    xy, ok = cr.undistort(cm.project(points, K, D, model), K, D, model)
    assert ok.all()
    np.testing.assert_allclose(xy, points[:, :2] / points[:, 2:], atol=1e-11)


@pytest.mark.parametrize(("model", "D"), LENSES)
def test_jacobians_by_finite_differences(model, D):
    points = _points(40)
    uv, J_point, J_camera = cm.project_jacobians(points, K, D, model)
    np.testing.assert_allclose(uv, cm.project(points, K, D, model), atol=1e-10)
    h = 1e-6
    for i in range(3):
        step = h * np.eye(3)[i]
        numeric = (cm.project(points + step, K, D, model) - cm.project(points - step, K, D, model)) / (2 * h)
        np.testing.assert_allclose(J_point[..., i], numeric, rtol=1e-6, atol=2e-5)
    n = 4 + len(D)
    assert J_camera.shape[-1] == n
    for i in range(n):
        step = h * np.eye(n)[i]
        numeric = (
            cm.project(points, K + step[:4], D + step[4:], model)
            - cm.project(points, K - step[:4], D - step[4:], model)
        ) / (2 * h)
        np.testing.assert_allclose(J_camera[..., i], numeric, rtol=1e-6, atol=2e-5)


@pytest.mark.parametrize(("model", "D"), LENSES)
def test_sigma_points_broadcast_in_one_call(model, D):
    rng = np.random.default_rng(8)
    points = _points(12)[None] + rng.normal(0, 0.01, (5, 12, 3))
    Ks = K + rng.normal(0, 2, (5, 1, 4))
    Ds = D + rng.normal(0, 0.001, (5, 1, len(D)))
    uv = cm.project(points, Ks, Ds, model)
    assert uv.shape == (5, 12, 2)
    np.testing.assert_allclose(uv[3, 7], cm.project(points[3, 7], Ks[3, 0], Ds[3, 0], model))
    assert cm.project_jacobians(points, Ks, Ds, model)[2].shape == (5, 12, 2, 4 + len(D))
    rays, ok = cr.unproject(uv, Ks, Ds, model)
    assert ok.all() and rays.shape == (5, 12, 3)


def test_what_a_pinhole_cannot_see_is_not_a_number():
    uv = cm.project(np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [0.1, 0.2, 1.0]]), K, D_RADTAN)
    assert np.isnan(uv[:2]).all() and np.isfinite(uv[2]).all()


def test_a_fisheye_sees_behind_its_image_plane():
    point = np.array([[1.0, 0.2, -0.3]])
    rays, ok = cr.unproject(cm.project(point, K, D_FISHEYE, cm.EQUIDISTANT), K, D_FISHEYE, cm.EQUIDISTANT)
    assert ok.all()
    np.testing.assert_allclose(rays, point / np.linalg.norm(point), atol=1e-12)
    xy, ok = cr.undistort(cm.project(point, K, D_FISHEYE, cm.EQUIDISTANT), K, D_FISHEYE, cm.EQUIDISTANT)
    assert not ok.any() and np.isnan(xy).all()


def test_pixels_that_no_ray_reaches_are_refused():
    D = np.array([-0.3, 0.0, 0.0, 0.0])
    limit = cr.valid_radius(D)
    assert limit == pytest.approx(np.sqrt(1 / 0.9))
    edge = limit * (1 - 0.3 * limit**2)
    uv = np.array([[K[2] + K[0] * edge * 1.05, K[3]], [K[2] + K[0] * edge * 0.97, K[3]]])
    rays, ok = cr.unproject(uv, K, D)
    assert ok.tolist() == [False, True] and np.isnan(rays[0]).all()
    assert np.isinf(cr.valid_radius(np.array([0.1, 0.0, 0, 0])))
    assert np.isinf(cr.valid_radius(np.zeros(4)))


@pytest.mark.parametrize("tangential", [0.0, 2e-3])
def test_pixels_that_no_ray_reaches_do_not_hold_up_the_others(monkeypatch, tangential):
    steps, derivative = [], cr.radtan_derivative
    monkeypatch.setattr(cr, "radtan_derivative", lambda *args: steps.append(args) or derivative(*args))
    K, D = np.array([460.0, 460.0, 365.0, 249.0]), np.array([-0.335, 0.192, tangential, -tangential, -0.079])
    pixels = np.array([[1500.0, 249.0], [300.0, 200.0], [365.0, 249.0]])
    rays, ok = cr.unproject(pixels, K, D, cm.PLUMB_BOB)
    assert ok.tolist() == [False, True, True]
    np.testing.assert_allclose(cm.project(rays[1:], K, D, cm.PLUMB_BOB), pixels[1:], atol=1e-9)
    assert len(steps) < 10


def test_the_fifth_coefficient_moves_the_fold():
    r = cr.valid_radius(D_PLUMB_BOB)
    across = np.linspace(0.0, r, 1000)[:, None] * [1.0, 0.0]
    radius = cm.distort(across, D_PLUMB_BOB * [1, 1, 0, 0, 1])[:, 0]
    assert (np.diff(radius) > 0).all() and radius[-1] - radius[-2] < 1e-5
    assert np.isinf(cr.valid_radius(np.array([0.1, 0.0, 0, 0, 0.1])))


def test_an_unknown_model_is_named():
    with pytest.raises(ValueError, match="radtan or plumb_bob or equidistant"):
        cm.project(np.ones(3), K, D_RADTAN, "fov")
