"""Model selection without a target: do clocks drift, is the imu off, does the shutter roll?"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.events import ROLLING, Event, EventKind
from vical_daemon.estimation.measurements import ROWS
from vical_daemon.estimation.model.priors import ENTRY_SIGMA, KNOWN_OFF_SIGMA, OFF, SURE
from vical_daemon.estimation.model.state import Layout
from vical_daemon.estimation.selection import model_selection
from vical_daemon.estimation.selection.clock_drift import CLOCKS_IN_DOUBT
from vical_daemon.estimation.selection.model_acceptance import known_off, lens_off
from vical_daemon.estimation.selection.model_mixture import (
    Block,
    Weights,
    hypotheses,
    lens_block,
    not_zero,
    term_block,
)
from vical_daemon.estimation.significance import SURE_SIGMAS
from vical_daemon.estimation.smoother.clock_changes import (
    Clock,
    forgotten,
    over_clocks,
    settled,
    stepped_s,
    what_happened,
)
from vical_daemon.estimation.smoother.marginal_prior import MarginalPrior
from vical_daemon.estimation.smoother.snapshot import ReportedModels

_WINDOWS_SHOW = 2  # beginning with that in which something changed, until what it was is clear


def _shown(clocks: list[Clock], complete: int) -> list[Clock]:
    """Hypotheses without a jump, or with one that enough windows follow."""
    return [c for c in clocks if c.jump < 0 or c.jump < complete - _WINDOWS_SHOW]


class AlternativeModels:
    """Follows what the windows say about clocks, imu and shutter.

    Args:
        layout: Where the errors live.
        asked: What is asked for (`CalibrationOptions.estimate`): estimated whatever the evidence.
        rolling: The shutter is configured as a rolling one, or its readout is asked for.

    Attributes:
        drifting: The camera's clock is known to run apart from the imu's.
        lens: The lens, where it is fixed; None: it is estimated, or taken as exact.
        asked: Blocks that are to be estimated in any case.
        imu_sigma: Prior of the entries of the imu's matrices.
        rolling: The shutter is known to be a rolling one.
        stamp_sigma_s: How well the imu's driver knows its device's clock, s.
    """

    def __init__(self, layout: Layout, *, asked: frozenset[str], rolling: bool) -> None:
        (self._camera,) = layout.cameras
        self.lens = layout.held.get(self._camera)
        self._off = asked & {model_selection.IMU, model_selection.LAG, model_selection.SIZE_EFFECT}
        self.asked = asked
        self.imu_sigma = KNOWN_OFF_SIGMA if model_selection.IMU in asked else ENTRY_SIGMA
        self.drifting = False
        self.rolling = self._rolling_known = rolling
        self.stamp_sigma_s = 0.0
        self._began_s = np.inf
        self._asked: tuple[MarginalPrior, tuple[float, ...], list[Clock]] | None = None  # see `clocks`
        self._weighed: tuple[MarginalPrior, tuple[object, ...], Weights] | None = None  # see `_weights`
        self._reported: tuple[ReportedModels, tuple[object, ...]] | None = None  # see `weighed`
        self._announced_s: tuple[float, ...] = ()  # jumps that may be the drift that was announced

    def watch(self, carry: MarginalPrior, factor: float, compared: bool) -> list[Event]:
        """Announce what has got beyond doubt.

        Args:
            carry: What is known.
            factor: Measured variance over the stated one.
            compared: Windows could be compared; before, what looks like the imu may as well be the images.
        """
        events = self._news_of_drift(carry, self.clocks(carry, factor), len(carry.jump_t_s) - 1)
        if not self.rolling:
            self.rolling = self.rolls(carry, factor)
            if self.rolling:
                kind = ROLLING[carry.camera.readout_axis or ROWS]
                sigma_s = float(np.sqrt(factor)) * carry.sigma(carry.layout.camera.readout)
                events.append(Event(kind, self._camera, float(carry.camera.readout_s), sigma_s))
        if compared:
            weights = self._weights(carry, factor)
            every = self._blocks(carry)
            known = {name for name in every if not_zero(weights, name) > SURE}
            news = sorted(known - self._off)
            events += [self._known_off(name, every[name], carry, factor) for name in news]
            self._off |= known
        return events

    def _known_off(self, name: str, block: Block, carry: MarginalPrior, factor: float) -> Event:
        covariance = factor * carry.covariance()[block.where, block.where]
        if self.lens is not None and block.held:
            return lens_off(self._camera, self.lens, block, covariance, carry.camera)
        if name == term_block(self._camera):
            return Event(EventKind.LENS_TERM_MISSING, self._camera)
        return known_off(name, block.values, np.sqrt(np.diag(covariance)))

    @property
    def axes_apart(self) -> bool:
        """Whether the axes of the accelerometer are known to be apart, or it is asked for."""
        return model_selection.SIZE_EFFECT in self._off

    @property
    def lens_off(self) -> bool:
        """Whether images contradict the fixed lens beyond doubt."""
        return lens_block(self._camera) in self._off

    def axis_changed(self) -> None:
        """What was seen of a readout was seen with the wrong axis."""
        self.rolling = self._rolling_known

    @staticmethod
    def rolls(carry: MarginalPrior, factor: float = 1.0) -> bool:
        """Whether a readout is beyond doubt; `factor`: measured variance over the stated one."""
        sigma_s = float(np.sqrt(factor)) * carry.sigma(carry.layout.camera.readout)
        return abs(carry.camera.readout_s) > SURE_SIGMAS * sigma_s

    def reason(self, carry: MarginalPrior, factor: float, *, believed: bool) -> str:
        """What may not be as it is taken to be, in words; empty where nothing speaks for it.

        For `believed` see `model_selection.in_doubt`.
        """
        imu, enough = model_selection.IMU, 0.5 if believed else OFF
        if imu not in self._off and not_zero(self._weights(carry, factor), imu) > enough:
            return model_selection.IN_DOUBT[imu]
        if not self.drifting:
            apart = sum(c.probability for c in self.clocks(carry, factor) if c.drifts)
            if apart > 0.5 or (apart > OFF and not believed):
                return CLOCKS_IN_DOUBT
        return ""

    def clocks(self, carry: MarginalPrior, factor: float) -> list[Clock]:
        """Hypotheses about the clocks, with probabilities; asked several times about the same carry."""
        self._began_s = min(self._began_s, carry.t_cam_s)
        given = factor, self.stamp_sigma_s, carry.t_cam_s - self._began_s, self.drifting
        if self._asked is None or self._asked[0] is not carry or self._asked[1] != given:
            self._asked = carry, given, what_happened(carry, *given[:3], drifting=self.drifting)
        return self._asked[2]

    def window_done(self, carry: MarginalPrior, factor: float) -> tuple[MarginalPrior, list[Event]]:
        """Decide, at the end of a window, what happened to the clocks; make room for another change.

        A step within a window looks like a drift at first. So windows after it must show which one it was.

        Args:
            carry: Out of the window.
            factor: Measured variance over the stated one.

        Returns:
            What goes on, and what is announced.
        """
        clocks = self.clocks(carry, factor)
        if not clocks:
            return carry, []
        complete = len(carry.jump_t_s)
        events, seen = self._news_of_drift(carry, clocks, complete), _shown(clocks, complete)
        rate = sum(c.probability for c in seen if c.rate)
        step = sum(c.probability for c in seen if c.jump >= 0 and not c.rate)
        if rate + step < SURE or max(rate, step) < 1.0 - OFF:
            return forgotten(carry, clocks), events
        likely = max(clocks, key=lambda c: c.probability)
        if not likely.rate:
            events.append(Event(EventKind.TIMESHIFT_STEPPED, self._camera, stepped_s(carry, likely)))
        elif carry.jump_t_s[likely.jump] not in self._announced_s:
            kind = EventKind.CLOCK_WANDER if self.drifting else EventKind.CLOCK_DRIFT
            events.append(self._drift(kind, carry, clocks))
        return settled(carry, clocks), events

    def _news_of_drift(self, carry: MarginalPrior, clocks: list[Clock], complete: int) -> list[Event]:
        """Announce clocks that surely drift; `complete`: windows that follow a jump and will not grow."""
        if self.drifting or sum(c.probability for c in _shown(clocks, complete) if c.drifts) < SURE:
            return []
        return [self._drift(EventKind.CLOCK_DRIFT, carry, clocks)]

    def _drift(self, kind: EventKind, carry: MarginalPrior, clocks: list[Clock]) -> Event:
        """The clocks drift, from now on for sure; the announcement."""
        self.drifting, self._announced_s = True, carry.jump_t_s
        (d, P), at = over_clocks(carry, clocks), carry.layout.camera.skew
        assert at is not None  # or there would be no clocks
        return Event(kind, self._camera, float(carry.camera.skew + d[at]), float(np.sqrt(P[at, at])))

    def settled(self, carry: MarginalPrior, factor: float) -> MarginalPrior:
        """What is known without the unknowns of past changes: the mixture over what may have happened."""
        return settled(carry, self.clocks(carry, factor))

    def weighed(self, carry: MarginalPrior, factor: float, compared: bool) -> ReportedModels:
        """How likely each model is, for the report; the same object as long as nothing has changed.

        Arguments as for `watch`.
        """
        given = factor, compared, self.stamp_sigma_s, self.drifting, self.rolling, frozenset(self._off)
        if self._reported is None or self._reported[0].carry is not carry or self._reported[1] != given:
            self._reported = self._models(carry, factor, compared), given
        return self._reported[0]

    def _models(self, carry: MarginalPrior, factor: float, compared: bool) -> ReportedModels:
        weights = self._weights(carry, factor)
        specified = max(weights, key=len)
        if not compared and weights[specified] < 0.5:
            others = 0.5 / max(1.0 - weights[specified], 1e-300)
            weights = {true: 0.5 if true == specified else others * p for true, p in weights.items()}
        every = self._blocks(carry)
        return ReportedModels(
            carry,
            factor,
            tuple(self.clocks(carry, factor)),
            every,
            weights,
            asked=self.asked,
            rolling=self.rolling,
        )

    def _weights(self, carry: MarginalPrior, factor: float) -> Weights:
        """Probability of each hypothesis about the imu, named by what is as specified; asked as `clocks` is.

        Where windows disagree although all is free, it is the images, and what they say about the imu is
        worth less by as much again.
        """
        given = factor, frozenset(self._off)
        if self._weighed is None or self._weighed[0] is not carry or self._weighed[1] != given:
            doubtful = {name: block for name, block in self._blocks(carry).items() if name not in self._off}
            self._weighed = carry, given, hypotheses(carry.S, doubtful, factor**2)
        return self._weighed[2]

    def _blocks(self, carry: MarginalPrior) -> dict[str, Block]:
        """What is estimated apart from the calibration, by its name in `CalibrationOptions.estimate`."""
        found = model_selection.imu_and_lenses(carry.layout, carry.imu[1:], {self._camera: carry.camera})
        if carry.camera.term and self.lens is None:
            term = model_selection.lens_term(carry.layout, self._camera, carry.camera, held=True)
            found[term_block(self._camera)] = term
        return found
