"""Allan deviation of a rate signal, and the degrees of freedom of each point.

With the phase x_k = tau_0 * (y_0 + ... + y_(k-1)) and tau = m tau_0, every estimate is a mean of squared
second differences z_k = x_(k+2m) - 2 x_(k+m) + x_k (IEEE Std 1139-2008; NIST SP 1065, section 5.2):

    sigma^2(tau) = mean(z_k^2) / (2 tau^2)

The z_k of overlapping clusters are correlated. The equivalent degrees of freedom of their mean square follow
from their autocovariance (Greenhall and Riley, "Uncertainty of stability variances based on finite
differences", 2003).
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray

LAGS = 100  # lags an averaging time at most: the sum over more is an integral, known to 1e-4 by then
SECOND_DIFFERENCES = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # autocorrelation of (1, -2, 1)


class TooShortError(ValueError):
    """The recording holds too few samples for an Allan analysis; the message says how many are needed."""


def allan_deviation(signal: FloatArray, rate_hz: float, factors: IntArray) -> FloatArray:
    """Return the Allan deviation at averaging times factors / rate_hz, of all overlapping clusters.

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
