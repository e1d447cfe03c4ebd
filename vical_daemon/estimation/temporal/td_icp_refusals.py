"""Why temporal calibration gives no answer, or only part of one, in words a person can act on.

Where rotations do not fit, orientations may be inverted, the gyro mirrored (an axis of the wrong sign, two
swapped) or in degrees, or stamps stretched. From the misfit alone these look alike: for small turns, inverted
orientations are a mirrored mounting. So the start is repeated with each mistake undone, and the one that
makes the rotations fit is named (`explain`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import ROTATION_SIGMA_RAD
from vical_daemon.estimation.significance import SURE_SIGMAS
from vical_daemon.estimation.temporal.rotation_curves import RotationCurve
from vical_daemon.estimation.temporal.rotation_start import (
    GRID_S,
    GyroReference,
    Reference,
    Start,
    agreement_scale,
    coarse_start,
    shift_costs,
)
from vical_daemon.estimation.temporal.rotation_turns import MIN_PAIRS, MIN_RATE_RPS, Turns, camera_turns
from vical_daemon.estimation.temporal.td_icp_input import MIN_ORIENTATIONS, SHIFT_LOST_S, TdIcpOptions
from vical_daemon.estimation.temporal.td_icp_result import DEGENERATE, OK, REFUSED, TdIcpResult

_CLEAR = 0.25  # misfit of turns over their size below which they fit
_AGREE = 0.6  # share of the turns that agree in size where stamps are no longer stretched
BETTER = 0.6  # misfit over that of the data as they are
_MOST = 0.22  # by which stamps may be stretched: 30 images a second counted as 25 are 0.2
_STEP = 0.02  # between the factors tried; a quarter of it about the best
_GRID_S = 2.0 * GRID_S  # of the shifts tried with each factor
_LONGEST_S = 12.0  # of the data looked at: with more, the factors would have to be closer
_TURNS = 80  # enough to tell factors apart
_CLEARLY = 5.0  # so many times as fast as a sensor that rests another one surely moves
_STEADY = 0.1  # changes of the rate over the rate below which it counts as one rate
_ROTATION_LOST_RAD = 3.0 * ROTATION_SIGMA_RAD  # likewise of a mounting, which by eye is known as well
_UNITS = {
    np.pi / 180.0: "look like degrees per second (factor 57.3); convert them to rad/s",
    180.0 / np.pi: "look as if divided by 57.3 once too often; they must be in rad/s",
}  # what rates are multiplied by to be rad/s
ONLY_IMU_TURNS = (
    "the IMU turns but the camera does not: is the camera fixed to the IMU, the board fixed in the room, and "
    "are the images (or poses) new ones?"
)
_UNEVEN = 1e-3  # no two crystals are as far apart
_STRETCHED = 5e-3  # beyond this no delay makes sense


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
    for scale, unit in _UNITS.items():
        scaled = reference.scaled(scale)
        if scaled and _score(scaled.start(t_s, q_world_sensor, shifts_s)[0]) < limit:
            return f"the gyro's rates {unit} (then the rotations fit)"
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
    fine = best + np.arange(-3, 4) * (_STEP / 4.0)
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


class Refusal(NamedTuple):
    """Why the motion cannot be used.

    Attributes:
        reason: In words; empty: it can.
        still: The rig stands still.
    """

    reason: str = ""
    still: bool = False


def refuse_motion(reference: Reference, t_cam: FloatArray, q: FloatArray, options: TdIcpOptions) -> Refusal:
    """Say why the motion cannot be used, from the rotation rates alone; a gyro is needed for that."""
    if not isinstance(reference, GyroReference):
        return Refusal()
    t_imu, gyro = reference.t_s, reference.gyro_rps
    turns = camera_turns(t_cam, q)
    if len(turns.first) < MIN_PAIRS:
        return Refusal("the camera orientations are too far apart in time: at least 5 a second are needed")
    rate_cam = _rate(turns, t_cam)
    reach = options.search_s + abs(options.timeshift_guess_s)
    near = (t_imu > t_cam[0] - reach) & (t_imu < t_cam[-1] + reach)
    if np.count_nonzero(near) < 2 * MIN_ORIENTATIONS:
        return Refusal(
            f"camera and IMU do not overlap in time: the camera covers {t_cam[0]:.1f} to {t_cam[-1]:.1f} s, "
            f"the IMU 0.0 to {t_imu[-1]:.1f} s, more than {reach:.1f} s apart (two clocks?); bring both to "
            "one epoch, or shift one by the difference"
        )
    mean_rate = _mean_rates(t_imu, gyro[near])
    # Where the camera rests at times, its rate is that in motion, and so must the gyro's be. Pairs that move
    # in part count as moving, and the gyro's data reach further: it moves for a smaller share than the pairs.
    middle = 1.0 - 0.25 * turns.moving_share if 0.0 < turns.moving_share < 0.9 else 0.5
    rate_imu = float(np.quantile(np.linalg.norm(mean_rate, axis=1), middle))
    swing = float(np.quantile(_changes(mean_rate), middle))
    ratio = rate_imu / max(rate_cam, 1e-9)
    if rate_cam < MIN_RATE_RPS and swing < MIN_RATE_RPS:
        return Refusal(
            f"no motion: the camera turns at {np.rad2deg(rate_cam):.1f} deg/s (median); "
            "turn the rig back and forth about all axes at 20 to 60 deg/s",
            still=True,
        )
    if rate_cam < MIN_RATE_RPS and swing > _CLEARLY * MIN_RATE_RPS:
        return Refusal(ONLY_IMU_TURNS)
    if 0.5 < ratio < 2.0 and _is_steady(mean_rate):
        return Refusal(
            f"it turns at one rate ({np.rad2deg(rate_imu):.0f} deg/s) about one axis all the time: neither "
            "delay nor mounting about that axis show; turn back and forth, and about other axes"
        )
    return Refusal()


def turns_clearly(t_imu: FloatArray, gyro: FloatArray) -> bool:
    """Whether the gyro shows motion beyond doubt, for most of the time.

    Args:
        t_imu: Instants, s, shape (n,).
        gyro: Rates, rad/s, shape (n, 3); their bias does not count.
    """
    return bool(np.median(_changes(_mean_rates(t_imu, gyro))) > _CLEARLY * MIN_RATE_RPS)


def is_constant_rotation(t_imu: FloatArray, gyro: FloatArray) -> bool:
    """Whether the rig turns at one rate about one axis all the time.

    Args:
        t_imu: Instants, s, shape (n,).
        gyro: Rates, rad/s, shape (n, 3).
    """
    rates = _mean_rates(t_imu, gyro)
    return _is_steady(rates) and float(np.median(np.linalg.norm(rates, axis=1))) > MIN_RATE_RPS


def _only_camera_turns(reference: Reference, t_cam: FloatArray, q: FloatArray) -> bool:
    """Whether the camera turns while the gyro shows next to nothing: a board waved before a rig at rest."""
    if not isinstance(reference, GyroReference):
        return False
    swing = float(np.median(_changes(_mean_rates(reference.t_s, reference.gyro_rps))))
    return bool(max(_CLEARLY * swing, MIN_RATE_RPS) < _rate(camera_turns(t_cam, q), t_cam))


def _rate(turns: Turns, t_cam: FloatArray) -> float:
    """Median rate of turns, rad/s."""
    return float(np.median(turns.angle / (t_cam[turns.second] - t_cam[turns.first])))


def _is_steady(rates: FloatArray) -> bool:
    size = float(np.median(np.linalg.norm(rates, axis=1)))
    return float(np.quantile(_changes(rates), 0.95)) < _STEADY * size


def _mean_rates(t_imu: FloatArray, gyro: FloatArray) -> FloatArray:
    """Means over a fifth of a second, so that noise is not taken for changes."""
    length = max(1, round(0.2 / float(np.median(np.diff(t_imu)))))
    kernel = np.ones(length) / length
    return np.stack([np.convolve(gyro[:, i], kernel, mode="valid") for i in range(3)], axis=1)


def _changes(rates: FloatArray) -> FloatArray:
    out: FloatArray = np.linalg.norm(rates - np.median(rates, axis=0), axis=1)
    return out


def refuse_start(
    start: Start | None, options: TdIcpOptions, reference: Reference, t_cam: FloatArray, q: FloatArray
) -> str:
    """Say why no start was found; empty if there is one."""
    reach = f"within {options.search_s:g} s of {options.timeshift_guess_s:g} s"
    if (start is None or start.agreement < 0.3) and _only_camera_turns(reference, t_cam, q):
        return (
            "the camera sees rotation but the IMU does not turn: move the rig, not the board (or are the "
            "readings of the IMU frozen?)"
        )
    if start is None:
        return f"no delay {reach} makes the rotations of camera and gyro agree (not the same recording?)"
    if start.agreement < 0.3:
        return (
            f"no delay {reach} makes the rotations of camera and gyro agree in size "
            f"(best: {100 * start.agreement:.0f} % of the turns at {start.timeshift_s:+.2f} s); is it the "
            "same recording, and is image stabilisation off?"
        )
    if start.mirrored or start.misfit_rad > max(0.5 * start.typical_rad, 0.01):
        return (
            "the rotations agree in size but not in direction: is this the same recording, is the camera "
            "fixed to the IMU and the board in the room, are its orientations those of the camera in the "
            "world?"
        )
    return ""


def judge(result: TdIcpResult, of: int, reference: Reference, lost_s: float) -> tuple[str, str]:
    """Status and reason from the final covariance and residuals of a sensor with `of` orientations.

    Args:
        result: Its result so far.
        of: Number of its orientations.
        reference: What it was compared with.
        lost_s: See `TdIcpOptions`.
    """
    other, noise = reference.name, result.camera_noise_rad
    rate, rate_sigma = result.stamp_rate, result.stamp_rate_sigma
    if result.pairs < max(MIN_ORIENTATIONS, 0.25 * of):
        return REFUSED, f"only {result.pairs} of {of} orientations fit the {other} at the best delay"
    if abs(rate) > max(_STRETCHED, SURE_SIGMAS * rate_sigma):
        return REFUSED, stretched(rate, reference)
    if noise > _ROTATION_LOST_RAD:
        degrees = f"{np.rad2deg(noise):.1f} deg (rms)"
        return REFUSED, f"{other} and {reference.sensor} disagree by {degrees} at the best delay"
    reasons = lost_in_words(result.covariance, result.R_imu_cam, lost_s)
    if abs(rate) > max(_UNEVEN, SURE_SIGMAS * rate_sigma):
        reasons.append(stretched(rate, reference))
    return (DEGENERATE if reasons else OK), "; ".join(reasons)


def lost_in_words(covariance: FloatArray, R_imu_cam: FloatArray, lost_s: float = SHIFT_LOST_S) -> list[str]:
    """Name what a covariance [mounting, bias, shift] leaves open, and the motion that would show it."""
    reasons = []
    if covariance[6, 6] > lost_s**2:
        reasons.append(
            f"the delay is not determined (sigma {1e3 * np.sqrt(covariance[6, 6]):.1f} ms): "
            "the rotation rate hardly changed; turn back and forth"
        )
    values, vectors = np.linalg.eigh(covariance[:3, :3])
    if values[2] > _ROTATION_LOST_RAD**2:
        axis = R_imu_cam @ vectors[:, 2]
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        words = " ".join(f"{a:+.2f}" for a in axis)
        reasons.append(
            f"the mounting about the axis ({words}) of the IMU is not determined "
            f"(sigma {np.rad2deg(np.sqrt(values[2])):.0f} deg): the motion turned about this axis only; "
            "turn about another"
        )
    return reasons
