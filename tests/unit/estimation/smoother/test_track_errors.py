"""Sigmas of a window by its tracks, against the scatter of what it finds with errors drawn anew."""

import numpy as np
import pytest

from tests.unit.estimation.smoother.test_target_free_parts import Scene, bundle_of
from tests.unit.estimation.some_layout import POSE_AND_CLOCK
from vical_daemon.estimation.smoother.normal import ImageNoise
from vical_daemon.estimation.smoother.track_errors import with_track_errors

DRAWS = 80  # a variance is known to 16 % then
MEMORY = 0.97  # from image to image, 20 of them a second


def drawn(rng, seen, memory):
    """Errors of unit variance, alike from image to image along each track, shape (N, 2)."""
    e = rng.standard_normal((len(seen.frame), 2))
    for k in np.flatnonzero(np.diff(seen.landmark) == 0):
        e[k + 1] = memory * e[k] + np.sqrt(1.0 - memory**2) * e[k + 1]
    return e


def scatter(bundle, memory):
    """Of lever arm and mounting: the variance of what is found, and the mean of what is added."""
    rng, problem, view, order = np.random.default_rng(6), bundle.problem, bundle.view, bundle.problem.order()
    at = order.constants[len(order.imu) :][:6]
    found, added = [], []
    for draw in range(DRAWS):
        uv = view.uv + problem.noise.sigma_px * drawn(rng, view.seen, memory)
        seen = view._replace(seen=view.seen._replace(uv=uv))
        normal = problem.normal(seen)
        found.append(bundle._step(normal, 0.0, settle=False).states[at])
        if draw % 4 == 0:
            root = bundle._root(normal)
            L = np.tril(root[order.tail :, order.tail :])
            covariance = np.linalg.inv(L @ L.T)
            more = np.diag(with_track_errors(covariance, problem, seen.seen, normal, root) - covariance)
            assert not np.delete(more, at - order.tail).any()  # motion, biases, time shift and drift
            added.append(more[at - order.tail])
    return np.var(found, axis=0, ddof=1), np.mean(added, axis=0)


@pytest.fixture(scope="module")
def adjusted():
    scene = Scene()
    bundle = bundle_of(scene.window(), POSE_AND_CLOCK, 1.0)
    assert bundle.solve(scene.buffer, 25) is not None
    bundle.problem.noise = ImageNoise(0.5)
    return bundle


@pytest.fixture(scope="module")
def white(adjusted):
    return scatter(adjusted, 0.0)


def test_errors_that_last_widen_each_sigma_by_what_they_do_to_it(adjusted, white):
    """Three times the variance of the mounting."""
    lasting, added = scatter(adjusted, MEMORY)
    assert np.mean(added / (lasting - white[0])) == pytest.approx(1.0, abs=0.2)
    assert (added / white[0])[3:6].max() > 1.2


def test_errors_that_do_not_last_leave_sigmas_as_they_are(white):
    variance, added = white
    assert (added < 0.15 * variance).all()
