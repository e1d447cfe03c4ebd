"""Projection uncertainty against exact projections of samples; conditional sigmas against information."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS, project
from vical_daemon.estimation.model.camera_rays import unproject
from vical_daemon.estimation.tools.projection_uncertainty import (
    lens_names,
    over_image,
    projection_sigma_px,
    sigma_if_known,
)

LENSES = {
    "radtan": [-0.28, 0.07, 2e-4, 1e-4],
    "plumb_bob": [-0.28, 0.07, 2e-4, 1e-4, 0.01],
    "equidistant": [-0.02, 0.01, -0.004, 0.001],
}
K = np.array([460.0, 457.0, 367.0, 248.0])
R, P = Rotation.from_euler("zyx", [89, 1, 0.2], degrees=True).as_matrix(), np.array([0.08, 0.02, -0.03])


def joint(model):
    order = ["px", "py", "pz", "rx", "ry", "rz", "timeshift", *lens_names(model)]
    sigma = np.array([2e-3] * 3 + [5e-4] * 3 + [1e-5] + [0.4] * 4 + [1e-3] * len(COEFFICIENTS[model]))
    rng = np.random.default_rng(1)
    mixed = rng.standard_normal((len(order), 3 * len(order)))
    correlation = np.corrcoef(mixed)
    return order, correlation * np.outer(sigma, sigma)


@pytest.mark.parametrize("distance_m", [1.0, 3.0, np.inf])
@pytest.mark.parametrize("model", LENSES)
def test_sigma_is_the_spread_of_exact_projections(model, distance_m):
    order, covariance = joint(model)
    D, rng = np.array(LENSES[model]), np.random.default_rng(2)
    uv = np.array([[367.0, 248.0], [60.0, 80.0], [700.0, 400.0]])
    rays, ok = unproject(uv, K, D, model)
    assert ok.all()
    draws = rng.multivariate_normal(np.zeros(len(order)), covariance, 40_000)
    far = 1e7 if np.isinf(distance_m) else distance_m  # the lever arm then moves nothing
    points_imu = far * rays @ R.T + P
    turned = R @ Rotation.from_rotvec(draws[:, 3:6]).as_matrix()
    points = np.einsum("kji,nkj->nki", turned, points_imu[:, None] - (P + draws[:, :3]))
    found = project(points, K + draws[:, 7:11], D + draws[:, 11:], model)
    expected = [np.sqrt(np.linalg.eigvalsh(np.cov(of_one.T))[1]) for of_one in found]
    stated = projection_sigma_px(uv, distance_m, R, K, D, model, order, covariance)
    assert stated == pytest.approx(expected, rel=0.02)


def test_what_is_not_in_the_covariance_counts_as_known():
    order, covariance = joint("radtan")
    D, uv = np.array(LENSES["radtan"]), np.array([[100.0, 100.0]])
    pose = list(range(6))
    alone = projection_sigma_px(uv, 1.0, R, K, D, "radtan", order[:6], covariance[np.ix_(pose, pose)])
    zeroed = covariance.copy()
    zeroed[6:], zeroed[:, 6:] = 0.0, 0.0
    assert alone == pytest.approx(projection_sigma_px(uv, 1.0, R, K, D, "radtan", order, zeroed))


def test_over_the_image_and_beyond_the_lens():
    order, covariance = joint("radtan")
    sigma = over_image((752, 480), 1.0, R, K, np.array(LENSES["radtan"]), "radtan", order, covariance, 20)
    assert sigma.shape == (13, 20)
    assert np.isfinite(sigma).all() and sigma.min() > 0
    strong = np.array([-0.6, 0.05, 0.0, 0.0])  # folds back before the corners
    folded = over_image((752, 480), np.inf, R, K, strong, "radtan", order, covariance)
    assert np.isnan(folded[0, 0]) and np.isfinite(folded[15, 20])


def test_conditional_sigma_equals_that_of_the_information():
    order, covariance = joint("plumb_bob")
    information = np.linalg.inv(covariance)
    lens = lens_names("plumb_bob")
    keep = [i for i, name in enumerate(order) if name not in lens]
    conditional = np.linalg.inv(information[np.ix_(keep, keep)])
    expected = np.sqrt(np.linalg.eigvalsh(conditional[:3, :3])[-1])
    assert sigma_if_known(order, covariance, ["px", "py", "pz"], lens) == pytest.approx(expected, rel=1e-6)
    assert sigma_if_known(order, covariance, ["px", "py", "pz"], []) == pytest.approx(
        np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    )
    assert sigma_if_known(order[:6], covariance[:6, :6], ["timeshift"], lens) == 0.0
