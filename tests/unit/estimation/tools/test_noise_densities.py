"""Allan analysis: the published reference values, the model's coefficients and their sigmas."""

import numpy as np
import pytest

from vical_daemon.estimation.tools import noise_densities as noise


def nbs14(count: int) -> np.ndarray:
    """The generator of NBS Monograph 140 / NIST SP 1065: n -> 16807 n mod (2^31 - 1)."""
    numbers = [1234567890]
    while len(numbers) < count:
        numbers.append(16807 * numbers[-1] % 2147483647)
    return np.array(numbers) / 2147483647.0


def test_nbs14_reference_values_of_the_overlapping_deviation():
    found = noise.allan_deviation(nbs14(1000), 1.0, np.array([1, 10, 100]))
    assert found == pytest.approx([0.2922319, 0.09159953, 0.03241343], rel=5e-7)


def test_overlapping_deviation_equals_its_definition():
    rng = np.random.default_rng(3)
    signal, m = rng.standard_normal(400), 7
    means = np.array([signal[i : i + m].mean() for i in range(len(signal) - m + 1)])
    brute = np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2))
    assert noise.allan_deviation(signal, 50.0, np.array([m]))[0] == pytest.approx(brute, rel=1e-9)


def simulate(rng, n, rate, density, walk):
    white = density * np.sqrt(rate) * rng.standard_normal(n)
    return white + np.cumsum(walk / np.sqrt(rate) * rng.standard_normal(n))


def test_white_noise_and_walk_are_found_within_their_sigmas():
    rng = np.random.default_rng(11)
    density, walk = 5e-4, 6e-5
    scores = []
    for _ in range(12):
        fit = noise.fit_noise(noise.allan_curve(simulate(rng, 120_000, 50.0, density, walk), 50.0))
        scores.append(
            [(fit.density.value - density) / fit.density.sigma, (fit.walk.value - walk) / fit.walk.sigma]
        )
        assert fit.density.sigma < 0.02 * density
    scores = np.array(scores)
    assert np.abs(scores).max() < 4.0
    assert (scores**2).mean() < 2.5


def test_walk_that_does_not_show_is_zero_with_an_upper_bound():
    rng = np.random.default_rng(5)
    fit = noise.fit_noise(noise.allan_curve(simulate(rng, 20_000, 100.0, 1e-3, 0.0), 100.0))
    assert fit.walk.value < 3 * fit.walk.sigma
    assert fit.walk.upper > 0.0
    combined = noise.imu_noise([fit] * 3, [fit] * 3, 100.0)
    assert combined.gyro_walk > 0.0
    assert combined.gyro_density == pytest.approx(1e-3, rel=0.05)


def test_bias_instability_is_the_floor_of_the_curve():
    rng = np.random.default_rng(8)
    curve = noise.allan_curve(simulate(rng, 120_000, 50.0, 5e-4, 6e-5), 50.0)
    fit = noise.fit_noise(curve)
    assert fit.instability_reached
    # Floor of N^2/tau + K^2 tau/3 lies at tau = sqrt(3) N/K with variance 2 N K / sqrt(3).
    assert fit.instability_tau_s == pytest.approx(np.sqrt(3) * 5e-4 / 6e-5, rel=0.6)
    expected = np.sqrt(2 * 5e-4 * 6e-5 / np.sqrt(3)) / np.sqrt(2 * np.log(2) / np.pi)
    assert fit.instability.value == pytest.approx(expected, abs=4 * fit.instability.sigma)
    assert fit.model_adev(curve.tau_s)[10] == pytest.approx(curve.adev[10], rel=0.05)


def test_quantisation_is_told_from_white_noise():
    rng = np.random.default_rng(9)
    step, rate = 0.02, 100.0
    # Quantised angle: its derivative is the rate; Q = step / sqrt(12).
    angle = (
        np.round(
            np.cumsum(1e-4 * np.sqrt(rate) / rate * rng.standard_normal(200_000)) / step
            + rng.uniform(-0.5, 0.5, 200_000)
        )
        * step
    )
    fit = noise.fit_noise(noise.allan_curve(np.diff(angle) * rate, rate))
    assert fit.quantisation.value > 10 * fit.quantisation.sigma
    assert fit.quantisation.value == pytest.approx(step / np.sqrt(12), rel=0.5)


def test_too_short_is_said():
    with pytest.raises(noise.TooShortError, match="at least 100 samples"):
        noise.allan_curve(np.zeros(20), 100.0)
    with pytest.raises(noise.TooShortError, match="record longer"):
        noise.fit_noise(noise.allan_curve(np.random.default_rng(0).standard_normal(150), 100.0))
