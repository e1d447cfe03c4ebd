"""The Allan deviation and its degrees of freedom: published values, and the covariance written out."""

import sys

import numpy as np
import pytest

from vical_daemon.estimation.tools import noise_densities

PHASE = {2: 0, 0: 1, -1: 1, -2: 2}  # power-law exponent of the rate noise -> integrations from white noise
FINE = 8  # white noise values per sample: a sampled rate is the mean of a continuous one


def rate_filter(alpha: int, count: int) -> np.ndarray:
    """Matrix from independent unit normals to `count` phase points of noise f^alpha."""
    if alpha == 2:
        return np.eye(count)
    fine = np.tril(np.ones((count * FINE, count * FINE)))
    if alpha == -1:  # half an integration more than white: Kasdin's coefficients
        h = np.cumprod(np.r_[1.0, (np.arange(1, count * FINE) - 0.5) / np.arange(1, count * FINE)])
        index = np.arange(count * FINE)
        lag = index[:, None] - index[None, :]
        fine = fine @ np.where(lag >= 0, h[np.maximum(lag, 0)], 0.0)
    elif alpha == -2:
        fine = fine @ fine
    return fine[FINE - 1 :: FINE]


def brute_edf(alpha: int, factor: int, samples: int) -> float:
    """2 mean^2 / variance of the mean square of correlated normals: (tr C)^2 / |C|^2."""
    phase = rate_filter(alpha, samples + 1)
    second = phase[2 * factor :] - 2.0 * phase[factor:-factor] + phase[: -2 * factor]
    covariance = second @ second.T
    return float(np.trace(covariance) ** 2 / np.sum(covariance**2))


@pytest.mark.parametrize("factor", [1, 3, 10, 30, 45])
@pytest.mark.parametrize(("alpha", "tolerance"), [(2, 1e-9), (0, 1e-9), (-1, 0.06), (-2, 0.01)])
def test_degrees_of_freedom_are_those_of_the_covariance(alpha, tolerance, factor):
    found = noise_densities.degrees_of_freedom(np.array([factor]), np.array([alpha]), 120)[0]
    assert found == pytest.approx(brute_edf(alpha, factor, 120), rel=tolerance)


# (alpha, m): Greenhall and Riley's procedure as allantools 2024.6 evaluates it, ci.edf_greenhall(alpha, 2, m,
# 10001, overlapping=True). It takes a phase averaged over a sample, which differs where m is small.
GREENHALL = {
    (2, 1): 5142.6,
    (2, 50): 5105.2,
    (2, 2000): 3724.6,
    (0, 50): 297.78,
    (0, 200): 72.765,
    (0, 1000): 12.801,
    (0, 2000): 5.4007,
    (-1, 50): 232.94,
    (-1, 200): 56.865,
    (-1, 1000): 9.9375,
    (-1, 2000): 4.1271,
    (-2, 50): 183.84,
    (-2, 200): 44.809,
    (-2, 1000): 7.7454,
    (-2, 2000): 3.1374,
}


@pytest.mark.parametrize("key", GREENHALL)
def test_degrees_of_freedom_agree_with_another_implementation(key):
    alpha, factor = key
    found = noise_densities.degrees_of_freedom(np.array([factor]), np.array([alpha]), 10_000)[0]
    assert found == pytest.approx(GREENHALL[key], rel=0.02)


def test_long_averaging_times_cost_no_more_lags():
    """Above `LAGS` the lags are thinned out: no step there, and an hour at 1 kHz stays quick."""
    factors = np.array([99, 100, 101, 102])
    for alpha in (0, -1, -2):
        edf = noise_densities.degrees_of_freedom(factors, np.full(4, alpha), 100_000)
        assert np.all(np.abs(np.diff(edf, 2)) < 5e-4 * edf[0])
    assert noise_densities.degrees_of_freedom(np.array([700_000]), np.array([-1]), 3_600_000)[0] > 1.0


def test_one_second_difference_has_one_degree_of_freedom():
    assert noise_densities.degrees_of_freedom(np.array([5]), np.array([0]), 10)[0] == 1.0


def test_deviation_needs_two_clusters():
    signal = np.random.default_rng(1).standard_normal(20)
    assert noise_densities.allan_deviation(signal, 1.0, np.array([10])).shape == (1,)
    with pytest.raises(noise_densities.TooShortError, match="11 s"):
        noise_densities.allan_deviation(signal, 1.0, np.array([1, 11]))


def test_no_package_for_it_is_imported():
    assert "allantools" not in sys.modules
