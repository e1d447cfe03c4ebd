"""The readout of a rolling shutter to start with: the one with which a board in motion is flattest.

A board that moves is bent by a rolling shutter as no pose and no lens bends it. Images turned upside down are
read from below: their readout is negative. Images turned upright from a phone's side are read by columns.
Corners move in proportion to the readout (`at_middle_row`), so that the squared residuals of a lens and poses
that follow are nearly a parabola of it. (The filter needs none of this: there each row has its own instant.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.init.intrinsics_start import LensFit, along, fit_lens, spread
from vical_daemon.estimation.measurements import COLUMNS, ROWS, FloatArray, Frames, IntArray, PointsFrame
from vical_daemon.estimation.model.camera_rays import read_share
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.significance import SURE_SIGMAS

_MAX_STEP_S = 0.25  # corners move straight for so long; over 0.3 s a hand looks like a rolling shutter
ROUNDS = 4  # lens and readout, or another number that the images show, in turn
_SHORT_S = 0.004  # readout that is compared with none, see `looks_rolling`
_BEYOND_DOUBT = 100.0  # a global shutter on a real lens reaches 76 (EuRoC, 4 s from 55 s on)


def at_middle_row(frames: Frames, readout_s: float, resolution: tuple[int, int], axis: str = ROWS) -> Frames:
    """Corners where they were when the middle row was taken.

    A row (or a column) is taken `readout * (v / height - 1/2)` after the stamp; meanwhile its corners move as
    they do from the image before to the image after.

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


def readout(frames: Frames, lens: CameraState, target: FloatArray, given_s: float) -> float:
    """The readout to start with, s: as given unless the board is significantly flatter with another one.

    Args:
        frames: (stamp in s, points), in order.
        lens: A guess.
        target: Points of the target, m, shape (n, 3).
        given_s: First row to last, s.
    """
    found_s = given_s
    for _ in range(ROUNDS):
        fit = lens_fit(frames, lens, target, found_s)
        if fit is None:
            return given_s
        [(slope, bend)] = _parabolas(frames, lens, target, fit, [lens.readout_axis])
        gain = slope**2 / bend
        if found_s == given_s and not gain > SURE_SIGMAS**2 * (fit.squares - gain) / fit.numbers:
            return given_s
        found_s -= slope / bend
    return found_s


def likely_axis(frames: Frames, lens: CameraState, target: FloatArray) -> str:
    """`ROWS` or `COLUMNS`: which of them, read one after the other, make the board flatter.

    Arguments as for `readout`.
    """
    fit = lens_fit(frames, lens, target)
    if fit is None:
        return ROWS
    by_rows, by_columns = _parabolas(frames, lens, target, fit, (ROWS, COLUMNS))
    return max((by_rows, ROWS), (by_columns, COLUMNS), key=lambda x: x[0][0] ** 2 / x[0][1])[1]


def looks_rolling(frames: Frames, lens: CameraState, target: FloatArray, fit: LensFit) -> str:
    """Whether the board is flatter beyond doubt if rows, or columns, are read over 4 ms, not all at once.

    Returns `ROWS`, `COLUMNS`, or empty: no rolling shutter shows. It does where the readout is longer than
    2 ms and the motion fast enough (hands: 5 to 8 ms). Arguments as for `readout`; `fit`: of them.
    """
    parabolas = _parabolas(frames, lens, target, fit, (ROWS, COLUMNS))
    gains = [2.0 * abs(slope) * _SHORT_S - bend * _SHORT_S**2 for slope, bend in parabolas]
    gain, axis = max(zip(gains, (ROWS, COLUMNS), strict=True))
    surely = gain > _BEYOND_DOUBT * (fit.squares - gain) / fit.numbers
    return axis if surely else ""


def most_of_a_readout(frames: Frames, lens: CameraState, target: FloatArray, fit: LensFit) -> float:
    """What another readout, of rows or of columns, would take off the squared residuals, px^2.

    Arguments as for `looks_rolling`.
    """
    return max(slope**2 / bend for slope, bend in _parabolas(frames, lens, target, fit, (ROWS, COLUMNS)))


def lens_fit(frames: Frames, lens: CameraState, target: FloatArray, readout_s: float = 0.0) -> LensFit | None:
    """A lens and poses adjusted to spread-out images whose rows are read like that; None: too few."""
    views = [frame for _, frame in at_middle_row(frames, readout_s, lens.resolution, lens.readout_axis)]
    left_out = 1 if readout_s else 0  # at either end
    chosen = spread(views, lens)
    fit = fit_lens([views[k] for k in chosen], lens, target)
    if fit is None or not np.isfinite(fit.rms_px):
        return None
    return fit._replace(which=[chosen[k] + left_out for k in fit.which])


def _parabolas(
    frames: Frames, lens: CameraState, target: FloatArray, fit: LensFit, axes: Sequence[str]
) -> list[tuple[float, float]]:
    """Half the first and second derivative of the squared residuals by the readout, px^2/s and px^2/s^2."""
    own = np.concatenate(
        [
            np.hstack([frames[k][1].uv_px, speed])[np.isin(frames[k][1].ids, view.ids)]
            for k, view, speed in zip(fit.which, fit.views, corner_speeds(frames, fit.which), strict=True)
        ]
    )
    moves = [-read_share(own[:, :2], lens.resolution, axis)[:, None] * own[:, 2:] for axis in axes]
    # without any motion a second of readout moves nothing
    return [(slope, max(bend, 1.0)) for slope, bend in along(fit, lens, target, moves)]
