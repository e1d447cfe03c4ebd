"""A change that was decided, until the images of a few seconds have confirmed it.

Images may be wrong for a while (a hand before the board, a lens that hunts), and a jump of some part explains
them. If the images after that fit what was known before, nothing has changed, and the filter goes on from
there.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import Frames
from vical_daemon.estimation.selection import clock_drift
from vical_daemon.estimation.status.change_watch import IMAGES
from vical_daemon.estimation.status.mounting_changes import IRRELEVANT_PX, IRRELEVANT_S
from vical_daemon.estimation.status.recent_past import BEFORE_S
from vical_daemon.estimation.status.status_evaluator import StatusEvaluator
from vical_daemon.estimation.status.what_jumped import MOVED, Part, Step, lens_stepped


@dataclass(slots=True)
class PendingChange:
    """What was decided last.

    Attributes:
        part: The one that explains the images best.
        possible: See `Found`.
        camera: The one whose images did not fit.
        at_s: When it was decided, s.
        before: The filter just before the change.
        images: Since then, of all cameras, in order.
    """

    part: Part
    possible: frozenset[Part]
    camera: str
    at_s: float
    before: CalibrationFilter
    images: Frames

    def __post_init__(self) -> None:
        self.before = deepcopy(self.before)

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
        return self if earlier is None else replace(self, before=earlier.before, images=earlier.images)

    def news(self, f: CalibrationFilter) -> Event | None:
        """What is to be announced of a change that is confirmed, of filter `f`, and was not announced yet.

        Nothing if all is as it was before: images were wrong for a while.
        """
        now, before = (x.state.cameras[self.camera] for x in (f, self.before))
        step_s = now.timeshift_s - before.timeshift_s
        if self.shift_stepped and abs(step_s) > IRRELEVANT_S:
            return Event(EventKind.TIMESHIFT_STEPPED, self.camera, step_s)
        step_px = float(np.abs(now.intrinsics - before.intrinsics).max())
        if self.part is Part.LENS and not self.moved and step_px > IRRELEVANT_PX:
            return lens_stepped(self.before, f, self.camera)
        return None

    def undone(self, step: Step) -> CalibrationFilter | None:
        """The filter that knows of no change, after the images; None: it does not fit the latest, either.

        Args:
            step: Takes an image with a filter.
        """
        f, fits = deepcopy(self.before), list[bool]()
        for t_cam_s, frame in self.images:
            report = step(f, frame, t_cam_s)
            if frame.camera == self.camera:
                fits.append(report is not None and report.used)
        return f if len(fits) >= IMAGES and all(fits[-IMAGES:]) else None
