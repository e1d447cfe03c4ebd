"""How often a decision may be wrong on data that fit the model: three levels, and the limits that follow.

A level is a number of standard deviations. The chance that a normal variable is beyond is that of a false
alarm in one test.

perhaps (3e-3)
    A false alarm costs next to nothing. Stretches that disagree widen sigmas; a first window is adjusted once
    more with a readout by columns; `td_icp` leaves out one orientation of many.
likely (6e-5)
    Tests of every corner or window, where a false alarm costs that datum, or a parameter that is not needed:
    corners before and after the correction, windows without a target that contradict the calibration, errors
    that last, late stamps without a target, a further power of a lens's radius, flicker of a sensor; and what
    has changed (the time shift or the mounting), once something surely has.
sure (2e-9)
    Tests of every image, or once a second over 20 spans, that announce something: a time shift that has
    moved, a rolling shutter, another size of the target. An error beyond is an outlier, and counts as if it
    were no larger.
"""

from __future__ import annotations

from scipy.special import chdtri, ndtr

PERHAPS_SIGMAS, LIKELY_SIGMAS, SURE_SIGMAS = 3.0, 4.0, 6.0
"""The levels, in standard deviations."""
CALIBRATIONS_DISAGREE = 1e-3
"""Calibrations that are the same are called different by `vical compare`, `verify` or `merge`."""

STRETCH_S = 5.0
"""What a model gets wrong lasts for seconds: stretches so long, s, are taken as independent."""
EVERY_S = 1.0
"""Decisions that need not follow every image are made this often, s."""


def chance(sigmas: float) -> float:
    """Probability that a normal variable is beyond so many standard deviations, on either side."""
    return 2.0 * float(ndtr(-sigmas))


def chi_square_limit(dof: int, sigmas: float) -> float:
    """Largest value of a chi-square variable that may be chance, at a level as above."""
    return float(chdtri(dof, chance(sigmas)))
