"""Agreement of stretches about the lens: silent on clean data, and the right size when stretches differ."""

import cv2
import numpy as np
import pytest

from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.noise.lens_agreement import LensAgreement

LENS = np.array([500.0, 500.0, 320.0, 240.0, -0.2, 0.05, 0.0, 0.0])
SIZE = np.array([1.0, 1.0, 1.0, 1.0, 1e-2, 2e-2, 1e-3, 1e-3])  # what one image of unit noise says, roughly


def camera_of(lens, **changes):
    """A camera of this lens."""
    return CameraState(np.eye(3), np.zeros(3), 0.0, lens[:4], lens[4:], "radtan", (640, 480), **changes)


def run(rng, scatter, stretches=12, images=lambda stretch: 6):
    """Linear images whose lens changes from stretch to stretch; returns factors and error of the mean."""
    agreement = LensAgreement()
    information, weighted = np.zeros((8, 8)), np.zeros(8)
    for stretch in range(stretches):
        lens = LENS + scatter * SIZE * rng.standard_normal(8)
        for k in range(images(stretch)):
            by_lens = rng.standard_normal((60, 8)) / SIZE
            by_pose = rng.standard_normal((60, 6))
            pose = 50.0 * rng.standard_normal(6)  # an innovation also holds an error of the pose
            innovation = by_lens @ (lens - LENS) + by_pose @ pose + rng.standard_normal(60)
            agreement.learn(5.0 * stretch + 0.3 * k, innovation, by_pose, by_lens, camera_of(LENS))
            Q = np.linalg.qr(by_pose)[0]
            J = by_lens - Q @ (Q.T @ by_lens)
            information += J.T @ J
            weighted += J.T @ innovation
    agreement.learn(5.0 * stretches, innovation, by_pose, by_lens, camera_of(LENS))
    covariance = np.linalg.inv(information)
    return agreement.factors, covariance @ weighted / np.sqrt(np.diag(covariance))


def test_clean_stretches_cost_nothing():
    rng = np.random.default_rng(1)
    factors = np.array([run(rng, 0.0)[0] for _ in range(40)])
    assert (factors >= 1.0).all()
    assert (factors > 1.0).mean() < 0.05
    assert (factors > 1.0).any(axis=1).mean() < 0.06  # by chance: one set in a hundred


@pytest.mark.parametrize("stretches", [3, 4, 7])
def test_few_stretches_that_tell_unequally_much_cost_nothing_either(stretches):
    rng = np.random.default_rng(5)
    many = rng.permutation([1, 16, 4, 2, 8, 1, 6])
    found = [run(rng, 0.0, stretches, lambda k: many[k])[0] for _ in range(60)]
    assert (np.array(found) > 1.0).any(axis=1).mean() < 0.06


def test_stretches_that_differ_are_believed_as_little_as_they_deserve():
    rng = np.random.default_rng(2)
    runs = [run(rng, 0.4) for _ in range(50)]
    z = np.array([error for _, error in runs])
    honest = z / np.sqrt([factors for factors, _ in runs])
    assert (np.abs(z) < 3.0).mean() < 0.75  # taken at its word the filter would be wrong
    assert (np.abs(honest) < 3.0).mean() > 0.97
    assert 0.4 < np.sqrt((honest**2).mean()) < 1.15


def test_two_stretches_are_not_enough_to_say_anything():
    factors, _ = run(np.random.default_rng(3), 1.0, stretches=2)
    np.testing.assert_array_equal(factors, 1.0)


def test_memory_is_bounded():
    agreement = LensAgreement()
    rng = np.random.default_rng(4)
    for k in range(300):
        J, P = rng.standard_normal((20, 8)), rng.standard_normal((20, 6))
        agreement.learn(5.0 * k, rng.standard_normal(20), P, J, camera_of(LENS))
    assert len(agreement._stretches._done) <= 40
    assert np.isfinite(agreement.factors).all()


def images_of(rng, lens, k3, reach, count=60):
    """Images of a lens with one more coefficient than the model has, seen by OpenCV."""
    K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
    D = np.array([*lens[4:], 0.0])
    beyond = D.copy()
    beyond[4] = k3
    for _ in range(count):
        points = np.column_stack([rng.uniform(-reach, reach, (50, 2)), rng.uniform(0.9, 1.4, 50)])
        none = np.zeros(3)
        uv, J = cv2.projectPoints(points, none, none, K, D)
        seen = cv2.projectPoints(points, none, none, K, beyond)[0]
        noise = 0.2 * rng.standard_normal(100)
        yield ((seen - uv).ravel() + noise) / 0.2, J[:, :6] / 0.2, J[:, 6:14] / 0.2


@pytest.mark.parametrize("reach", [0.5, 0.7])
def test_a_lens_with_one_more_coefficient_is_known_as_well_as_that_leaves_it(reach):
    rng = np.random.default_rng(6)
    lens = np.array([460.0, 458.0, 367.0, 248.0, -0.30, 0.12, 4e-4, -2e-4])
    agreement = LensAgreement()
    information, weighted = np.zeros((8, 8)), np.zeros(8)
    for k, (innovation, by_pose, by_lens) in enumerate(images_of(rng, lens, -0.05, reach)):
        agreement.learn(0.6 * k, innovation, by_pose, by_lens, camera_of(lens))
        Q = np.linalg.qr(by_pose)[0]
        J = by_lens - Q @ (Q.T @ by_lens)
        information += J.T @ J
        weighted += J.T @ innovation
    P = np.linalg.inv(information)
    error, sigma = P @ weighted, np.sqrt(np.diag(P))
    radial = np.abs(error / sigma)[[4, 5]]
    assert (radial > 5.0).all()  # four coefficients alone are far from the truth, sure of themselves
    reported = np.hypot(np.sqrt(agreement.factors) * sigma, agreement.moved)
    assert (np.abs(error) < 3.0 * reported).all()
    size = reported[[4, 5]] / np.abs(error)[[4, 5]]
    assert ((size > 0.6) & (size < 1.6)).all()  # of the size that the error has


def test_a_lens_of_the_model_is_left_alone():
    rng = np.random.default_rng(7)
    lens = np.array([460.0, 458.0, 367.0, 248.0, -0.30, 0.12, 4e-4, -2e-4])
    for _ in range(10):
        agreement = LensAgreement()
        for k, (innovation, by_pose, by_lens) in enumerate(images_of(rng, lens, 0.0, 0.5)):
            agreement.learn(0.6 * k, innovation, by_pose, by_lens, camera_of(lens))
        np.testing.assert_array_equal(agreement.moved, 0.0)


def test_corners_in_one_line_say_what_they_can():
    rng = np.random.default_rng(8)
    agreement = LensAgreement()
    for k in range(20):
        by_pose, by_lens = rng.standard_normal((20, 6)), rng.standard_normal((20, 8))
        by_pose[:, 0] = 0.0  # a turn about the line moves no corner
        agreement.learn(1.0 * k, rng.standard_normal(20), by_pose, by_lens, camera_of(LENS))
    assert np.isfinite(agreement.factors).all() and np.isfinite(agreement.moved).all()


def test_a_stretch_that_says_nothing_is_no_evidence():
    rng = np.random.default_rng(9)
    agreement = LensAgreement()
    for stretch in range(8):
        weight = 1e-9 if stretch in (2, 6) else 1.0  # seen from so far that only the pose fits
        for k in range(6):
            by_pose, by_lens = rng.standard_normal((40, 6)), weight * rng.standard_normal((40, 8)) / SIZE
            agreement.learn(
                5.0 * stretch + 0.5 * k, rng.standard_normal(40), by_pose, by_lens, camera_of(LENS)
            )
    np.testing.assert_array_equal(agreement.factors, 1.0)
