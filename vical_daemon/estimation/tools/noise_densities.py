"""Noise densities of an inertial sensor at rest: Allan deviation, fitted model, confidence.

Model of the Allan variance (IEEE Std 952, annex C), one term per noise process:

    sigma^2(tau) = 3 Q^2 / tau^2 + N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3

Q quantisation, N white noise (angle or velocity random walk: the `density`), B flicker floor,
K rate random walk (the `walk`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from vical_daemon.estimation.measurements import FloatArray, ImuNoise, IntArray
from vical_daemon.estimation.significance import LIKELY_SIGMAS

FLICKER = 2.0 * np.log(2.0) / np.pi  # Allan variance of 1/f noise of unit coefficient
CLUSTERS_MIN = 5  # an averaging time needs at least this many clusters in the recording
# Power-law exponent of the rate noise for each model term (Q, N, B, K), for the degrees of freedom.
TERM_ALPHA = (2, 0, -1, -2)
# Ratio of true scatter to the sigma of independent points, per term, by Monte Carlo (benchmarks allan).
OVERLAP_INFLATION = np.array([1.7, 1.7, 1.8, 1.8])
LAGS = 100  # lags an averaging time at most: the sum over more is an integral, known to 1e-4 by then
SECOND_DIFFERENCES = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # autocorrelation of (1, -2, 1)


@dataclass(frozen=True, slots=True)
class AllanCurve:
    """Overlapping Allan deviation of one axis.

    Attributes:
        tau_s: Averaging times, s, shape (n,).
        adev: Allan deviation in the unit of the signal, shape (n,).
        edf: Equivalent degrees of freedom of each variance (Greenhall), shape (n,).
        samples: Number of samples the curve was made from.
        rate_hz: Their rate.
    """

    tau_s: FloatArray
    adev: FloatArray
    edf: FloatArray
    samples: int
    rate_hz: float

    def sigma(self) -> FloatArray:
        """Return the standard deviation of each point of `adev`, adev / sqrt(2 edf), shape (n,)."""
        return np.asarray(self.adev / np.sqrt(2.0 * self.edf), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Coefficient:
    """A noise coefficient and its standard deviation, in SI units."""

    value: float
    sigma: float

    @property
    def upper(self) -> float:
        """One-sigma upper bound: what a user should take where the value itself is 0."""
        return self.value + self.sigma


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """Noise of one axis. Units for a signal in U (rad/s or m/s^2).

    Attributes:
        density: White noise N, U/sqrt(Hz).
        walk: Rate random walk K, U/s/sqrt(Hz) (the same number as U*sqrt(Hz)); Kalibr's random walk.
        instability: Bias instability: lowest Allan deviation / 0.664, U.
        instability_tau_s: Averaging time of that lowest point, s.
        instability_reached: False: the curve still falls at its end, the value is an upper bound.
        quantisation: Q, U*s.
        flicker: B of the fitted model, U (0 where white noise and walk explain the curve).
    """

    density: Coefficient
    walk: Coefficient
    instability: Coefficient
    instability_tau_s: float
    instability_reached: bool
    quantisation: Coefficient
    flicker: Coefficient

    def model_adev(self, tau_s: FloatArray) -> FloatArray:
        """Evaluate the fitted Allan deviation at `tau_s` (s), same shape, in the unit of the signal."""
        q = [self.quantisation.value, self.density.value, self.flicker.value, self.walk.value]
        return np.asarray(np.sqrt(_design(np.asarray(tau_s, dtype=np.float64)) @ np.square(q)))


def _design(tau_s: FloatArray) -> FloatArray:
    """Columns of the model: variance at each tau for unit Q^2, N^2, B^2, K^2, shape (n, 4)."""
    return np.stack([3.0 / tau_s**2, 1.0 / tau_s, np.full_like(tau_s, FLICKER), tau_s / 3.0], axis=-1)


def averaging_factors(samples: int) -> IntArray:
    """Return averaging factors m from 1 to samples / 5, four an octave, ascending, unique.

    Raises:
        TooShortError: Fewer than 100 samples.
    """
    if samples < 100:
        raise TooShortError(f"an Allan analysis needs at least 100 samples at rest, got {samples}")
    powers = np.arange(int(4.0 * np.log2(samples / CLUSTERS_MIN)) + 1) / 4.0
    return np.unique(np.round(2.0**powers)).astype(np.int64)


def allan_curve(signal: FloatArray, rate_hz: float) -> AllanCurve:
    """Return the overlapping Allan deviation of one axis over log-spaced averaging times.

    The degrees of freedom are those of the noise that dominates at each averaging time.

    Raises:
        TooShortError: Fewer than 100 samples.
    """
    samples = len(signal)
    factors = averaging_factors(samples)
    adev = allan_deviation(signal, rate_hz, factors)
    tau_s = factors / rate_hz
    edf = degrees_of_freedom(factors, np.zeros(len(factors), dtype=np.int64), samples)
    terms = _fit_variances(tau_s, adev, edf)[0]
    dominant = np.argmax(_design(tau_s) * terms, axis=1)
    edf = degrees_of_freedom(factors, np.asarray(TERM_ALPHA)[dominant], samples)
    return AllanCurve(tau_s, adev, edf, samples, rate_hz)


def _fit_variances(tau_s: FloatArray, adev: FloatArray, edf: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weighted non-negative least squares for (Q^2, N^2, B^2, K^2) and their standard deviations.

    White noise and rate random walk are always in the model; flicker and quantisation only where
    they lower chi^2 by more than `LIKELY_SIGMAS` squared. Without that, a flicker term of pure chance takes
    variance from the walk, which then comes out low with too small a sigma.
    """
    included = np.array([False, True, False, True])
    terms, chi2 = _fit_included(tau_s, adev, edf, included)
    for candidate in (2, 0):
        trial = included.copy()
        trial[candidate] = True
        trial_terms, trial_chi2 = _fit_included(tau_s, adev, edf, trial)
        if chi2 - trial_chi2 > LIKELY_SIGMAS**2:
            included, terms, chi2 = trial, trial_terms, trial_chi2
    design = _design(tau_s)
    columns = design * (np.sqrt(edf / 2.0) / np.maximum(design @ terms, 1e-300))[:, None]
    return terms, _term_sigmas(columns, included)


def _fit_included(
    tau_s: FloatArray, adev: FloatArray, edf: FloatArray, included: npt.NDArray[np.bool_]
) -> tuple[FloatArray, float]:
    """Fit the included terms only; returns all four (0 where left out) and chi^2.

    The variance of an Allan variance is 2 sigma^4 / edf with the *model's* sigma: weights from the
    measured curve would pull the fit low, so they are recomputed from the fit.
    """
    design = _design(tau_s)
    model = adev**2
    terms = np.zeros(4)
    residual = np.zeros_like(model)
    for _ in range(5):
        weight = np.sqrt(edf / 2.0) / model
        columns = design[:, included] * weight[:, None]
        scale = np.linalg.norm(columns, axis=0)  # NNLS is not scale free; terms differ by 1e8
        solution, _ = nnls(columns / scale, adev**2 * weight)
        terms[included] = solution / scale
        model = np.maximum(design @ terms, 1e-300)
        residual = (adev**2 - model) * np.sqrt(edf / 2.0) / model
    return terms, float(residual @ residual)


def _term_sigmas(columns: FloatArray, included: npt.NDArray[np.bool_]) -> FloatArray:
    """Standard deviations of the four terms; a term left out gets that which it would have alone added."""
    scale = np.linalg.norm(columns, axis=0)
    sigma = np.empty(4)
    for i in range(4):
        keep = included.copy()
        keep[i] = True
        scaled = columns[:, keep] / scale[keep]
        covariance = np.linalg.pinv(scaled.T @ scaled)
        position = int(np.count_nonzero(keep[:i]))
        sigma[i] = np.sqrt(covariance[position, position]) / scale[i]
    # Overlapping variances an octave apart are correlated, which a diagonal weight ignores.
    sigmas: FloatArray = sigma * OVERLAP_INFLATION
    return sigmas


def fit_noise(curve: AllanCurve, tau_min_s: float | None = None) -> NoiseFit:
    """Fit the four-term model to an Allan curve.

    Args:
        curve: From `allan_curve`.
        tau_min_s: Shortest averaging time used; None: `shortest_tau`.

    Returns:
        Coefficients with standard deviations. Points an octave apart enter the fit: closer ones are
        correlated and would make the sigmas too small.
    """
    shortest = shortest_tau(curve) if tau_min_s is None else tau_min_s
    octaves = np.log2(curve.tau_s * curve.rate_hz)
    use = (np.abs(octaves - np.round(octaves)) < 1e-9) & (curve.tau_s >= shortest)
    if np.count_nonzero(use) < 4:
        raise TooShortError(
            f"only {np.count_nonzero(use)} octaves of averaging time above {shortest:g} s: record longer"
        )
    terms, term_sigma = _fit_variances(curve.tau_s[use], curve.adev[use], curve.edf[use])
    quantisation, density, flicker, walk = (
        _coefficient(float(t), float(s)) for t, s in zip(terms, term_sigma, strict=True)
    )
    lowest = int(np.argmin(curve.adev))
    floor = np.sqrt(FLICKER)
    return NoiseFit(
        density=density,
        walk=walk,
        instability=Coefficient(float(curve.adev[lowest] / floor), float(curve.sigma()[lowest] / floor)),
        instability_tau_s=float(curve.tau_s[lowest]),
        instability_reached=lowest < len(curve.tau_s) - 1,
        quantisation=quantisation,
        flicker=flicker,
    )


def shortest_tau(curve: AllanCurve) -> float:
    """Return the shortest averaging time that a fit should use, s: 0.1 s to 1 s, with the length.

    A sensor's own filter (15 ms in a GX3-25) correlates neighbouring samples: the Allan variance lies below
    the model by about (filter / tau), while its sampling error falls as sqrt(tau / T). For four hours both
    are equal near 1 s; shorter recordings need the shorter times.
    """
    duration_s = curve.samples / curve.rate_hz
    return max(min(max(duration_s / 14400.0, 0.1), 1.0), 4.0 / curve.rate_hz)


def _coefficient(square: float, square_sigma: float) -> Coefficient:
    """Root of a variance term: d(sqrt v) = dv / (2 sqrt v); at zero the root of the bound itself."""
    value = float(np.sqrt(square))
    if square > square_sigma:
        return Coefficient(value, square_sigma / (2.0 * value))
    return Coefficient(value, float(np.sqrt(square + square_sigma)) - value)


def imu_noise(gyro: Sequence[NoiseFit], accel: Sequence[NoiseFit], rate_hz: float) -> ImuNoise:
    """Combine per-axis fits to the four numbers of an estimator.

    Densities are root mean squares over the axes. A walk that the recording was too short to show
    is given by its one-sigma upper bound, never by 0: an estimator with a bias that cannot move is
    over-confident.
    """

    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    def walk(fits: Sequence[NoiseFit]) -> float:
        shown = [f.walk.value if f.walk.value > f.walk.sigma else f.walk.upper for f in fits]
        return rms(shown)

    return ImuNoise(
        gyro_density=rms([f.density.value for f in gyro]),
        gyro_walk=walk(gyro),
        accel_density=rms([f.density.value for f in accel]),
        accel_walk=walk(accel),
        rate_hz=rate_hz,
    )


class TooShortError(ValueError):
    """The recording holds too few samples for an Allan analysis; the message says how many are needed."""


def allan_deviation(signal: FloatArray, rate_hz: float, factors: IntArray) -> FloatArray:
    """Return the Allan deviation at averaging times factors / rate_hz, of all overlapping clusters.

    With the phase x_k = tau_0 * (y_0 + ... + y_(k-1)) and tau = m tau_0, every estimate is a mean of squared
    second differences z_k = x_(k+2m) - 2 x_(k+m) + x_k, sigma^2(tau) = mean(z_k^2) / (2 tau^2).
    [IEEE Std 1139-2008; NIST SP 1065, section 5.2]

    Args:
        signal: Rate-like signal at rest (angular rate, specific force), evenly sampled, shape (n,).
        rate_hz: Sampling rate, Hz.
        factors: Averaging factors, shape (k,).

    Returns:
        Allan deviation in the unit of the signal, shape (k,).

    Raises:
        TooShortError: An averaging time is longer than half the recording.
    """
    values = np.asarray(signal, dtype=np.float64)
    longest = int(np.max(factors, initial=1))
    if len(values) < 2 * longest:
        raise TooShortError(
            f"averaging over {longest / rate_hz:g} s needs a longer recording than {len(values)} samples"
        )
    # In units of the sampling interval; the mean would only cost digits.
    phase = np.concatenate([[0.0], np.cumsum(values - np.mean(values))])
    deviation = np.empty(len(factors))
    for k, factor in enumerate(int(f) for f in factors):
        second = phase[2 * factor :] - 2.0 * phase[factor:-factor] + phase[: -2 * factor]
        deviation[k] = np.sqrt(0.5 * np.mean(second**2)) / factor
    return deviation


def degrees_of_freedom(factors: IntArray, alpha: IntArray, samples: int) -> FloatArray:
    """Return the equivalent degrees of freedom of overlapping Allan variances.

    Overlapping clusters are correlated; their mean square has as many as follow from the autocovariance.
    [Greenhall and Riley, "Uncertainty of stability variances based on finite differences", 2003]

    Args:
        factors: Averaging factors m, shape (k,).
        alpha: Exponent of the power law f^alpha of the rate noise at each: 2 (quantisation), 0 (white),
            -1 (flicker) or -2 (random walk), shape (k,).
        samples: Number of rate samples.

    Returns:
        Degrees of freedom, at least 1, shape (k,).
    """
    pairs = zip(factors, alpha, strict=True)
    edf = [_degrees_of_freedom(int(m), int(a), samples) for m, a in pairs]
    return np.maximum(np.asarray(edf, dtype=np.float64), 1.0)


def _degrees_of_freedom(factor: int, alpha: int, samples: int) -> float:
    """Return M / sum over all lags j of (1 - |j| / M) rho_j^2, with rho the autocorrelation of the z."""
    differences = float(samples + 1 - 2 * factor)  # M: second differences of samples + 1 phase points
    if alpha == 2:  # the phase itself is white: only z that share a phase point are correlated
        lags, covariance = factor * np.arange(3.0), SECOND_DIFFERENCES[2:]
    else:
        # Beyond three averaging times nothing is left (flicker: nothing that counts, as in the paper).
        thinning = max(factor / LAGS, 1.0)
        lags = np.arange(0.0, min(3.0 * factor, differences), thinning)
        covariance = _autocovariance(lags / factor, alpha)
        differences, lags = differences / thinning, lags / thinning
    weight = np.clip(1.0 - lags / differences, 0.0, None)
    correlation = covariance / covariance[0]
    return float(differences / (2.0 * (weight @ correlation**2) - 1.0))


def _autocovariance(lag: FloatArray, alpha: int) -> FloatArray:
    """Autocovariance of the second differences, up to a factor; `lag` in averaging times.

    The fourth difference of the phase's generalised autocovariance (from the paper): -|t| for a random walk
    of the phase (white rate noise), t^2 ln |t| for flicker, |t|^3 for a random walk of the rate.
    """
    size = np.abs(lag[:, None] + np.arange(-2.0, 3.0))
    if alpha == 0:
        phase = -size
    elif alpha == -1:
        phase = size**2 * np.log(np.maximum(size, 1e-300))
    else:
        phase = size**3
    return np.asarray(phase @ SECOND_DIFFERENCES, dtype=np.float64)
