"""A change that was decided, until the images of a few seconds have confirmed it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import ACCEL_BIAS, GYRO_BIAS
from vical_daemon.estimation.selection import clock_drift
from vical_daemon.estimation.significance import LIKELY_SIGMAS
from vical_daemon.estimation.status.motion_levels import MotionLevels
from vical_daemon.estimation.status.mounting_changes import IRRELEVANT_PX, IRRELEVANT_S
from vical_daemon.estimation.status.recent_past import BEFORE_S
from vical_daemon.estimation.status.status_evaluator import StatusEvaluator
from vical_daemon.estimation.status.what_jumped import MOVED, Part


class Known(NamedTuple):
    """What is known of a camera that may step.

    Attributes:
        t_s: When, s.
        intrinsics: fx fy cx cy, px, shape (4,).
        intrinsics_sigma: As reported, but for what stretches disagree, px, shape (4,); zeros: not estimated.
        timeshift_s: Time shift, s.
        timeshift_sigma_s: As reported, s.
        biases: Of gyro, rad/s, and accelerometer, m/s^2, shape (6,).
        biases_sigma: Likewise, as the filter knows them, times the root of how long errors of images last.
    """

    t_s: float
    intrinsics: FloatArray
    intrinsics_sigma: FloatArray
    timeshift_s: float
    timeshift_sigma_s: float
    biases: FloatArray
    biases_sigma: FloatArray

    @classmethod
    def of(cls, f: CalibrationFilter) -> dict[str, Known]:
        """As a filter knows its cameras."""
        out, sigmas = {}, f.sigmas()
        biases = np.concatenate([f.state.gyro_bias, f.state.accel_bias])
        biases_sigma = np.concatenate([sigmas[GYRO_BIAS], sigmas[ACCEL_BIAS]])
        for name, camera in f.state.cameras.items():
            where, spread = f.layout.cameras[name], math.sqrt(f.consistency[name].factor)
            lens = np.zeros(4) if where.intrinsics is None else spread * sigmas[where.intrinsics]
            shift_s = 0.0 if where.timeshift is None else spread * float(sigmas[where.timeshift])
            shift = camera.timeshift_s, shift_s
            of_biases = biases, spread * biases_sigma
            out[name] = cls(f.state.t_s, camera.intrinsics.copy(), lens, *shift, *of_biases)
        return out


MOST_CHANGES = 2
"""Decided in a row: the time shift, say, and then what orientations do not show. A third: none is right."""


@dataclass(frozen=True, slots=True)
class PendingChange:
    """What was decided last.

    Attributes:
        part: The one that explains the images best.
        possible: See `Found`.
        camera: The one whose images did not fit.
        at_s: When it was decided, s.
        before: Cameras just before the change.
        number: How many in a row have been decided so far, none of them confirmed.
    """

    part: Part
    possible: frozenset[Part]
    camera: str
    at_s: float
    before: Mapping[str, Known]
    number: int = 1

    def confirmed(self, t_s: float) -> bool:
        """Whether images have not contradicted it for long enough."""
        return t_s > self.at_s + BEFORE_S

    @property
    def moved(self) -> bool:
        """Whether a camera may have moved."""
        return bool(self.possible & MOVED)

    @property
    def shift_stepped(self) -> bool:
        """Whether it is a step of the time shift."""
        return self.part is Part.SHIFT and not self.moved

    def tell(self, f: CalibrationFilter, known: CalibrationFilter, to: StatusEvaluator, why: Cause) -> None:
        """Say at once what need not be confirmed.

        Args:
            f: The filter that knows of the change.
            known: The filter from surely before it.
            to: Who announces it.
            why: What speaks for it.
        """
        to.jumped(f.state.t_s)
        if self.moved:
            to.may_have_moved(known, why, sure=self.possible <= MOVED)
        elif self.part is Part.TARGET:
            to.announce(Event(EventKind.POSE_LOST))
        elif self.part is Part.DRIFT:
            to.announce(clock_drift.let_drift(f, self.camera, anew=True), once=f"wander {self.camera}")

    def after(self, earlier: PendingChange | None) -> PendingChange:
        """This change if another was pending: what is known is compared with what it was before both."""
        return self if earlier is None else replace(self, before=earlier.before, number=earlier.number + 1)

    def news(self, f: CalibrationFilter, motion: MotionLevels) -> Event | None:
        """What is to be announced of a change that is confirmed, and was not announced yet.

        Nothing if all is as it was before, within what both leave open: images were wrong for a while. Nor
        if the IMU's stamps may have stepped instead (its driver says how well it knows them now), or if the
        rig moves otherwise than before, and biases differ by no more than they may by that.

        Args:
            f: The filter.
            motion: Of the rig.
        """
        now, before = Known.of(f)[self.camera], self.before[self.camera]
        step_s = now.timeshift_s - before.timeshift_s
        sigmas_s = now.timeshift_sigma_s, before.timeshift_sigma_s, f.stamp_sigma_s
        open_s = LIKELY_SIGMAS * math.hypot(*sigmas_s)
        if self.shift_stepped and abs(step_s) > max(open_s, IRRELEVANT_S):
            return Event(EventKind.TIMESHIFT_STEPPED, self.camera, step_s)
        step_px = now.intrinsics - before.intrinsics
        open_px = LIKELY_SIGMAS * np.hypot(now.intrinsics_sigma, before.intrinsics_sigma)
        stepped = np.abs(step_px) > np.maximum(open_px, IRRELEVANT_PX)
        if self.part is Part.LENS and not self.moved and stepped.any():
            return Event(EventKind.LENS_STEPPED, self.camera, float(step_px[0]))
        step = now.biases - before.biases
        by_motion = motion.bias_sigmas(before.t_s, self.at_s)
        open_step = LIKELY_SIGMAS * np.hypot(np.hypot(now.biases_sigma, before.biases_sigma), by_motion)
        if self.part is Part.BIASES and not self.moved and (np.abs(step) > open_step).any():
            return Event(EventKind.BIASES_STEPPED, value=float(np.linalg.norm(step[:3])))
        return None
