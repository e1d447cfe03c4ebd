"""Images with tracks that wait for inertial data: cleaned, thinned, and taken in order up to a hole."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.plausible import usable_points

STEP_S = 1.5  # the window is adjusted again after this much new data
SLACK_S = 1e-3  # stamps are not quite even
_MAX_GAP_S = 1.5  # images further apart are not tied by inertial data alone

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
        if t - before > _MAX_GAP_S:
            return Ready(out, gap_follows=True, hole_s=0.0 if out else t - before)
        out.append((t, frame))
        before = t
    silent = not out and bool(waiting) and end_s - begin_s > 2.0 * _MAX_GAP_S
    return Ready(out, hole_s=end_s - begin_s if silent else 0.0)


def cleaned(frame: PointsFrame) -> PointsFrame:
    """Return the tracks at possible pixels, each identity once."""
    ok = usable_points(frame)
    return PointsFrame(frame.camera, frame.t_cam_ns, frame.ids[ok], frame.uv_px[ok])


_LATEST = 31  # intervals that tell the rate


class Thinning:
    """Takes every n-th image, n by the camera's rate.

    Images are counted. To leave out an image because its stamp comes too soon after the last would be to
    choose by the stamp's error: with 1 ms of jitter, images stamped early went and images stamped late
    stayed, which bent the time shift by 0.1 ms.

    Args:
        most_hz: Images wanted per second, at most.
    """

    def __init__(self, most_hz: float) -> None:
        self._most_hz = most_hz
        self._intervals_s: deque[float] = deque(maxlen=_LATEST)
        self._before_s: float | None = None
        self._left_out = 0

    def takes(self, t_s: float) -> bool:
        """Whether to use the next image, stamped `t_s` (s, any origin, increasing)."""
        if self._before_s is not None:
            self._intervals_s.append(t_s - self._before_s)
        self._before_s = t_s
        self._left_out += 1
        if self._left_out < self._every():
            return False
        self._left_out = 0
        return True

    def _every(self) -> int:
        if not self._intervals_s:
            return 1
        intervals_s = sorted(self._intervals_s)
        last = len(intervals_s) - 1
        median_s = 0.5 * (intervals_s[last // 2] + intervals_s[(last + 1) // 2])
        return max(1, ceil(1.0 / (self._most_hz * median_s) - 1e-6))
