"""Guidance: what the operator is to do next, and which directions are not known, as data.

`wording` turns both into text; the live page draws the axes. Axes are those of the camera: x right, y down,
z along the optical axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

Axis = Literal["x", "y", "z"]
AXES: tuple[Axis, Axis, Axis] = ("x", "y", "z")
Edge = Literal["left", "right", "top", "bottom"]


class Verb(StrEnum):
    """What is to be done."""

    NONE = ""
    TURN = "turn"
    """Turn the rig about `Guidance.axes`."""
    TURN_FASTER = "turn_faster"
    """The same, faster."""
    TURN_TO_AND_FRO = "turn_to_and_fro"
    """The same, changing direction often."""
    TURN_AND_MOVE = "turn_and_move"
    """Turn about the axes while moving along them."""
    SHOW = "show"
    """Show the target at `Guidance.edges` of the image of `Guidance.camera`."""


class Lack(StrEnum):
    """What the motion so far lacks."""

    NONE = ""
    STILL = "still"
    SLOW = "slow"
    ONE_AXIS = "one_axis"
    STEADY_RATE = "steady_rate"
    FAST_CHANGES = "fast_changes"
    EDGES = "edges"


@dataclass(frozen=True, slots=True)
class Guidance:
    """What to do next.

    Attributes:
        verb: What; `NONE`: nothing is missing.
        axes: About which axes to turn (and move along, for `TURN_AND_MOVE`).
        lack: What the motion so far lacks.
        turned_about: The one axis about which the rig turned so far, unit length, 3 numbers; empty: not
            known, or it turned about several.
        rate_rps: How fast it turns, RMS, rad/s; None: no matter.
        camera: Whose image, for `SHOW`; whose axes, if there are several cameras.
        edges: Which edges of that image have not seen the target.
    """

    verb: Verb = Verb.NONE
    axes: tuple[Axis, ...] = ()
    lack: Lack = Lack.NONE
    turned_about: tuple[float, ...] = ()
    rate_rps: float | None = None
    camera: str = ""
    edges: tuple[Edge, ...] = ()

    def __bool__(self) -> bool:
        """Whether there is anything to do."""
        return self.verb is not Verb.NONE


class Block(StrEnum):
    """Part of a calibration."""

    LEVER_ARM = "lever_arm"
    ROTATION = "rotation"
    TIMESHIFT = "timeshift"


@dataclass(frozen=True, slots=True)
class WeakDirection:
    """One direction of a calibration that is not known well enough, and what would reveal it.

    Attributes:
        block: Part of the calibration.
        axis_cam: The direction in the camera frame, unit length, 3 numbers; zeros for the time shift.
        sigma: Standard deviation along it, m, rad or s.
        limit: Above which sigma it counts as unknown, same unit.
        guidance: The motion that would reveal it.
    """

    block: Block
    axis_cam: tuple[float, float, float]
    sigma: float
    limit: float
    guidance: Guidance

    @property
    def excess(self) -> float:
        """Its sigma over the limit."""
        return self.sigma / self.limit


def of_camera(weak: WeakDirection, camera: str) -> WeakDirection:
    """The same direction, with the name of the camera whose axes it is about: one of several."""
    return replace(weak, guidance=replace(weak.guidance, camera=camera))
