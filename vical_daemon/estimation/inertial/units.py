"""Are the readings of an IMU in rad/s and m/s^2, and each in its place? By gravity, and by how it turns.

An accelerometer in g or a gyro in deg/s would not stop a filter, it would make it converge to nonsense. The
same check for recordings, before they are used, and for live data, until a calibration has converged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.measurements import STANDARD_GRAVITY_MPS2, FloatArray, IntArray
from vical_daemon.estimation.plausible import MOST_MPS2, MOST_RPS

_SMOOTHING_S = 0.5  # of forces and rates: what is left of hand-held forces is mostly gravity
_LIKE_GRAVITY = (6.0, 16.0)  # m/s^2: where the median of a moving accelerometer may be
_MOVES = 0.8
"""Of the median, which 5 % of the readings are below where gravity is removed, because motion passes through
zero, or where it is violent. Hand-held motion of 2 m/s^2 on top of gravity leaves 0.8 of it."""
_TURNS_WITH_GYRO = 0.2
"""Correlation, see `gyro_scale`, of a vector that stands still in the world: 0.5 and more on recordings
that are moved by hand; below 0 with gravity removed."""
_SURELY_TURNS = 0.5  # see `_TURNS_WITH_GYRO`
_VIOLENT_RPS = 2.0
"""Median rate of a rig in violent hands. Such a one reads 0.3 to 1.1 g for each rad/s, and 2.5 to 11 m/s^2
with gravity removed (`hand_motion` of 200 deg/s, 12 seeds, windows of 5 s)."""
_IN_G = 4.0  # the most that it reads in g, likewise
_EITHER = f"it looks like g (multiply by {STANDARD_GRAVITY_MPS2}), or gravity is removed: move it more slowly"
_LARGEST_BIAS_RPS = 0.5  # 30 deg/s; data sheets of the cheapest gyros have 20
_STANDS = 0.05  # of the change that the gyro's rates mean
_UNIT = 1e-2  # quaternions written with three digits
_CHANNELS = ("gyro x", "gyro y", "gyro z", "accelerometer x", "accelerometer y", "accelerometer z")
_Turns = tuple[FloatArray, FloatArray]
_BURST = 19  # intervals over which a rate is taken: drivers hand over up to some ten readings at once


@dataclass(frozen=True, slots=True)
class ImuArrays:
    """All samples of one imu: stamps (n,) ns, rates (n, 3) rad/s, specific forces (n, 3) m/s^2."""

    t_ns: IntArray
    gyro_rps: FloatArray
    specific_force_mps2: FloatArray


def unit_mistake(samples: ImuArrays) -> str:
    """Say what is wrong with units or columns, in one line; empty: nothing shows it.

    Args:
        samples: In order of their stamps.
    """
    rate_hz = usual_rate_hz(samples.t_ns)
    if not rate_hz:
        return ""
    turns = _turns(samples, rate_hz)
    _, correlation = _scale(turns)
    return _accelerometer_mistake(samples, correlation) or _gyro_mistake(turns) or _turns_at_rest(turns)


def usual_rate_hz(t_ns: IntArray) -> float:
    """Return the usual rate of readings, Hz; 0: they have none."""
    many = min(_BURST, len(t_ns) - 1)
    step_ns = float(np.median(t_ns[many:] - t_ns[:-many])) / many if many > 0 else 0.0
    return 1e9 / step_ns if step_ns > 0.0 else 0.0


def _accelerometer_mistake(samples: ImuArrays, correlation: float) -> str:
    slow, gyro = np.percentile(np.linalg.norm(samples.gyro_rps, axis=1), [5, 50]).tolist()
    if gyro > math.degrees(MOST_RPS):
        return (
            f"the gyro reads {gyro:.3g} in the middle, rad/s are expected; are these its columns, "
            "and not counts or stamps?"
        )
    force = np.linalg.norm(samples.specific_force_mps2, axis=1)
    low, median = np.percentile(force, [5, 50]).tolist()
    if _LIKE_GRAVITY[0] < median < _LIKE_GRAVITY[1]:
        return ""
    violent = gyro > _VIOLENT_RPS and median < min(gyro, _IN_G)  # then motion outweighs gravity
    first = np.hstack([samples.gyro_rps, samples.specific_force_mps2[:, :1]])
    if np.abs(np.linalg.norm(first, axis=1) - 1.0).max() < _UNIT:
        text = "in place of the gyro stands a quaternion: leave the orientations out, or title the columns"
    elif _swapped(samples, correlation) or (
        median < gyro
        and _LIKE_GRAVITY[0] < gyro < _LIKE_GRAVITY[1]
        and (correlation < _SURELY_TURNS or slow > _MOVES * gyro)
    ):
        text = f"the gyro reads {gyro:.3g}: their columns seem to be swapped"
    elif _LIKE_GRAVITY[1] < median < MOST_MPS2 and low < _MOVES * median:
        return ""  # violent motion
    elif constant := constant_channels(samples):
        text = constant
    elif median < 0.6 or (low < _MOVES * median and correlation < _TURNS_WITH_GYRO):
        text = "gravity seems to be removed: record the accelerometer as it is"
        if violent and median > 0.6:
            text = _EITHER
    elif 0.6 < median < 1.6:
        text = f"it looks like g: multiply by {STANDARD_GRAVITY_MPS2}"
    elif 600 < median < 1600:
        text = f"it looks like mg (multiply by {STANDARD_GRAVITY_MPS2 / 1000}) or cm/s^2 (by 0.01)"
    else:
        text = _EITHER if violent else "check its unit"
    return (
        f"the accelerometer reads {median:.3g} in the middle, m/s^2 (about {STANDARD_GRAVITY_MPS2:.1f}) are "
        f"expected; {text}"
    )


def _swapped(samples: ImuArrays, correlation: float) -> bool:
    """Whether what is read as rates turns with what is read as forces, and not the other way round."""
    other = ImuArrays(samples.t_ns, samples.specific_force_mps2, samples.gyro_rps)
    return (
        correlation < _TURNS_WITH_GYRO and gyro_scale(other, usual_rate_hz(samples.t_ns))[1] > _SURELY_TURNS
    )


def constant_channels(samples: ImuArrays) -> str:
    """Name the channels that never change, which noise does not allow; empty where there is none."""
    six = np.hstack([samples.gyro_rps, samples.specific_force_mps2])
    still = np.flatnonzero(np.ptp(six, axis=0) == 0.0).tolist()
    for sensor, channels in (("gyro", [0, 1, 2]), ("accelerometer", [3, 4, 5])):
        if still == channels:
            return (
                f"the {sensor} never changes; is it in another topic or file? Record both in one (RealSense: "
                "unite_imu_method)"
            )
    if not still:
        return ""
    words = ", ".join(f"{_CHANNELS[i]} (always {six[0, i]:.3g})" for i in still)
    return f"not even noise changes {words}; does the driver read this axis?"


def gyro_mistake(samples: ImuArrays) -> str:
    """Say that the gyro's unit is wrong, by how gravity turns in the accelerometer; empty: nothing shows it.

    Args:
        samples: In order of their stamps.
    """
    rate_hz = usual_rate_hz(samples.t_ns)
    return _gyro_mistake(_turns(samples, rate_hz)) if rate_hz else ""


def _gyro_mistake(turns: _Turns | None) -> str:
    ratio, correlation = _scale(turns)
    shows = "what the turning of gravity in the accelerometer shows; rad/s are expected"
    if correlation > _TURNS_WITH_GYRO and 0.004 < ratio < 0.07 and _beyond_bias(turns):
        return f"the gyro reads {1 / ratio:.0f} times {shows}, it looks like deg/s: multiply by pi/180"
    if correlation > _SURELY_TURNS and ratio > 15:
        return f"the gyro reads only 1/{ratio:.0f} of {shows}, check its unit"
    return ""


def gyro_scale(samples: ImuArrays, rate_hz: float) -> tuple[float, float]:
    """Return (scale, correlation) between the rotation of gravity in the imu frame and the gyro.

    A vector that stands still in the world changes in the imu frame as f' = -w x f. Smoothed over
    0.5 s the specific force is mostly gravity, so scale = <df, -w x f dt> / |w x f dt|^2 is near 1 for
    rad/s (0.5 to 1 on hand-held recordings) and near pi/180 for deg/s.
    """
    return _scale(_turns(samples, rate_hz))


def _scale(turns: _Turns | None) -> tuple[float, float]:
    if turns is None:
        return 1.0, 0.0
    seen, expected = turns
    power = float((expected**2).sum())
    product = float((seen * expected).sum())
    if power <= 0 or not np.isfinite(power):
        return 1.0, 0.0
    return product / power, product / float(np.sqrt(power * (seen**2).sum()) + 1e-300)


def _beyond_bias(turns: _Turns | None) -> bool:
    """Whether gravity should turn faster, by the gyro, than because of any bias."""
    if turns is None:
        return False
    expected = float(np.median(np.linalg.norm(turns[1], axis=1)))
    return expected > _LARGEST_BIAS_RPS * STANDARD_GRAVITY_MPS2


def _turns(samples: ImuArrays, rate_hz: float) -> _Turns | None:
    """Return how the specific force changes within 1 s, and how it should by the gyro; None: too short."""
    width = max(1, round(_SMOOTHING_S * rate_hz))
    if len(samples.t_ns) < 6 * width:
        return None
    force = _moving_average(samples.specific_force_mps2, width)
    gyro = _moving_average(samples.gyro_rps, width)
    turned = np.cumsum(-np.cross(gyro, force), axis=0) / rate_hz
    return force[2 * width :] - force[: -2 * width], turned[2 * width :] - turned[: -2 * width]


def _turns_at_rest(turns: _Turns | None) -> str:
    """Say that the gyro reads a lasting rate that gravity in the accelerometer does not show at all."""
    if turns is None or not _beyond_bias(turns):
        return ""
    seen, expected = (float(np.median(np.linalg.norm(x, axis=1))) for x in turns)
    if seen > _STANDS * expected:
        return ""
    return (
        f"the gyro reads about {expected / STANDARD_GRAVITY_MPS2:.2g} although gravity in the accelerometer "
        "does not turn; rad/s are expected, it looks like deg/s: multiply by pi/180"
    )


def _moving_average(values: FloatArray, width: int) -> FloatArray:
    total = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), values]), axis=0)
    mean: FloatArray = (total[width:] - total[:-width]) / width
    return mean
