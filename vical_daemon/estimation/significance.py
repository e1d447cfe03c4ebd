"""How often each decision may be wrong on data that fit the model, and the limits that follow: one table.

A rate counts false alarms per test. Tests that are repeated for every image or every second have small ones.
"""

from __future__ import annotations

from scipy.special import chdtri

# Chance, of a chi-square variable.
CORNER_REFUSED = 1e-4
"""A good corner is refused before the correction; some 50 corners an image, twenty images a second."""
RESIDUAL_REFUSED = 2e-5
"""A good corner is refused by what the correction leaves of its error."""
IMAGE_REFUSED = 1e-9
"""A good image is refused as a whole."""
ORIENTATION_REFUSED = 1e-3
"""A good orientation of a sensor is refused in the joint fit of `td_icp`."""
STRETCHES_DISAGREE = 0.01
"""Stretches of a recording that do agree are taken for some that do not: sigmas grow for nothing."""
WINDOW_CONTRADICTS = 1e-5
"""A window without a target that does agree is taken for a changed rig."""
COLUMNS_TRIED = 3e-3
"""A first window without readout by columns is adjusted once more with it: costs CPU time only."""
SHIFT_MISFIT = 1e-6
"""Orientations that fit at a time shift are taken for some that do not."""
CALIBRATIONS_DISAGREE = 1e-3
"""Calibrations that are the same are called different by `vical compare`, `verify` or `merge`."""

# Standard deviations, of a normal variable (two-sided).
SURE_SIGMAS = 5.0
"""6e-7: a term of the noise, a rolling shutter, another size of the target is taken as real."""
TERM_SIGMAS = 4.0
"""6e-5: a model lacks a term: the next power of a lens's radius, flicker of a sensor."""
CHANGED_SIGMAS, PERHAPS_SIGMAS = 6.0, 3.0
"""2e-9 and 3e-3: a time shift has left where it was, or jumped, or two clocks run at different rates: surely
or perhaps. Asked once a second over 20 spans, at every window of `td_icp`."""
OUTLIER_SIGMAS = 6.0
"""2e-9: an error beyond is an outlier; it counts as if it were no larger, and says nothing of a noise."""

STRETCH_S = 5.0
"""What a model gets wrong lasts for seconds: stretches so long, s, are taken as independent."""
EVERY_S = 1.0
"""Decisions that need not follow every image are made this often, s."""


def chi_square_limit(dof: int, false_alarm: float) -> float:
    """Largest value of a chi-square variable that may be chance."""
    return float(chdtri(dof, false_alarm))
