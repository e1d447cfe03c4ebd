"""The first window of a target-free calibration, and whether it or a complete one shows columns, not rows."""

from __future__ import annotations

from collections.abc import Collection
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

from vical_daemon.estimation.events import Cause
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import COLUMNS, CalibrationOptions, CameraPrior, Frames
from vical_daemon.estimation.model.state import Layout
from vical_daemon.estimation.robust import MOST_STEPS
from vical_daemon.estimation.significance import PERHAPS_SIGMAS, chi_square_limit
from vical_daemon.estimation.smoother.bundle import LEAST_PARALLAX, Bundle, Fit
from vical_daemon.estimation.smoother.marginal_prior import MarginalPrior, initial_prior, of_another_recording
from vical_daemon.estimation.smoother.normal import ImageNoise
from vical_daemon.estimation.smoother.target_free_initializer import TargetFreeInitializer
from vical_daemon.estimation.smoother.target_free_status import TargetFreeStatus
from vical_daemon.estimation.smoother.window import Window
from vical_daemon.estimation.wording import cause_text

DOES_NOT_FIT = "the first seconds do not fit together yet: move the rig to and fro while turning it"


class Begun(NamedTuple):
    """A window that has been started."""

    bundle: Bundle
    fit: Fit


class FirstWindow:
    """Makes first windows, from nothing or with the calibration of before.

    Args:
        options: Switches and noise.
        prior: What is known about the camera.
        layout: Where the errors live.
        status: Says whether a window fits, and agrees with what was known.

    Attributes:
        initializer: Finds rotations, delay and structure.
    """

    def __init__(
        self, options: CalibrationOptions, prior: CameraPrior, layout: Layout, status: TargetFreeStatus
    ) -> None:
        self._options, self._prior, self._layout, self._status = options, prior, layout, status
        self.initializer = TargetFreeInitializer(options, prior)
        self._without_depth = False  # the rays of the last adjustment hardly cross

    def begin(
        self, buffer: ImuBuffer, frames: Frames, known: MarginalPrior | None, noise: ImageNoise
    ) -> Begun | str:
        """Start a window from a stretch, with the calibration of before where there is one; or why not."""
        window = self.initializer.window(buffer, frames, known)
        if isinstance(window, str):
            return window
        begun = self.adjusted(buffer, window, known, noise)
        if known is None and self._without_depth:
            return cause_text(Cause.NO_PARALLAX)
        return begun or DOES_NOT_FIT

    def of_another(
        self, buffer: ImuBuffer, frames: Frames, known: MarginalPrior, stepped_s: float
    ) -> MarginalPrior | str:
        """What was known, with the biases by the first images of another recording; or why there are none."""
        window = self.initializer.window(buffer, frames, None)
        if isinstance(window, str):
            return window
        if self.initializer.held is not None:
            self.initializer.held = None
            return "the rig turns about one axis only so far: turn it about a second one"
        return of_another_recording(known, window, stepped_s)

    def adjusted(
        self,
        buffer: ImuBuffer,
        window: Window,
        known: MarginalPrior | None,
        noise: ImageNoise,
        reopened: Collection[int] = (),
    ) -> Begun | None:
        """Adjust a first window with what is known but for some errors; None where it does not fit."""
        bundle, carry, fit = self._solved(buffer, window, known, noise, reopened)
        seek_axis = known is None and self._seeks_axis
        if seek_axis and fit is not None and shows_columns(bundle, fit):
            by_columns = self._solved(buffer, read_by_columns(window), known, noise, reopened)
            if by_columns[2] is not None and readout_sigmas(by_columns[2].carry) > readout_sigmas(fit.carry):
                bundle, carry, fit = by_columns
        self._without_depth = fit is not None and fit.parallax < LEAST_PARALLAX
        if fit is None or not (fit.settled and self._status.fits(fit, first=True)):
            return None
        if known is not None and not self._status.agrees(fit, carry, complete=False):
            return None
        if seek_axis:
            axis = bundle.window.camera.readout_axis
            self._prior = self.initializer.prior = replace(self._prior, readout_axis=axis)
        return Begun(bundle, fit)

    @property
    def _seeks_axis(self) -> bool:
        """Whether rows are read one after the other only because nothing else has been seen."""
        return not (self._prior.readout_axis or self._prior.readout_s)

    def by_columns(self, buffer: ImuBuffer, bundle: Bundle, fit: Fit) -> Begun | None:
        """Restart with a complete window that shows a readout by columns, which is known from then on.

        The first window may have had too little motion, or too much noise, to show it. What was found before,
        with rows, is not kept.
        """
        if not self._seeks_axis or not shows_columns(bundle, fit):
            return None
        found = self._solved(buffer, read_by_columns(bundle.window), None, fit.noise, ())
        if found[2] is None or not (found[2].settled and self._status.fits(found[2], first=True)):
            return None
        sure = self._status.models.rolls(found[2].carry, self._status.factor())
        if not sure or readout_sigmas(found[2].carry) < readout_sigmas(fit.carry):
            return None
        self._prior = self.initializer.prior = replace(self._prior, readout_axis=COLUMNS)
        self._status.models.axis_changed()
        return Begun(found[0], found[2])

    def _solved(
        self,
        buffer: ImuBuffer,
        window: Window,
        known: MarginalPrior | None,
        noise: ImageNoise,
        reopened: Collection[int],
    ) -> tuple[Bundle, MarginalPrior, Fit | None]:
        """Adjust a window with what is known but for some errors."""
        models, held = self._status.models, self.initializer.held
        sigmas = models.imu_sigma, self._options.gravity_sigma_mps2
        carry = initial_prior(window, known, self._layout, held, *sigmas, self._prior, reopened)
        bundle = Bundle(window, carry, noise)
        return bundle, carry, bundle.solve(buffer, MOST_STEPS)

    def anew(self) -> None:
        """Estimate everything again from the config; its mounting is no longer that of the rig."""
        if self._layout.camera.position is not None:
            self._prior = replace(self._prior, T_imu_cam=None)
        self.initializer = TargetFreeInitializer(self._options, self._prior)


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
