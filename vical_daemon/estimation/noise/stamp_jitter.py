"""Stamp jitter: the size from which it is announced, and its estimate from errors and their variances.

The estimate is for use without a board; with one, `shared_errors` does it.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.robust import MEDIAN_CHI2
from vical_daemon.estimation.significance import LIKELY_SIGMAS, SURE_SIGMAS

FLOOR_S = 2e-5  # of a jitter that is one
_ROUNDS = 8  # of scoring, from a start by medians
ANNOUNCED_S = 3e-4
"""From here on a jitter is announced, s: what to do about it is often a setting of the camera's driver."""
PERSISTENT = 0.5
"""Correlation of what neighbouring images are late by: nearer to that of a model error (1) than to that of a
jitter (0)."""


def excess(square: FloatArray, usual: FloatArray) -> float:
    """Standard deviation, s, that squared errors show beyond their usual variances; 0 if by chance.

    Args:
        square: Squared errors, s^2, shape (n,).
        usual: Their variances without, s^2, shape (n,).
    """
    ratio = np.minimum(square / usual, SURE_SIGMAS**2)
    telling = 1.0 / np.maximum(usual, np.median(usual))  # images with a wide prior have little to say
    if telling @ (ratio - 1.0) < LIKELY_SIGMAS * np.sqrt(2.0 * float(telling @ telling)):
        return 0.0
    # maximum likelihood by scoring
    variance = max(float(np.median(square)) / MEDIAN_CHI2 - float(np.median(usual)), 0.0)
    for _ in range(_ROUNDS):
        expected = usual + variance
        weight = expected**-2
        excess = np.minimum(square, SURE_SIGMAS**2 * expected) - usual
        variance = max(float(weight @ excess / weight.sum()), 0.0)
    return float(np.sqrt(variance)) if variance > FLOOR_S**2 else 0.0
