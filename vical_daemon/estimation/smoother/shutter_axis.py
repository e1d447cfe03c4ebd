"""Whether a rolling shutter reads columns instead of rows: asked of first windows and of complete ones."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from vical_daemon.estimation.measurements import COLUMNS
from vical_daemon.estimation.significance import PERHAPS_SIGMAS, chi_square_limit
from vical_daemon.estimation.smoother.bundle import Bundle, Fit
from vical_daemon.estimation.smoother.marginal_prior import MarginalPrior
from vical_daemon.estimation.smoother.window import Window


def shows_columns(bundle: Bundle, fit: Fit) -> bool:
    """Whether what rows leave over looks like a readout by columns, so that they are worth an adjustment.

    The gain is a lower bound: motion, lens and mounting have taken what they could of it. So anything beyond
    chance is worth it; which axis it is, the two adjustments decide.
    """
    if bundle.view is None:
        return False
    chance = chi_square_limit(1, PERHAPS_SIGMAS) * max(fit.squares / fit.dof, 1.0)
    return bundle.problem.late_by_columns(bundle.view) > chance


def readout_sigmas(carry: MarginalPrior) -> float:
    """By how many sigmas a readout differs from none: the axis of which it does by more explains more.

    Its square is by how much the squared errors, over their noise, grow with a global shutter. [Wald 1943]
    """
    return abs(carry.camera.readout_s) / carry.sigma(carry.layout.camera.readout)


def read_by_columns(window: Window) -> Window:
    """The same window, to be adjusted with columns that are read one after the other."""
    other = deepcopy(window)
    other.bad.clear()  # what did not fit with rows
    other.camera = replace(window.camera, readout_axis=COLUMNS, readout_s=0.0)
    other.jumps = window.jumps[:0]  # it starts from nothing
    return other
