"""Windows are found again although they were turned, scaled, sheared, and lit in another way."""

import cv2
import numpy as np
import pytest

from vical_daemon.vision.patches import Templates, no_templates
from vical_daemon.vision.saddle import SMOOTHING_PX

CENTRES_PX = np.array([[60.0, 60.0], [100.0, 60.0], [60.0, 100.0], [100.0, 100.0]])


@pytest.fixture(scope="module")
def scene():
    """Corners of overlapping patches, at eight pixels a pixel, and where they are."""
    rng = np.random.default_rng(4)
    fine = np.full((1280, 1280), 120.0, np.float32)
    for centre in CENTRES_PX:
        for _ in range(4):
            at = (centre + rng.uniform(-4, 4, 2) + 0.5) * 8
            box = cv2.boxPoints((at.tolist(), rng.uniform(24, 72, 2).tolist(), float(rng.uniform(0, 180))))
            cv2.fillConvexPoly(fine, np.round(box).astype(np.int32), float(rng.uniform(20, 235)))
    return cv2.GaussianBlur(fine, (0, 0), 8.0)


def picture(scene, W=None, gain=1.0, offset=0.0):
    """The scene at the size of its pixels, mapped by x -> c + W (x - c), c = (80, 80)."""
    W = np.eye(2) if W is None else W
    v, u = np.mgrid[:160, :160].astype(np.float64)
    source = np.stack([u - 80, v - 80], axis=-1) @ np.linalg.inv(W).T + 80
    fine = ((source + 0.5) * 8 - 0.5).astype(np.float32)
    return gain * cv2.remap(scene, fine[..., 0], fine[..., 1], cv2.INTER_LINEAR) + np.float32(offset)


def mapped(W):
    return (CENTRES_PX - 80) @ W.T + 80


def test_turned_scaled_and_sheared_windows_in_other_light(scene):
    templates = Templates.cut(picture(scene), CENTRES_PX)
    turn, shear = np.deg2rad(12.0), np.array([[1.15, 0.08], [-0.03, 0.9]])
    goal = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ shear
    uv, W = CENTRES_PX, np.broadcast_to(np.eye(2), (4, 2, 2))
    for share in [*np.linspace(0.1, 1.0, 10), 1.0, 1.0]:  # as in twelve images
        now = np.eye(2) + share * (goal - np.eye(2))
        uv, W, unlike, sigma = templates.align(picture(scene, now, 0.7, 25.0), mapped(now) + 0.4, W)
    assert np.linalg.norm(uv - mapped(goal), axis=1).max() < 0.08
    assert np.abs(W - goal).max() < 0.03
    assert unlike.max() < 0.1 and sigma.max() < 0.05


def test_a_window_of_one_grey_level_moves_nowhere():
    plain = np.full((160, 160), 90.0, np.float32)
    uv, W, unlike, _ = Templates.cut(plain, CENTRES_PX).align(
        plain, CENTRES_PX, np.broadcast_to(np.eye(2), (4, 2, 2))
    )
    assert np.array_equal(uv, CENTRES_PX)
    assert np.allclose(W, np.eye(2)) and np.isfinite(unlike).all()


def test_another_part_of_the_scene_is_unlike(scene):
    image = picture(scene)
    templates = Templates.cut(image, CENTRES_PX)
    _, _, unlike, _ = templates.align(image, CENTRES_PX[[1, 2, 3, 0]], np.broadcast_to(np.eye(2), (4, 2, 2)))
    assert unlike.min() > 0.45  # `TrackOptions.unlike`


def test_sets_are_cut_and_joined(scene):
    templates = Templates.cut(picture(scene), CENTRES_PX)
    back = no_templates().joined(templates.take(np.array([0, 1]))).joined(templates.take(np.array([2, 3])))
    for name in ("values", "slopes", "inverse"):
        assert np.array_equal(getattr(back, name), getattr(templates, name))


def test_the_stated_sigma_is_that_of_smoothed_noise(scene):
    rng, clean, upright = np.random.default_rng(3), picture(scene), np.broadcast_to(np.eye(2), (4, 2, 2))

    def seen():
        noisy = clean + rng.normal(0.0, 6.0, clean.shape).astype(np.float32)
        return cv2.GaussianBlur(noisy, (5, 5), SMOOTHING_PX)

    errors, sigmas = [], []
    for _ in range(60):
        uv, _, _, sigma = Templates.cut(seen(), CENTRES_PX).align(seen(), CENTRES_PX, upright)
        errors.append(uv - CENTRES_PX)
        sigmas.append(sigma)
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(sigmas)))
    assert 0.75 < ratio < 1.25  # 480 numbers; 2.6 if neighbouring pixels were taken to be independent
