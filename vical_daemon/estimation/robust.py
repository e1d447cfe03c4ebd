"""Robust statistics: what a median says of a sigma, weights of errors that may be outliers, iterations."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, ndtri

FloatArray = npt.NDArray[np.float64]

MEDIAN_ABSOLUTE = float(ndtri(0.75))
"""Of the size of a standard normal variable."""
MEDIAN_RAYLEIGH = float(np.sqrt(chdtri(2, 0.5)))
"""Of the length of two."""
MEDIAN_CHI2, MEDIAN_CHI2_3 = float(chdtri(1, 0.5)), float(chdtri(3, 0.5))
"""Of a chi-square variable with one degree of freedom, and with three."""
MOST_STEPS = 30
"""Of an iteration that stops where nothing changes, mostly after fewer than ten."""


def median(values: FloatArray) -> float:
    """Of a few dozen numbers, at least one; numpy's takes five times as long for so few."""
    ordered = np.sort(values, axis=None)
    half = len(ordered) // 2
    return float(ordered[half] if len(ordered) % 2 else 0.5 * (ordered[half - 1] + ordered[half]))


def sigma_by_median(errors: FloatArray) -> float:
    """Standard deviation of normal errors about zero, by the median of their sizes."""
    return median(np.abs(errors)) / MEDIAN_ABSOLUTE


def geman_mcclure_weight(square: FloatArray) -> FloatArray:
    """Weight of errors in a least-squares problem reweighted for the cost x^2 / (1 + x^2).

    Args:
        square: Of the errors, over the square of the size from which on they count less and less.
    """
    return np.asarray((1.0 + square) ** -2.0)


def huber_weight(size: FloatArray, limit: float) -> FloatArray:
    """The same for Huber's cost: errors beyond a limit count by their size, not its square."""
    return np.asarray(np.minimum(1.0, limit / np.maximum(size, 1e-9)))
