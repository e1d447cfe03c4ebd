"""Images of a rolling shutter as if all rows had been taken with the middle one: for starts.

A row (or a column) is taken `readout * (v / height - 1/2)` after the stamp; meanwhile its corners move as
they do from the image before to the image after. The filter needs none of this: there each row has its own
instant.
"""

from __future__ import annotations

from itertools import pairwise

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
    steps = [_step(a, b) for a, b in pairwise(frames)]
    out: Frames = []
    for (t_s, frame), before, after in zip(frames[1:-1], steps[:-1], steps[1:], strict=True):
        speed = np.zeros((len(frame.ids), 2))
        count = np.zeros(len(frame.ids))
        for ids, px_per_s in (before, after):
            _, mine, theirs = np.intersect1d(frame.ids, ids, assume_unique=True, return_indices=True)
            speed[mine] += px_per_s[theirs]
            count[mine] += 1.0
        late_s = readout_s * read_share(frame.uv_px, resolution, axis)
        uv = frame.uv_px - late_s[:, None] * speed / np.maximum(count, 1.0)[:, None]
        out.append((t_s, PointsFrame(frame.camera, frame.t_cam_ns, frame.ids, uv, frame.sigma_px)))
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
