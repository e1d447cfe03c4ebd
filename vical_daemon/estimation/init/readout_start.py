"""The readout of a rolling shutter to start with: the one with which a board in motion is flattest.

A board that moves is bent by a rolling shutter as no pose and no lens bends it. Images turned upside down are
read from below: their readout is negative. Images turned upright from a phone's side are read by columns.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vical_daemon.estimation.init.intrinsics_start import (
    MOST_VIEWS,
    adjusted,
    estimate_intrinsics,
    fit_lens,
    spread,
)
from vical_daemon.estimation.init.rolling_shutter_correction import Frames, at_middle_row
from vical_daemon.estimation.init.target_poses import Lens
from vical_daemon.estimation.measurements import COLUMNS, ROWS, FloatArray, IntArray, PointsFrame
from vical_daemon.estimation.significance import SURE_SIGMAS

_TRIED_S = 0.008 * np.arange(6)
_SHORT_S = 0.004
_BEYOND_DOUBT = 100.0  # a global shutter on a real lens reaches 34


def readout(frames: Frames, lens: Lens, target: FloatArray, given_s: float) -> float:
    """The readout to start with, s: as given unless the board is significantly flatter with another one.

    Args:
        frames: (stamp in s, points), in order.
        lens: A guess.
        target: Points of the target, m, shape (n, 3).
        given_s: First row to last, s.
    """
    above, below = (_bent(frames, lens, target, float(r)) for r in (_TRIED_S[1], -_TRIED_S[1]))
    tried = np.unique([given_s, *(_TRIED_S if above <= below else -_TRIED_S)])
    squares = np.array([_bent(frames, lens, target, float(r)) for r in tried]) ** 2
    least = int(np.argmin(squares))
    was = squares[int(np.searchsorted(tried, given_s))]
    if not was - squares[least] > SURE_SIGMAS**2 * squares[least] / _numbers(frames):
        return given_s
    if not 0 < least < len(tried) - 1:
        return float(tried[least])
    around = slice(least - 1, least + 2)
    a, b, _ = np.polyfit(tried[around] - tried[least], squares[around], 2)
    return float(tried[least] - 0.5 * b / a)


def likely_axis(frames: Frames, lens: Lens, target: FloatArray) -> str:
    """`ROWS` or `COLUMNS`: with which of them, read over 8 ms, the board is flatter.

    Arguments as for `readout`.
    """
    tried = (-float(_TRIED_S[1]), float(_TRIED_S[1]))

    def bent(axis: str) -> float:
        return min(_bent(frames, replace(lens, readout_axis=axis), target, r) for r in tried)

    return min((ROWS, COLUMNS), key=bent)


def looks_rolling(frames: Frames, lens: Lens, target: FloatArray) -> str:
    """Whether the board is flatter beyond doubt if rows, or columns, are read over 4 ms, not all at once.

    Returns `ROWS`, `COLUMNS`, or empty: no rolling shutter shows. It does where the readout is longer than
    2 ms and the motion fast enough (hands: 5 to 8 ms). Arguments as for `readout`. The same corners are
    compared, each time from lens and poses that a first adjustment found.
    """
    tried = [(ROWS, 0.0), *((axis, r) for axis in (ROWS, COLUMNS) for r in (_SHORT_S, -_SHORT_S))]
    ways = [_upright(frames, r, replace(lens, readout_axis=axis)) for axis, r in tried]
    chosen = spread(ways[0], lens)
    fit = fit_lens([ways[0][k] for k in chosen], lens, target)
    if fit is None:
        return ""
    found = replace(lens, intrinsics=fit.theta[:4], distortion=fit.theta[4:])
    squares = []
    for way in ways:
        views = [_only(way[chosen[k]], v.ids) for k, v in zip(fit.which, fit.views, strict=True)]
        squares.append(adjusted(views, fit.poses, found, target)[2] ** 2)
    best = 1 + int(np.argmin(squares[1:]))
    numbers = 2.0 * sum(len(v.ids) for v in fit.views)
    surely = squares[0] - squares[best] > _BEYOND_DOUBT * squares[best] / numbers
    return tried[best][0] if surely else ""


def _only(frame: PointsFrame, ids: IntArray) -> PointsFrame:
    kept = np.isin(frame.ids, ids)
    return PointsFrame(frame.camera, frame.t_cam_ns, frame.ids[kept], frame.uv_px[kept])


def _numbers(frames: Frames) -> float:
    """How many numbers an adjustment over some of the frames has to explain."""
    sizes = [len(frame.ids) for _, frame in frames]
    return 2.0 * sum(sizes) * min(1.0, MOST_VIEWS / max(len(sizes), 1))


def _bent(frames: Frames, lens: Lens, target: FloatArray, readout_s: float) -> float:
    """RMS by which the images miss a flat board, px, if their rows are read like that."""
    fit = estimate_intrinsics(replace(lens), _upright(frames, readout_s, lens), target)
    return float("nan") if fit is None else fit.rms_px


def _upright(frames: Frames, readout_s: float, lens: Lens) -> list[PointsFrame]:
    """Images as if their rows had been taken at once; always without the first and the last.

    `at_middle_row` does not know how corners move there.
    """
    found = (
        at_middle_row(frames, readout_s, lens.resolution, lens.readout_axis) if readout_s else frames[1:-1]
    )
    return [frame for _, frame in found]
