"""The readout of a rolling shutter to start with: the one with which a board in motion is flattest.

A board that moves is bent by a rolling shutter as no pose and no lens bends it. Images turned upside down are
read from below: their readout is negative. Images turned upright from a phone's side are read by columns.
Corners move in proportion to the readout (`at_middle_row`), so that the squared residuals of a lens and poses
that follow are nearly a parabola of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vical_daemon.estimation.init.intrinsics_start import LensFit, along, fit_lens, spread
from vical_daemon.estimation.init.rolling_shutter_correction import at_middle_row, corner_speeds
from vical_daemon.estimation.measurements import COLUMNS, ROWS, FloatArray, Frames
from vical_daemon.estimation.model.camera_rays import read_share
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.significance import SURE_SIGMAS

_ROUNDS = 3  # lens and readout in turn
_SHORT_S = 0.004  # readout that is compared with none, see `looks_rolling`
_BEYOND_DOUBT = 100.0  # a global shutter on a real lens reaches 76 (EuRoC, 4 s from 55 s on)


def readout(frames: Frames, lens: CameraState, target: FloatArray, given_s: float) -> float:
    """The readout to start with, s: as given unless the board is significantly flatter with another one.

    Args:
        frames: (stamp in s, points), in order.
        lens: A guess.
        target: Points of the target, m, shape (n, 3).
        given_s: First row to last, s.
    """
    found_s = given_s
    for _ in range(_ROUNDS):
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
