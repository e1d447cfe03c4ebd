"""Images with tracks that wait for inertial data: cleaned, and taken in order up to a hole."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.plausible import usable_points

STEP_S = 1.5  # the window is adjusted again after so much new data; images further apart are not tied to it
SLACK_S = 1e-3  # stamps are not quite even

Stamped = tuple[float, PointsFrame]


class Ready(NamedTuple):
    """What can be taken into a window.

    Attributes:
        frames: (stamp in s, tracks), in order.
        gap_follows: They are the last before a hole.
        hole_s: Length of a hole that begins at once, s; 0: none.
    """

    frames: list[Stamped]
    gap_follows: bool = False
    hole_s: float = 0.0


def ready(waiting: Sequence[Stamped], begin_s: float, end_s: float) -> Ready:
    """Choose the images to go on with: a step's worth at most, up to the first hole.

    Args:
        waiting: All that came since, in order.
        begin_s: Stamp of the window's last image, s.
        end_s: Stamp up to which inertial data reach, s.
    """
    before, out = begin_s, list[Stamped]()
    for t, frame in waiting:
        if t > end_s or before - begin_s > STEP_S - SLACK_S:
            break
        if t - before > STEP_S:
            return Ready(out, gap_follows=True, hole_s=0.0 if out else t - before)
        out.append((t, frame))
        before = t
    silent = not out and bool(waiting) and end_s - begin_s > 2.0 * STEP_S
    return Ready(out, hole_s=end_s - begin_s if silent else 0.0)


def cleaned(frame: PointsFrame) -> PointsFrame:
    """Return the tracks at possible pixels, each identity once."""
    ok = usable_points(frame)
    return frame.only(ok)
