"""Measured corner noise: from whatever guess, to whatever truth."""

import numpy as np
import pytest

from vical_daemon.estimation.noise.corner_noise import CornerNoise, noise_of_image


@pytest.mark.parametrize("guess_px", [0.1, 0.5, 3.0])
@pytest.mark.parametrize("true_px", [0.01, 0.2, 2.0])
def test_the_guess_is_forgotten(guess_px, true_px):
    rng, noise = np.random.default_rng(0), CornerNoise(guess_px)
    for _ in range(200):
        residual = true_px * rng.standard_normal(80) / noise.sigma_px
        noise.learn(float(residual @ residual), 80)
    assert noise.sigma_px == pytest.approx(true_px, rel=0.05)


def test_one_frame_does_not_overthrow_the_guess():
    noise = CornerNoise(0.5)
    noise.learn(0.001, 10)
    assert 0.4 < noise.sigma_px < 0.5
    noise.learn(1.0, 3)  # too few corners to say anything
    assert 0.4 < noise.sigma_px < 0.5


def test_a_change_of_focus_is_followed():
    rng, noise = np.random.default_rng(1), CornerNoise(0.5)
    for true_px in (0.2, 0.6):
        for _ in range(3000):
            residual = true_px * rng.standard_normal(80) / noise.sigma_px
            noise.learn(float(residual @ residual), 80)
        assert noise.sigma_px == pytest.approx(true_px, rel=0.1)


@pytest.mark.parametrize(("true", "low", "high"), [(0.3, 0.3, 0.5), (1.0, 0.9, 1.1), (4.0, 3.6, 4.4)])
def test_an_image_with_many_corners_shows_its_own_noise(true, low, high):
    residual = true * np.random.default_rng(2).standard_normal(250)  # over the usual noise
    assert low < noise_of_image(float(residual @ residual), 250) < high


def test_an_image_with_few_corners_is_taken_as_usual():
    assert noise_of_image(0.0, 0) == 1.0
    assert 0.8 < noise_of_image(1.0, 6) < 1.0


def test_the_noise_of_an_image_costs_little_where_all_are_alike():
    """Weights that scatter by s cost a share of s squared of the information."""
    rng = np.random.default_rng(3)
    for dof in (20, 100, 250):
        weights = [noise_of_image(float(rng.chisquare(dof)), dof) ** -2 for _ in range(2000)]
        assert np.std(weights) / np.mean(weights) < 0.16
