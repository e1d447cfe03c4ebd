"""By how much a lens model misses is found from windows that each have a lens of their own."""

import numpy as np
import pytest

from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.noise.lens_limit import SYSTEMATIC_PX, LensMisfit, limit, patches

CAMERA = CameraState(
    np.eye(3), np.zeros(3), 0.0, np.array([520.0, 520.0, 323.0, 238.0]),
    np.array([-0.28, 0.07, 2e-4, -1e-4]), "radtan", (640, 480),
)  # fmt: skip


def windows(true_px, count, seed):
    """What windows with views of half the image say: lenses that differ by `true_px`, and noise."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        root = patches(CAMERA, rng.random(48) < 0.5)
        own = true_px * np.linalg.solve(root, rng.standard_normal(8))
        half = rng.standard_normal((20, 8)) @ root / 0.02
        information = half.T @ half
        found = own + np.linalg.solve(np.linalg.cholesky(information).T, rng.standard_normal(8))
        yield root, information, information @ found


@pytest.mark.parametrize("true_px", [0.02, 0.1, 0.4])
def test_the_size_of_the_misfit_is_found(true_px):
    misfit = LensMisfit()
    for window in windows(true_px, 12, 1):
        misfit.learn(*window)
    assert misfit.px == pytest.approx(true_px, rel=0.25)  # 96 degrees of freedom: 7 %


def test_a_lens_that_fits_has_the_misfit_that_detectors_leave_open():
    found = []
    for seed in range(20):
        misfit = LensMisfit()
        for window in windows(0.0, 8, seed):
            misfit.learn(*window)
        found.append(misfit.px)
    assert np.median(found) == SYSTEMATIC_PX
    assert max(found) < 0.01


def test_patches_that_a_window_does_not_see_leave_its_lens_open():
    all_seen, left = patches(CAMERA), patches(CAMERA, np.arange(48) % 8 < 4)
    whole, half = (np.linalg.inv(R.T @ R) for R in (all_seen, left))
    np.testing.assert_allclose(SYSTEMATIC_PX * np.sqrt(np.diag(whole)), limit(CAMERA), rtol=1e-9)
    assert np.all(np.diag(half) > 1.5 * np.diag(whole))
