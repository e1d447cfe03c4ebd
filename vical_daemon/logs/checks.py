"""Checks units, rates and overlap of a recording before the estimation.

An accelerometer in g or a gyro in deg/s would not stop a filter, it would make it converge to nonsense.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.logs.model import ImuArrays, RecordingError, Stream

GRAVITY_MPS2 = 9.80665
_SLOWEST_IMU_HZ, _FASTEST_IMU_HZ = 10.0, 20_000.0
_SLOWEST_CAMERA_HZ, _FASTEST_CAMERA_HZ = 1.0, 2_000.0
_SMOOTHING_S = 0.5
_LIKE_GRAVITY = (6.0, 16.0)  # m/s^2: where the median of a moving accelerometer may be
_GRAVITY_REMOVED, _MOVES = 0.4, 0.8
"""Of the median, which 5 % of the readings are below where gravity is removed: motion passes through zero.
Hand-held motion of 2 m/s^2 on top of gravity leaves 0.8 of it. In between it shows in whether what is
measured turns with the gyro."""
_TURNS_WITH_GYRO = 0.2
"""Correlation, see `gyro_scale`, of a vector that stands still in the world: 0.5 and more on recordings
that are moved by hand; below 0 with gravity removed."""
_SURELY_TURNS = 0.5  # see `_TURNS_WITH_GYRO`
_LARGEST_BIAS_RPS = 0.5  # 30 deg/s; data sheets of the cheapest gyros have 20
_STANDS = 0.05  # of the change that the gyro's rates mean
_NO_GYRO = 4000.0  # the widest range of gyros, in deg/s
_UNIT = 1e-2  # quaternions written with three digits
_JUMP = 0.3  # rad/s, or of gravity: no motion does that from one reading to the next and back
_NEARER = 5.0
"""Times that a jump is larger than the distance to one of the readings after it. Of noise in six channels,
1 in 1000 is."""
_JUMPS = 0.2
"""Share of such jumps from which on two devices take turns; 0.3 if one is four times as fast, none on real
recordings of one."""
_AT_ONCE = 100_000  # readings that are looked at together: memory
_CHANNELS = ("gyro x", "gyro y", "gyro z", "accelerometer x", "accelerometer y", "accelerometer z")
_COPY = "is one of the files a copy of another?"
_BURST = 19  # intervals over which a rate is taken: drivers hand over up to some ten readings at once


def check_imu(name: str, samples: ImuArrays, set_back_s: float = 0.0) -> list[str]:
    """Return warnings about an imu stream.

    Args:
        name: Of the imu.
        samples: Its readings, in order of their stamps.
        set_back_s: By how much its clock was set back during the recording, s.

    Raises:
        RecordingError: Its rate or its units are implausible.
    """
    if len(samples.t_ns) < 20:
        raise RecordingError(f"{name}: only {len(samples.t_ns)} samples; nothing can be calibrated from that")
    rate_hz = _check_imu_rate(name, samples.t_ns)
    if set_back_s:
        raise RecordingError(
            f"{name}: its stamps go back by {set_back_s:.3g} s in the middle: its clock was set, or these "
            "are two recordings; give the data before and after it as two recordings"
        )
    _check_one_device(name, samples)
    constant = _constant_channels(samples)
    ratio, correlation = gyro_scale(samples, rate_hz)
    _check_accelerometer(name, samples, constant, correlation)
    if mistake := _gyro_mistake(ratio, correlation) or _turns_at_rest(samples, rate_hz):
        raise RecordingError(f"{name}: {mistake}")
    return [f"{name}: {constant}"] * bool(constant) + _gaps(name, samples.t_ns, rate_hz)


def _check_imu_rate(name: str, t_ns: IntArray) -> float:
    many = min(_BURST, len(t_ns) - 1)
    step_ns = float(np.median(t_ns[many:] - t_ns[:-many])) / many
    if step_ns <= 0:
        raise RecordingError(
            f"{name}: most stamps are equal to others ({len(np.unique(t_ns))} different ones in {len(t_ns)} "
            f"samples); does the driver fill them, with nanoseconds? Or {_COPY}"
        )
    rate_hz = 1e9 / step_ns
    if rate_hz > _FASTEST_IMU_HZ:
        units = {1e3: "microseconds", 1e6: "milliseconds", 1e9: "seconds"}
        near = min(units, key=lambda factor: abs(np.log(max(step_ns, 1e-3) * factor / 5e6)))
        raise RecordingError(
            f"{name}: {rate_hz:.3g} samples a second by its stamps; stamps must be nanoseconds, "
            f"these look like {units[near]}"
        )
    if rate_hz < _SLOWEST_IMU_HZ:
        raise RecordingError(
            f"{name}: {rate_hz:.3g} samples a second by its stamps; an IMU needs {_SLOWEST_IMU_HZ:g} Hz and "
            "more: are the stamps nanoseconds, and is this the IMU's file? (KITTI: of synced recordings it "
            "is thinned out; take the unsynced one, ..._extract, with 100 Hz)"
        )
    return rate_hz


def _check_one_device(name: str, samples: ImuArrays) -> None:
    """Refuse the readings of two devices that are mounted differently, in one stream."""
    if take_turns(samples.gyro_rps, samples.specific_force_mps2):
        raise RecordingError(
            f"{name}: its readings jump back and forth between two sets, as if two IMUs shared one topic "
            "or file (record each on its own topic, or give each its own frame_id), or its clock was set back"
        )


def take_turns(gyro_rps: FloatArray, specific_force_mps2: FloatArray) -> bool:
    """Whether readings, shapes (n, 3), jump back and forth between those of two devices."""
    jumps, count = 0, len(gyro_rps)
    for begin in range(0, count - 5, _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE + 5)
        six = np.hstack([gyro_rps[part], specific_force_mps2[part] / GRAVITY_MPS2])
        ahead = np.stack([np.linalg.norm(six[k : len(six) - 5 + k] - six[:-5], axis=1) for k in range(1, 6)])
        jumps += int(np.count_nonzero((ahead[0] > _JUMP) & (ahead[0] > _NEARER * ahead[1:].min(axis=0))))
    return jumps > _JUMPS * (count - 5) > 0


def _check_accelerometer(name: str, samples: ImuArrays, constant: str, correlation: float) -> None:
    gyro = float(np.median(np.linalg.norm(samples.gyro_rps, axis=1)))
    if gyro > _NO_GYRO:
        raise RecordingError(
            f"{name}: the gyro reads {gyro:.3g} in the middle, rad/s are expected; are these its columns, "
            "and not counts or stamps?"
        )
    force = np.linalg.norm(samples.specific_force_mps2, axis=1)
    low, median = np.percentile(force, [5, 50]).tolist()
    if _LIKE_GRAVITY[0] < median < _LIKE_GRAVITY[1]:
        return
    first = np.hstack([samples.gyro_rps, samples.specific_force_mps2[:, :1]])
    if np.abs(np.linalg.norm(first, axis=1) - 1.0).max() < _UNIT:
        text = "in place of the gyro stands a quaternion: leave the orientations out, or title the columns"
    elif (_LIKE_GRAVITY[0] < gyro < _LIKE_GRAVITY[1] and median < gyro) or _swapped(samples, correlation):
        text = f"the gyro reads {gyro:.3g}: their columns seem to be swapped"
    elif constant:
        text = constant
    elif (
        low < _GRAVITY_REMOVED * median
        or median < 0.6
        or (low < _MOVES * median and correlation < _TURNS_WITH_GYRO)
    ):
        text = "gravity seems to be removed: record the accelerometer as it is"
    elif 0.6 < median < 1.6:
        text = f"it looks like g: multiply by {GRAVITY_MPS2}"
    elif 600 < median < 1600:
        text = f"it looks like mg (multiply by {GRAVITY_MPS2 / 1000}) or cm/s^2 (by 0.01)"
    else:
        text = "check its unit"
    raise RecordingError(
        f"{name}: the accelerometer reads {median:.3g} in the middle, m/s^2 (about {GRAVITY_MPS2:.1f}) are "
        f"expected; {text}"
    )


def _swapped(samples: ImuArrays, correlation: float) -> bool:
    """Whether what is read as rates turns with what is read as forces, and not the other way round."""
    other = ImuArrays(samples.t_ns, samples.specific_force_mps2, samples.gyro_rps)
    rate_hz = 1e9 / float(np.median(np.diff(samples.t_ns)))
    return correlation < _TURNS_WITH_GYRO and gyro_scale(other, rate_hz)[1] > _SURELY_TURNS


def _constant_channels(samples: ImuArrays) -> str:
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
    if len(samples.t_ns) < 2:
        return ""
    step_ns = float(np.median(np.diff(samples.t_ns)))
    return _gyro_mistake(*gyro_scale(samples, 1e9 / step_ns)) if step_ns > 0 else ""


def _gyro_mistake(ratio: float, correlation: float) -> str:
    shows = "what the turning of gravity in the accelerometer shows; rad/s are expected"
    if correlation > _TURNS_WITH_GYRO and 0.004 < ratio < 0.07:
        return f"the gyro reads {1 / ratio:.0f} times {shows}, it looks like deg/s: multiply by pi/180"
    if correlation > _TURNS_WITH_GYRO and ratio > 15:
        return f"the gyro reads only 1/{ratio:.0f} of {shows}, check its unit"
    return ""


def gyro_scale(samples: ImuArrays, rate_hz: float) -> tuple[float, float]:
    """Return (scale, correlation) between the rotation of gravity in the imu frame and the gyro.

    A vector that stands still in the world changes in the imu frame as f' = -w x f. Smoothed over
    0.5 s the specific force is mostly gravity, so scale = <df, -w x f dt> / |w x f dt|^2 is near 1 for
    rad/s (0.5 to 1 on hand-held recordings) and near pi/180 for deg/s.
    """
    turns = _turns(samples, rate_hz)
    if turns is None:
        return 1.0, 0.0
    seen, expected = turns
    power = float((expected**2).sum())
    product = float((seen * expected).sum())
    if power <= 0 or not np.isfinite(power):
        return 1.0, 0.0
    return product / power, product / float(np.sqrt(power * (seen**2).sum()) + 1e-300)


def _turns(samples: ImuArrays, rate_hz: float) -> tuple[FloatArray, FloatArray] | None:
    """Return how the specific force changes within 1 s, and how it should by the gyro; None: too short."""
    width = max(1, round(_SMOOTHING_S * rate_hz))
    if len(samples.t_ns) < 6 * width:
        return None
    force = _moving_average(samples.specific_force_mps2, width)
    gyro = _moving_average(samples.gyro_rps, width)
    turned = np.cumsum(-np.cross(gyro, force), axis=0) / rate_hz
    return force[2 * width :] - force[: -2 * width], turned[2 * width :] - turned[: -2 * width]


def _turns_at_rest(samples: ImuArrays, rate_hz: float) -> str:
    """Say that the gyro reads a lasting rate that gravity in the accelerometer does not show at all."""
    turns = _turns(samples, rate_hz)
    if turns is None:
        return ""
    seen, expected = (float(np.median(np.linalg.norm(x, axis=1))) for x in turns)
    if expected < _LARGEST_BIAS_RPS * GRAVITY_MPS2 or seen > _STANDS * expected:
        return ""
    return (
        f"the gyro reads about {expected / GRAVITY_MPS2:.2g} although gravity in the accelerometer does not "
        "turn; rad/s are expected, it looks like deg/s: multiply by pi/180"
    )


def _moving_average(values: FloatArray, width: int) -> FloatArray:
    total = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), values]), axis=0)
    mean: FloatArray = (total[width:] - total[:-width]) / width
    return mean


def _gaps(name: str, t_ns: IntArray, rate_hz: float) -> list[str]:
    steps_s = np.diff(t_ns) * 1e-9
    holes = steps_s > 3.5 / rate_hz
    if not holes.any():
        return []
    lost = int(np.round(steps_s[holes] * rate_hz - 1).sum())
    count = int(holes.sum())
    return [f"{name}: about {lost} samples missing in {count} holes, the longest {steps_s.max():.3f} s"]


def check_camera(stream: Stream, imus: list[Stream]) -> list[str]:
    """Return warnings about a camera stream.

    Raises:
        RecordingError: Its rate is implausible, or it was not recorded together with the imu. (A clock of
            another rate and an IMU that was recorded in part look alike here. The rotations tell.)
    """
    if stream.count < 3:
        raise RecordingError(f"{stream.name}: only {stream.count} frames in {stream.source}")
    if stream.rate_hz == 0.0:  # the median interval
        raise RecordingError(f"{stream.name}: most of its frames come twice, {_COPY}")
    if not _SLOWEST_CAMERA_HZ <= stream.rate_hz <= _FASTEST_CAMERA_HZ:
        raise RecordingError(
            f"{stream.name}: {stream.rate_hz:.3g} frames a second by its stamps; {_SLOWEST_CAMERA_HZ:g} to "
            f"{_FASTEST_CAMERA_HZ:g} are expected: are the stamps nanoseconds?"
        )
    if not imus:
        return []
    begin, end = min(imu.begin_ns for imu in imus), max(imu.end_ns for imu in imus)
    overlap_s = (min(end, stream.end_ns) - max(begin, stream.begin_ns)) * 1e-9
    imu_s = (end - begin) * 1e-9
    if overlap_s <= 0:
        apart_s = (stream.begin_ns - begin) * 1e-9
        raise RecordingError(
            f"{stream.name}: its stamps and the IMU's do not overlap (they begin {apart_s:.6g} s apart); "
            "both must come from one clock (and dates from one time zone)"
        )
    outside_s = stream.duration_s - overlap_s
    if outside_s > 1.0:
        return [
            f"{stream.name}: {outside_s:.1f} s of frames were recorded without IMU samples and are skipped"
            f" (stamps of the camera span {stream.duration_s:.1f} s, of the IMU {imu_s:.1f} s)"
        ]
    return []
