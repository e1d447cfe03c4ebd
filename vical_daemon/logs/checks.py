"""Checks units, rates and overlap of a recording before the estimation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.inertial.units import (
    ImuArrays,
    constant_channels,
    unit_mistake,
    usual_rate_hz,
)
from vical_daemon.estimation.measurements import STANDARD_GRAVITY_MPS2, FloatArray, IntArray
from vical_daemon.logs.model import RecordingError, Stream

_SLOWEST_IMU_HZ, _FASTEST_IMU_HZ = 10.0, 20_000.0
_SLOWEST_CAMERA_HZ, _FASTEST_CAMERA_HZ = 1.0, 2_000.0
_JUMP = 0.3  # rad/s, or of gravity: no motion does that from one reading to the next and back
_NEARER = 5.0
"""Times that a jump is larger than the distance to one of the readings after it. Of noise in six channels,
1 in 1000 is."""
_JUMPS = 0.2
"""Share of such jumps from which on two devices take turns; 0.3 if one is four times as fast, none on real
recordings of one."""
_PAUSE_S = 86_400.0
"""Longest pause within a recording, s: over a day the drift of the clocks is followed (EuRoC with such a
hole, by hand). Over months its sigma grows until no image fits."""
_FEWEST = 20  # readings: nothing can be calibrated from less
_NEVER_NS = 2**62  # behind any stamp
_FEW = 0.05  # share of the readings that may lie beyond a longer one, as in `stamps.main_stretch`
_AT_ONCE = 100_000  # readings that are looked at together: memory
_COPY = "is one of the files a copy of another?"


class Part(NamedTuple):
    """Which part of a recording is used: `seconds` (None: all) from `skip_s` behind its first stamp on."""

    first_ns: int
    skip_s: float = 0.0
    seconds: float | None = None

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp that are used."""
        begin_ns = self.first_ns + round(self.skip_s * 1e9)
        return begin_ns, _NEVER_NS if self.seconds is None else begin_ns + round(self.seconds * 1e9)

    def of(self, samples: ImuArrays) -> ImuArrays:
        """Return the readings in it; all where there are too few for a check."""
        begin_ns, end_ns = self.span_ns
        inside = (samples.t_ns >= begin_ns) & (samples.t_ns <= end_ns)
        if np.count_nonzero(inside) < _FEWEST or inside.all():
            return samples
        force = samples.specific_force_mps2[inside]
        return ImuArrays(samples.t_ns[inside], samples.gyro_rps[inside], force)


def check_imu(
    name: str, samples: ImuArrays, set_back: tuple[int, int] | None = None, part: Part | None = None
) -> list[str]:
    """Return warnings about an imu stream.

    Args:
        name: Of the imu.
        samples: Its readings, in order of their stamps.
        set_back: See `Recording.set_back`.
        part: Only this is used, and checked; None: all.

    Raises:
        RecordingError: Its rate or its units are implausible.
    """
    part = part or Part(int(samples.t_ns[0]) if len(samples.t_ns) else 0)
    samples = part.of(samples)
    if len(samples.t_ns) < _FEWEST:
        raise RecordingError(f"{name}: only {len(samples.t_ns)} samples; nothing can be calibrated from that")
    rate_hz = _check_imu_rate(name, samples.t_ns)
    _check_clock_set(name, samples.t_ns, set_back, part)
    _check_one_device(name, samples)
    if mistake := unit_mistake(samples):
        raise RecordingError(f"{name}: {mistake}")
    constant = constant_channels(samples)
    return [f"{name}: {constant}"] * bool(constant) + _gaps(name, samples.t_ns, rate_hz)


def _check_imu_rate(name: str, t_ns: IntArray) -> float:
    rate_hz = usual_rate_hz(t_ns)
    if not rate_hz:
        raise RecordingError(
            f"{name}: most stamps are equal to others ({len(np.unique(t_ns))} different ones in {len(t_ns)} "
            f"samples); does the driver fill them, with nanoseconds? Or {_COPY}"
        )
    if rate_hz > _FASTEST_IMU_HZ:
        units = {1e3: "microseconds", 1e6: "milliseconds", 1e9: "seconds"}
        near = min(units, key=lambda factor: abs(np.log(max(1e9 / rate_hz, 1e-3) * factor / 5e6)))
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


def _check_clock_set(name: str, t_ns: IntArray, set_back: tuple[int, int] | None, part: Part) -> None:
    """Refuse readings during which the clock of the computer was set, by NTP or GPS.

    Stamps between those from and to which it was set back come twice, and cannot be put in order.
    """
    ahead_s = np.diff(t_ns) * 1e-9
    at = int(np.argmax(ahead_s)) + 1
    begin_ns, end_ns = part.span_ns
    if set_back is not None and begin_ns <= set_back[1] and set_back[0] <= end_ns:
        low_ns, high_ns = set_back
        step = f"go back by {(high_ns - low_ns) * 1e-9:.3g} s"
    elif ahead_s[at - 1] > _PAUSE_S and min(at, len(t_ns) - at) > _FEW * len(t_ns):
        low_ns, high_ns = int(t_ns[at - 1]), int(t_ns[at])
        step = f"jump by {ahead_s[at - 1] / 86_400.0:.0f} days"
    else:
        return
    before_s, after_s = (1e-9 * (t - part.first_ns) for t in (low_ns, high_ns))
    use = [f"--seconds {before_s - 1.0:.0f}"] if before_s > 2.0 else []
    use += [f"--skip {after_s + 1.0:.0f}"] if part.skip_s < after_s else []
    raise RecordingError(
        f"{name}: its stamps {step} in the middle: its clock was set, or these are two recordings; give the "
        f"data before and after it as two recordings, or use only a part ({' or '.join(use)})"
    )


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
        six = np.hstack([gyro_rps[part], specific_force_mps2[part] / STANDARD_GRAVITY_MPS2])
        ahead = np.stack([np.linalg.norm(six[k : len(six) - 5 + k] - six[:-5], axis=1) for k in range(1, 6)])
        jumps += int(np.count_nonzero((ahead[0] > _JUMP) & (ahead[0] > _NEARER * ahead[1:].min(axis=0))))
    return jumps > _JUMPS * (count - 5) > 0


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
