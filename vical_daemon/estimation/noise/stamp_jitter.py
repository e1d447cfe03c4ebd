"""Stamp jitter: the size from which it is announced. A variance from errors and their usual variances.

The estimate is for use without a board; with one, `shared_errors` does it.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.robust import MEDIAN_CHI2, MOST_STEPS
from vical_daemon.estimation.significance import SURE_SIGMAS

ANNOUNCED_S = 3e-4
"""From here on a jitter is announced, s: what to do about it is often a setting of the camera's driver."""
PERSISTENT = 0.5
"""Correlation of what neighbouring images are late by: nearer to that of a model error (1) than to that of a
jitter (0)."""


def evidence(square: FloatArray, usual: FloatArray) -> float:
    """By how many standard deviations squared errors exceed their usual variances.

    Args:
        square: Squared errors, shape (n,).
        usual: Their variances without anything else, in the same unit, shape (n,).
    """
    ratio = np.minimum(square / usual, SURE_SIGMAS**2)
    telling = 1.0 / np.maximum(usual, np.median(usual))  # images with a wide prior have little to say
    return float(telling @ (ratio - 1.0) / np.sqrt(2.0 * float(telling @ telling)))


def excess(square: FloatArray, usual: FloatArray) -> float:
    """Standard deviation beyond their usual variances that squared errors show; arguments as `evidence`.

    Maximum likelihood by scoring.
    """
    variance = max(float(np.median(square)) / MEDIAN_CHI2 - float(np.median(usual)), 0.0)
    for _ in range(MOST_STEPS):
        expected = usual + variance
        weight = expected**-2
        more = np.minimum(square, SURE_SIGMAS**2 * expected) - usual
        variance = max(float(weight @ more / weight.sum()), 0.0)
    return float(np.sqrt(variance))
