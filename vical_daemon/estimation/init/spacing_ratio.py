"""Whether the columns of a printed target are further apart, compared with its rows, than its file says.

A printer that fits a page to the paper may stretch it in one direction, and a file may have a slip in one
spacing. Images alone show it once the camera is turned about its optical axis: focal lengths of x and y
would take it up in one position, but not in another. A small difference is left to the filter, whose target
has a mode for it (`TargetModes`); a larger one would leave no start.
"""

from __future__ import annotations

import math

import numpy as np

from vical_daemon.estimation.geometry.camera_model import project_jacobians
from vical_daemon.estimation.init.intrinsics_start import LensFit, along
from vical_daemon.estimation.init.readout_start import ROUNDS, lens_fit, most_of_a_readout
from vical_daemon.estimation.measurements import FloatArray, Frames
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.model.target_modes import EXPECTED
from vical_daemon.estimation.significance import SURE_SIGMAS

_TRIED = (-0.1, -0.05, 0.05, 0.1)  # logarithms of ratios; with another one a lens may run away
_FAR = 2.0 * max(_TRIED)  # of the best of these no step should lead so far
_LEAST = SURE_SIGMAS * 2.0 * EXPECTED
"""Logarithm of the least ratio: one side longer and the other shorter by what the filter does not expect."""


def stretched(target: FloatArray, ratio: float) -> FloatArray:
    """The target with columns further apart and rows closer together, its area as before; shape (n, 3)."""
    root = np.sqrt(ratio)
    return np.asarray(target * np.array([root, 1.0 / root, 1.0]))


def spacing_ratio(
    frames: Frames, lens: CameraState, target: FloatArray, fit: LensFit | None, readout_s: float = 0.0
) -> float:
    """Distance of columns over that of rows, over the same in the file; 1 unless it surely is another.

    Args:
        frames: (stamp in s, points), in order.
        lens: A guess; its focal lengths of x and y may differ.
        target: Points of the target as in its file, m, shape (n, 3).
        fit: Of lens and poses to these frames; None: there is none.
        readout_s: With which it was made, s.
    """
    if fit is None:
        return 1.0
    step, bend = _step(fit, lens, target)
    if abs(step) < _LEAST or bend * step**2 < most_of_a_readout(frames, lens, target, fit):
        return 1.0
    fits = {0.0: fit}
    for tried in _TRIED:
        other = lens_fit(frames, lens, stretched(target, math.exp(tried)), readout_s)
        if other is not None:
            fits[tried] = other
    found = min(fits, key=lambda x: fits[x].rms_px)
    fit = fits[found]
    for _ in range(ROUNDS):
        step, bend = _step(fit, lens, stretched(target, math.exp(found)))
        if abs(step) < EXPECTED:  # it moves the target by less than the filter allows for in any case
            surely = found**2 * bend > SURE_SIGMAS**2 * fit.squares / fit.numbers
            return math.exp(found) if surely and abs(found) > _LEAST else 1.0
        if abs(step) > _FAR:
            return 1.0
        found += step
        fit = lens_fit(frames, lens, stretched(target, math.exp(found)), readout_s)
        if fit is None:
            return 1.0
    return 1.0


def _step(fit: LensFit, lens: CameraState, target: FloatArray) -> tuple[float, float]:
    """Change of the logarithm with which images fit best, and half the second derivative by it, px^2."""
    [(slope, bend)] = along(fit, lens, target, [_moves(fit, lens, target)])
    return (-slope / bend, bend) if bend > 0.0 else (0.0, 0.0)


def _moves(fit: LensFit, lens: CameraState, target: FloatArray) -> FloatArray:
    """How the residuals of all views move with the logarithm of the ratio, px, shape (n, 2)."""
    both = np.stack([target, target * np.array([0.5, -0.5, 0.0])])  # points, and how they move
    seen = [both[:, v.ids] @ R.T for v, (R, _) in zip(fit.views, fit.poses, strict=True)]
    points = np.concatenate([x[0] + p for x, (_, p) in zip(seen, fit.poses, strict=True)])
    by_point = project_jacobians(points, fit.theta[:4], fit.theta[4:], lens.distortion_model)[1]
    return np.asarray(-np.matvec(by_point, np.concatenate([x[1] for x in seen])))
