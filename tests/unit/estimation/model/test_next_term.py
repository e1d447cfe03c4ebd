"""What is reported of a lens that is estimated with one term more than its model has."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from vical_daemon.estimation.geometry.camera_model import project
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.model.next_term import onto_model, reported_camera
from vical_daemon.estimation.model.state import CameraState

LENS = np.array([460.0, 458.0, 367.0, 248.0, -0.30, 0.12, 4e-4, -2e-4, -0.02])
STEP = np.array([1e-3] * 4 + [1e-6] * 4)
CAMERA = CameraState(np.eye(3), np.zeros(3), 0.0, LENS[:4], LENS[4:], "plumb_bob", (752, 480), term=True)


def points_and_information(reach, count=400):
    """Points in view, and J'J of them over a noise of 0.2 px by OpenCV's derivatives, shape (9, 9)."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-reach, reach, (count, 2)), rng.uniform(0.9, 1.4, count)])
    K = np.array([[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1.0]])
    J = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, LENS[4:])[1][:, 6:15] / 0.2
    return points, J.T @ J


@pytest.mark.parametrize("reach", [0.4, 0.6])
def test_it_is_the_lens_that_projects_what_was_seen_nearest(reach):
    points, seen = points_and_information(reach)
    uv = project(points, LENS[:4], LENS[4:], "plumb_bob")

    def off(lens):
        return (project(points, lens[:4], lens[4:], "radtan") - uv).ravel()

    found = reported_camera(CAMERA, onto_model(CAMERA, seen))
    lens = np.concatenate([found.intrinsics, found.distortion])
    assert (found.distortion_model, found.term, len(lens)) == ("radtan", False, 8)
    without = np.sqrt((off(LENS[:8]) ** 2).mean())
    assert np.sqrt((off(lens) ** 2).mean()) < 0.15 * without
    J = np.column_stack([(off(lens + d) - off(lens - d)) / (2.0 * d.sum()) for d in np.diag(STEP)])
    rest = np.linalg.lstsq(J, -off(lens), rcond=None)[0]  # what the best radtan lens is away, to first order
    assert np.sqrt(((J @ rest) ** 2).mean()) < 0.1 * without


def test_without_points_it_is_that_over_the_image_and_a_lens_without_a_term_is_left_alone():
    points, _ = points_and_information(0.8)
    found = reported_camera(CAMERA, onto_model(CAMERA, np.zeros((1, 1))))
    uv = project(points, LENS[:4], LENS[4:], "plumb_bob")
    assert np.abs(project(points, found.intrinsics, found.distortion, "radtan") - uv).max() < 0.5
    plain = replace(CAMERA, term=False)
    assert reported_camera(plain, onto_model(plain, np.zeros((1, 1)))) is plain


@pytest.mark.parametrize("model", ["radtan", "plumb_bob", "equidistant"])
def test_only_a_radtan_lens_gets_a_term(model):
    given = CameraPrior((640, 480), (500.0, 500.0, 320.0, 240.0), model)
    prior = given.with_next_term()
    assert prior.term is (model == "radtan")
    assert len(prior.coefficients()) == {"radtan": 5, "plumb_bob": 5, "equidistant": 4}[model]
    assert prior.term or prior is given


@pytest.mark.parametrize(
    ("model", "change", "line"),
    [
        ("plumb_bob", {"distortion": (0.1,) * 4}, "distortion: expected 5 values .*, found 4$"),
        ("radtan", {"distortion": (0.1,) * 5}, "distortion: expected 4 .* found 5; .* is plumb_bob"),
        ("equidistant", {"distortion_sigma": (0.1,)}, "distortion_sigma: expected 4 values"),
        ("omni", {}, "unknown distortion model 'omni'"),
    ],
)
def test_a_lens_with_a_wrong_number_of_coefficients_is_refused_where_it_is_given(model, change, line):
    with pytest.raises(ValueError, match=line):
        CameraPrior((640, 480), distortion_model=model, **change)
