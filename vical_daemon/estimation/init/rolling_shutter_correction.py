"""Images of a rolling shutter as if all rows had been taken with the middle one: for starts.

A row (or a column) is taken `readout * (v / height - 1/2)` after the stamp; meanwhile its corners move as
they do from the image before to the image after. The filter needs none of this: there each row has its own
instant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.measurements import ROWS, FloatArray, PointsFrame
from vical_daemon.estimation.model.camera_rays import read_share

Frames = list[tuple[float, PointsFrame]]

_MAX_STEP_S = 0.25  # images further apart do not tell how corners move


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
    inner = range(1, len(frames) - 1)
    return [
        (t_s, replace(frame, uv_px=frame.uv_px + readout_s * moved))
        for (t_s, frame), moved in zip(frames[1:-1], by_readout(frames, inner, resolution, axis), strict=True)
    ]


def by_readout(
    frames: Frames, which: Sequence[int], resolution: tuple[int, int], axis: str
) -> list[FloatArray]:
    """How `at_middle_row` moves the corners of some of the frames, by the readout, px/s, shapes (n, 2).

    Args:
        frames: (stamp in s, points), in order.
        which: Their places; not the first nor the last.
        resolution: width, height, px.
        axis: See `read_share`.
    """
    steps = {k: _step(frames[k - 1], frames[k]) for k in {m for at in which for m in (at, at + 1)}}
    out = []
    for k in which:
        frame = frames[k][1]
        speed = np.zeros((len(frame.ids), 2))
        count = np.zeros(len(frame.ids))
        for ids, px_per_s in (steps[k], steps[k + 1]):
            _, mine, theirs = np.intersect1d(frame.ids, ids, assume_unique=True, return_indices=True)
            speed[mine] += px_per_s[theirs]
            count[mine] += 1.0
        share = read_share(frame.uv_px, resolution, axis)
        out.append(-share[:, None] * speed / np.maximum(count, 1.0)[:, None])
    return out


def _step(
    a: tuple[float, PointsFrame], b: tuple[float, PointsFrame]
) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Which corners both images show, and how fast they move, px/s."""
    dt_s = b[0] - a[0]
    if not 0.0 < dt_s < _MAX_STEP_S:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    ids, first, second = np.intersect1d(a[1].ids, b[1].ids, assume_unique=True, return_indices=True)
    return ids, (b[1].uv_px[second] - a[1].uv_px[first]) / dt_s
