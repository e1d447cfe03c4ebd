"""What else could be wrong when rotations of two sensors do not fit: the usual mistakes are tried out.

Orientations may be inverted, the gyro mirrored (an axis of the wrong sign, two swapped), stamps stretched.
From the misfit alone these look alike: for small turns, inverted orientations are a mirrored mounting. So the
start is repeated with each mistake undone, and the one that makes the rotations fit is named.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.temporal.rotation_curves import RotationCurve
from vical_daemon.estimation.temporal.rotation_reference import Reference
from vical_daemon.estimation.temporal.rotation_start import Start, agreement_scale, coarse_start, shift_costs
from vical_daemon.estimation.temporal.rotation_turns import MIN_PAIRS, camera_turns

_CLEAR = 0.25  # misfit of turns over their size below which they fit
_AGREE = 0.6  # share of the turns that agree in size where stamps are no longer stretched
BETTER = 0.6  # misfit over that of the data as they are
_MOST = 0.22  # by which stamps may be stretched: 30 images a second counted as 25 are 0.2
_STEP, _FINE = 0.02, 0.0025  # between the factors tried; likewise about the best
_GRID_S = 0.02  # of the shifts tried with each factor
_LONGEST_S = 12.0  # of the data looked at: with more, the factors would have to be closer
_TURNS = 80  # enough to tell factors apart


def explain(
    reference: Reference,
    t_s: FloatArray,
    q_world_sensor: FloatArray,
    shifts_s: tuple[float, float],
    found: Start | None,
) -> str:
    """Name the mistake that, undone, makes the rotations fit.

    Args:
        reference: What the orientations should agree with.
        t_s: Stamps, increasing, s, shape (n,).
        q_world_sensor: Orientations, shape (n, 4).
        shifts_s: Lowest and highest shift to look at, s.
        found: The start that the data gave as they are.

    Returns:
        In words; empty where no mistake explains it.
    """
    inverted = _score(reference.start(t_s, so3.quat_conjugate(q_world_sensor), shifts_s)[0])
    reversed_axis = reference.mirrored()
    mirrored = _score(reversed_axis.start(t_s, q_world_sensor, shifts_s)[0] if reversed_axis else None)
    limit = min(_CLEAR, BETTER * _score(found))
    if inverted < min(limit, mirrored):
        other = "" if reversed_axis else " or of the reference"
        return (
            f"the orientations of the {reference.sensor}{other} are inverted: the world's in the sensor, "
            "not the sensor's in the world (with their inverses the rotations fit)"
        )
    if mirrored < limit:
        return (
            "the rotations are mirrored: one gyro axis has the wrong sign, or two axes are swapped; the IMU "
            "frame must be right-handed"
        )
    factor = estimate_clock_rate(reference.curve(np.zeros(3)), t_s, q_world_sensor, shifts_s)
    return "" if factor is None else stretched(1.0 / factor - 1.0, reference)


def _score(start: Start | None) -> float:
    """How badly a start fits: misfit over size of the turns; infinite where it is none."""
    if start is None or start.mirrored or start.agreement < 0.3:
        return float("inf")
    return start.misfit_share


def stretched(rate: float, reference: Reference) -> str:
    """Words for a delay that grows by `rate` seconds a second."""
    sensor, other = reference.sensor, reference.name
    excess = 1.0 / (1.0 + rate) - 1.0
    size = f"{100 * abs(excess):.1f} %" if abs(excess) >= 2e-3 else f"{1e6 * abs(excess):.0f} ppm"
    return (
        f"the stamps of {sensor} and {other} advance at different rates: the {sensor}'s are {size} too "
        f"{'fast' if excess > 0 else 'slow'} for the {other}'s (or those the other way round); the "
        "rotations fit once that is taken out: look at how the stamps are made (a nominal rate, a "
        "wrong tick length?)"
    )


def estimate_clock_rate(
    curve: RotationCurve, t_cam_s: FloatArray, q_world_cam: FloatArray, shifts_s: tuple[float, float]
) -> float | None:
    """Find the factor by which the camera's stamps must be divided to agree with the curve.

    Stamps made by counting (frames over a nominal rate, ticks of another nominal length) stretch time by per
    cents. Turns then agree nowhere for long, and it looks as if rotations did not fit.

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
