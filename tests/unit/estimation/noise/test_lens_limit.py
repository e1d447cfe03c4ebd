"""No data make a lens better known than detectors allow."""

import cv2
import numpy as np
import pytest

from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.noise.lens_limit import limit

LENSES = {
    "radtan": (520.0, [-0.28, 0.07, 2e-4, -1e-4]),
    "plumb_bob": (520.0, [-0.28, 0.07, 2e-4, -1e-4, 0.01]),
    "equidistant": (300.0, [0.01, -0.005, 0.002, -0.001]),
}


def camera(model, focal_px, distortion, size=(640, 480)):
    K = np.array([focal_px, focal_px, size[0] / 2 + 3.0, size[1] / 2 - 2.0])
    return CameraState(np.eye(3), np.zeros(3), 0.0, K, np.array(distortion), model, size)


def opencv(values, points, model):
    K, D = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1.0]]), values[4:]
    nothing = np.zeros(3)
    if model == "equidistant":
        return cv2.fisheye.projectPoints(points[:, None], nothing, nothing, K, D)[0][:, 0]
    return cv2.projectPoints(points, nothing, nothing, K, D)[0][:, 0]


@pytest.mark.parametrize("model", LENSES)
def test_it_is_what_a_fit_to_patches_that_are_off_leaves_open(model):
    c = camera(model, *LENSES[model])
    u, v = np.meshgrid(40.0 + 80.0 * np.arange(8), 40.0 + 80.0 * np.arange(6))
    at = np.column_stack([(u.ravel() - 323.0), (v.ravel() - 238.0)]) / c.intrinsics[0]
    values = np.concatenate([c.intrinsics, c.distortion])
    rays = at.copy()
    for _ in range(100):  # undo the distortion
        seen = opencv(values, np.column_stack([rays, np.ones(48)]), model)
        rays += 0.5 * (at - (seen - values[2:4]) / values[:2])
    points = np.column_stack([rays, np.ones(48)])
    step = 1e-6 * np.r_[np.full(4, 100.0), np.ones(len(values) - 4)]
    J = np.column_stack(
        [
            (opencv(values + d, points, model) - opencv(values - d, points, model)).ravel() / (2.0 * s)
            for d, s in zip(np.diag(step), step, strict=True)
        ]
    )
    off = 0.003 * np.random.default_rng(1).standard_normal((96, 4000))
    spread = (np.linalg.pinv(J) @ off).std(axis=1)
    assert limit(c) == pytest.approx(spread, rel=0.05)


def test_a_larger_picture_of_the_same_lens_has_a_smaller_limit_by_angle():
    small = limit(camera("radtan", *LENSES["radtan"]))
    large = limit(camera("radtan", 1040.0, LENSES["radtan"][1], (1280, 960)))
    assert large[0] / 1040.0 == pytest.approx(0.5 * small[0] / 520.0, rel=0.05)
    assert large[4] == pytest.approx(0.5 * small[4], rel=0.05)


def test_a_lens_without_rays_has_no_limit():
    """Of a filter that has lost its way: nothing is raised."""
    assert np.isfinite(limit(camera("equidistant", 1.0, [0.5, -3.0, 5.0, -2.0]))).all()
