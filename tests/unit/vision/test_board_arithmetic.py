"""What the detectors compute, against a second way to compute it."""

import cv2
import numpy as np
import pytest

from vical_daemon.vision.aprilgrid import PASSES, _passes
from vical_daemon.vision.grid_model import _project, _project_with_jacobian, outliers
from vical_daemon.vision.layout import BoardLayout
from vical_daemon.vision.saddle import SaddleImage, pixel_noise
from vical_daemon.vision.tag_code import bit_centres, bit_places
from vical_daemon.vision.target import AprilGrid, Checkerboard

SHAPE = (480, 640)


def test_the_jacobian_is_the_derivative():
    rng = np.random.default_rng(0)
    x = np.vstack([rng.uniform(-1, 1, (2, 12)), np.ones(12)])
    parameters = np.array([0.6, 0.1, 0.05, -0.08, 0.5, 0.1, 0.15, -0.1, -0.2])
    _, J = _project_with_jacobian(parameters, x, SHAPE)
    for k, step in enumerate(np.eye(9) * 1e-6):
        there, back = (_project(parameters + s, x, SHAPE) for s in (step, -step))
        np.testing.assert_allclose(J[k].T, (there - back) / 2e-6, atol=1e-4)


def test_bits_lie_where_the_homography_of_the_corners_puts_them():
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    quads = np.array([[[10, 90], [80, 70], [95, 12], [20, 8]], [[5, 50], [50, 50], [50, 5], [5, 5]]], float)
    for quad, places in zip(quads, bit_places(quads), strict=True):
        H = cv2.getPerspectiveTransform(unit, quad.astype(np.float32))
        np.testing.assert_allclose(places, cv2.perspectiveTransform(bit_centres()[None], H)[0], atol=1e-3)


@pytest.mark.parametrize("sigma_dn", [1.0, 2.5, 8.0])
def test_pixel_noise_is_that_of_the_pixels(sigma_dn):
    ramp = np.linspace(40, 200, 640)[None] + np.linspace(0, 30, 480)[:, None]
    noisy = ramp + np.random.default_rng(1).normal(0, sigma_dn, SHAPE)
    estimate = pixel_noise(np.clip(np.round(noisy), 0, 255).astype(np.uint8))
    assert estimate == pytest.approx(np.hypot(sigma_dn, 0.29), rel=0.06)


@pytest.mark.parametrize("board", [AprilGrid(3, 2, 0.05, 0.3), Checkerboard(5, 4, 0.03, 0.02)])
def test_axes_are_the_pixels_of_a_metre(board):
    layout = BoardLayout.of(board)
    axes = np.array([[900.0, 200.0], [-100.0, 800.0]])  # pixels of a metre along x, along y
    uv = layout.xy_m @ axes + [100, 200]
    np.testing.assert_allclose(layout.steps.axes_px(uv), np.broadcast_to(axes, (len(uv), 2, 2)))


def picture_of(places, shape):
    """A corner with its four sectors at each place, shape (n, 2), px."""
    v, u = np.indices(shape).astype(float)
    picture = 120 + sum(
        90 * np.tanh((u - a) / 0.9) * np.tanh((v - b) / 0.9) * (np.hypot(u - a, v - b) < 25)
        for a, b in places
    )
    return np.round(picture).astype(np.uint8)


def test_corners_with_windows_of_several_sizes_are_refined_together():
    """One batch gives what each corner gives alone."""
    places = np.array([[50.3, 40.7], [120.6, 40.2], [50.8, 110.1], [120.1, 110.9]])
    image = SaddleImage(picture_of(places, (160, 200)))
    radius = np.array([2.0, 3.4, 5.0, 9.0])
    together = image.refine(places + 0.6, radius)
    assert together.ok.all()
    assert np.abs(together.uv_px - places).max() < 0.02
    for k in range(4):
        alone = image.refine(places[k : k + 1] + 0.6, radius[k : k + 1])
        np.testing.assert_allclose(together.uv_px[k], alone.uv_px[0], atol=2e-3)
        assert together.sigma_px[k] == pytest.approx(alone.sigma_px[0], rel=0.02)


def test_a_part_of_a_picture_gives_the_same_corners_as_the_whole():
    places = np.array([[150.3, 140.7], [220.6, 140.2], [150.8, 210.1], [40.0, 40.0]])
    picture = picture_of(places, (260, 300))
    whole, part = SaddleImage(picture), SaddleImage(picture, places[:3])
    assert part.smooth.size < 0.5 * whole.smooth.size
    a, b = (image.refine(places + 0.6, np.full(4, 5.0)) for image in (whole, part))
    np.testing.assert_allclose(a.uv_px[:3], b.uv_px[:3], atol=1e-5)
    np.testing.assert_allclose(a.sigma_px[:3], b.sigma_px[:3], rtol=1e-5)
    assert a.ok.all()
    assert b.ok.tolist() == [True, True, True, False]  # the last one is not in the part
    np.testing.assert_allclose(whole.levels(places[:3]), part.levels(places[:3]), atol=1e-3)


@pytest.mark.parametrize("place", [(-500.0, 20.0), (40.0, 1e6)])
def test_a_board_expected_beyond_the_picture_has_no_corners(place):
    image = SaddleImage(picture_of([(50.0, 40.0)], (80, 100)), np.array([place]))
    assert not image.refine(np.array([place, (50.0, 40.0)]), np.full(2, 4.0)).ok.any()


def test_every_pass_has_its_turn_while_there_is_no_board():
    for width in (320, 640, 1280):
        first = _passes(width, 0)
        assert first[-len(PASSES) :] == list(PASSES)
        later = [_passes(width, misses) for misses in range(1, len(PASSES) + 1)]
        assert {passes[-1] for passes in later} == set(PASSES)
        assert all(passes[:-1] == first[: -len(PASSES)] for passes in later)


def test_points_that_a_model_predicts_at_infinity_do_not_belong():
    layout = BoardLayout.of(Checkerboard(5, 4, 0.1, 0.1))
    residual = np.random.default_rng(1).normal(0.0, 0.05, (len(layout.xy_m), 2))
    far = layout.xy_m[:, 0] < 0.25  # most of the board: so far are most of their neighbours, too
    residual[far] = np.inf
    assert outliers(residual, np.ones(len(residual), bool), layout.neighbours)[far].all()
