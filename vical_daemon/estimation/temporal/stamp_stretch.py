"""Whether orientations fit a gyro after all if one of the two clocks ran at another rate.

Stamps made by counting (frame number over a nominal rate, a crystal of another nominal frequency) stretch
time by per cents. Turns then agree nowhere for long, and what is noticed first are rotations that do not
fit. Before the rotations are blamed, the start is tried again with stretched stamps.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.temporal.rotation_curves import RotationCurve
from vical_daemon.estimation.temporal.rotation_start import (
    Start,
    agreement_scale,
    coarse_start,
    shift_costs,
)
from vical_daemon.estimation.temporal.rotation_turns import MIN_PAIRS, camera_turns

_MOST = 0.22
_STEP, _FINE = 0.02, 0.0025
_GRID_S = 0.02
_LONGEST_S = 12.0  # with more data the grid of stretches would have to be finer
_TURNS = 80  # enough to tell factors apart
_AGREE = 0.6
BETTER = 0.6  # misfit over that of the data as they are


def estimate_clock_rate(
    curve: RotationCurve, t_cam_s: FloatArray, q_world_cam: FloatArray, shifts_s: tuple[float, float]
) -> float | None:
    """Find the factor by which the camera's stamps must be divided to agree with the curve.

    Args:
        curve: The imu's orientation.
        t_cam_s: Camera stamps, increasing, s, shape (n,).
        q_world_cam: Camera orientations, shape (n, 4).
        shifts_s: Lowest and highest shift to look at, s.

    Returns:
        The factor (1.05: the camera's stamps advance by 1.05 s in each of the imu's seconds), at least 1 %
        off one; None where no factor up to 22 % off makes the rotations agree.
    """
    middle = float(t_cam_s[len(t_cam_s) // 2])
    keep = np.abs(t_cam_s - middle) < 0.5 * _LONGEST_S
    t, q = t_cam_s[keep] - middle, q_world_cam[keep]
    shifts = np.arange(shifts_s[0], shifts_s[1] + _GRID_S, _GRID_S)

    def cost(factor: float) -> float:
        stamps = middle + t / factor
        turns = camera_turns(stamps, q, _TURNS)
        if len(turns.first) < MIN_PAIRS:
            return 1.0
        return float(shift_costs(curve, stamps, turns, shifts, agreement_scale(turns)).min())

    coarse = 1.0 + np.arange(-_MOST, _MOST + 0.5 * _STEP, _STEP)
    best = float(coarse[np.argmin([cost(f) for f in coarse])])
    fine = best + np.arange(-3, 4) * _FINE * 2.0
    best = float(fine[np.argmin([cost(f) for f in fine])])
    if abs(best - 1.0) < 0.01:
        return None
    start, plain = (coarse_start(curve, middle + t / factor, q, shifts_s) for factor in (best, 1.0))
    if start is None or not _agrees(start):
        return None
    if plain is not None and not plain.mirrored and start.misfit_share > BETTER * plain.misfit_share:
        return None  # noisy orientations fit as badly at any factor
    return best


def _agrees(start: Start) -> bool:
    """Size and direction of most turns agree."""
    return start.agreement > _AGREE and not start.mirrored and start.misfit_rad < 0.5 * start.typical_rad
