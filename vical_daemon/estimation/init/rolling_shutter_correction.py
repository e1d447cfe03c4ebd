"""Images of a rolling shutter as if all rows had been taken with the middle one: for starts.

A row (or a column) is taken `readout * (v / height - 1/2)` after the stamp; meanwhile its corners move as
they do from the image before to the image after. The filter needs none of this: there each row has its own
instant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import ROWS, FloatArray, Frames, IntArray, PointsFrame
from vical_daemon.estimation.model.camera_rays import read_share

_MAX_STEP_S = 0.25  # corners move straight for so long; over 0.3 s a hand looks like a rolling shutter


def at_middle_row(frames: Frames, readout_s: float, resolution: tuple[int, int], axis: str = ROWS) -> Frames:
    """Corners where they were when the middle row was taken.

    Args:
        frames: (stamp in s, points), in order; ids tell which corner is which.
        readout_s: First row to last, s; 0: nothing is changed.
        resolution: width, height, px.
        axis: See `read_share`.

    Returns:
        The same frames but the first and the last, of which only half the motion is known.
    """
    if not readout_s:
        return frames
    speeds = corner_speeds(frames, range(1, len(frames) - 1))
    return [
        (t_s, replace(frame, uv_px=frame.uv_px - readout_s * share[:, None] * speed))
        for (t_s, frame), speed in zip(frames[1:-1], speeds, strict=True)
        for share in [read_share(frame.uv_px, resolution, axis)]
    ]


def corner_speeds(frames: Frames, which: Sequence[int]) -> list[FloatArray]:
    """How fast the corners of some of the frames move, px/s, shapes (n, 2); zero where nothing shows it.

    Args:
        frames: (stamp in s, points), in order.
        which: Their places. Of the first and the last, only half the motion is known, and none is taken.
    """
    inner = {k for k in which if 0 < k < len(frames) - 1}
    steps = {k: _step(frames[k - 1], frames[k]) for k in inner | {k + 1 for k in inner}}
    out = []
    for k in which:
        speed = np.zeros((len(frames[k][1].ids), 2))
        count = np.zeros(len(speed))
        if k not in inner:
            out.append(speed)
            continue
        before, after = steps[k], steps[k + 1]
        for mine, px_per_s in ((before.second, before.px_per_s), (after.first, after.px_per_s)):
            speed[mine] += px_per_s
            count[mine] += 1.0
        out.append(speed / np.maximum(count, 1.0)[:, None])
    return out


class _Step(NamedTuple):
    """Corners that two images show: their places in each, shapes (n,), and their speed, px/s, (n, 2)."""

    first: IntArray
    second: IntArray
    px_per_s: FloatArray


def _step(a: tuple[float, PointsFrame], b: tuple[float, PointsFrame]) -> _Step:
    dt_s = b[0] - a[0]
    if not 0.0 < dt_s < _MAX_STEP_S:
        none = np.zeros(0, np.intp)
        return _Step(none, none, np.zeros((0, 2)))
    _, first, second = np.intersect1d(a[1].ids, b[1].ids, assume_unique=True, return_indices=True)
    return _Step(first, second, (b[1].uv_px[second] - a[1].uv_px[first]) / dt_s)
