"""Reads the inertial samples that `vical allan` and `vical imu-calibrate` work on: a recording or a CSV."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import warn
from vical_daemon.estimation.measurements import FloatArray, IntArray

MOVED_RPS, MOVED_MPS2 = 9e-3, 0.2  # 0.5 deg/s; twenty mg
_LIVELY = 5.0  # scatter of the gyro within a second over that of the quietest ones
LEAST_REST_S = 10.0
LOST_LIMIT = 0.02  # a recording that misses more samples than this is refused


@dataclass(frozen=True, slots=True)
class EvenSamples:
    """Inertial samples on an even grid.

    Attributes:
        name: Where they come from.
        rate_hz: Rate of the grid: what the recording really had, from its stamps.
        gyro_rps: shape (n, 3).
        accel_mps2: shape (n, 3).
        filled: Samples that were lost and are interpolated.
    """

    name: str
    rate_hz: float
    gyro_rps: FloatArray
    accel_mps2: FloatArray
    filled: int

    @property
    def duration_s(self) -> float:
        """Length of the recording, s."""
        return len(self.gyro_rps) / self.rate_hz


def load(args: argparse.Namespace) -> EvenSamples:
    """Read what the options name and put it on an even grid.

    Raises:
        CliError: Nothing usable there; the message says what and what to try.
    """
    path = Path(args.input)
    if args.skip < 0 or (args.seconds is not None and args.seconds <= 0):
        raise CliError("--skip must be 0 or more and --seconds above 0", EXIT_USAGE)
    t_ns, gyro, accel, name = _read(path, args.imu)
    use = t_ns >= t_ns[0] + int(args.skip * 1e9)
    if args.seconds is not None:
        use &= t_ns < t_ns[0] + int((args.skip + args.seconds) * 1e9)
    if np.count_nonzero(use) < 100:
        raise CliError(
            f"{path}: only {np.count_nonzero(use)} samples after --skip and --seconds, 100 are needed"
        )
    from vical_daemon.estimation.inertial.units import ImuArrays
    from vical_daemon.logs.checks import check_imu

    check_imu(name, ImuArrays(t_ns[use], gyro[use], accel[use]))  # units: g and deg/s are refused by name
    samples = even_grid(name, t_ns[use], gyro[use], accel[use])
    if samples.filled:
        print(
            f"vical: warning: {samples.filled} lost samples are interpolated "
            f"({100 * samples.filled / len(samples.gyro_rps):.2f} %)",
            file=sys.stderr,
        )
    return samples


def at_rest(samples: EvenSamples) -> tuple[EvenSamples, str]:
    """Return the longest part in which the imu rests, and a remark for people; empty where it never moves.

    Judged second by second, against the quietest quarter of them: warming up and noise stay far below the
    limits, a touch does not. A second next to one that moved does not count as rest.

    Raises:
        CliError: It is never at rest for long enough.
    """
    n = max(round(samples.rate_hz), 1)
    count = len(samples.gyro_rps) // n
    if count < 2:
        return samples, ""
    signals = ((samples.gyro_rps, MOVED_RPS), (samples.accel_mps2, MOVED_MPS2))
    blocks = [signal[: count * n].reshape(count, n, 3) for signal, _ in signals]
    swing = np.linalg.norm(blocks[0].std(axis=1), axis=1)
    quiet = swing <= np.quantile(swing, 0.25)
    moved = swing > np.maximum(_LIVELY * np.median(swing[quiet]), MOVED_RPS)
    for block, (_, limit) in zip(blocks, signals, strict=True):
        means = block.mean(axis=1)
        moved |= (np.abs(means - np.median(means[quiet], axis=0)) > limit).any(axis=1)
    if not moved.any():
        return samples, ""
    unrest = moved.copy()
    unrest[1:] |= moved[:-1]
    unrest[:-1] |= moved[1:]
    edges = np.flatnonzero(np.diff(np.concatenate(([1], unrest.astype(np.int64), [1]))))
    begins, ends = edges[::2], edges[1::2]  # of the runs that rest
    longest = int(np.argmax(ends - begins)) if len(begins) else 0
    if not len(begins) or ends[longest] - begins[longest] < LEAST_REST_S:
        raise CliError(
            f"{samples.name}: the IMU is never at rest for {LEAST_REST_S:g} s, which noise densities need; "
            "record it at rest"
        )
    part = slice(int(begins[longest]) * n, int(ends[longest]) * n)
    rest = replace(samples, gyro_rps=samples.gyro_rps[part], accel_mps2=samples.accel_mps2[part])
    first = float(np.argmax(moved)) * n / samples.rate_hz
    return rest, (
        f"{samples.name}: the IMU moved, first {first:.0f} s from the start; only its longest rest is used, "
        f"{part.start / samples.rate_hz:.0f} to {part.stop / samples.rate_hz:.0f} s"
    )


def even_grid(name: str, t_ns: IntArray, gyro: FloatArray, accel: FloatArray) -> EvenSamples:
    """Put samples on a grid by counting periods between neighbours; lost ones are interpolated.

    Jitter of the stamps does not move a sample: only whole missing periods open a gap.

    Raises:
        CliError: Stamps do not increase, or too much is missing.
    """
    steps = np.diff(t_ns)
    if np.any(steps <= 0):
        first = int(np.flatnonzero(steps <= 0)[0])
        raise CliError(f"{name}: stamps do not increase (sample {first + 1}); sort the recording first")
    period = float(np.median(steps))
    index = np.concatenate(([0], np.cumsum(np.maximum(np.round(steps / period), 1.0)))).astype(np.int64)
    count = int(index[-1]) + 1
    filled = count - len(t_ns)
    if filled > LOST_LIMIT * count:
        raise CliError(
            f"{name}: {100 * filled / count:.1f} % of the samples are missing "
            f"(limit {100 * LOST_LIMIT:g} %); see `vical info` for the gaps, "
            "or cut the recording with --skip and --seconds"
        )
    rate_hz = (count - 1) / ((t_ns[-1] - t_ns[0]) * 1e-9)
    if filled:
        grid = np.arange(count)
        gyro = np.stack([np.interp(grid, index, gyro[:, i]) for i in range(3)], axis=-1)
        accel = np.stack([np.interp(grid, index, accel[:, i]) for i in range(3)], axis=-1)
    return EvenSamples(name, rate_hz, gyro, accel, filled)


def _read(path: Path, imu: str | None) -> tuple[IntArray, FloatArray, FloatArray, str]:
    from vical_daemon.logs import meant, open_recording

    recording = open_recording(path, check=False)
    for warning in recording.warnings:
        warn(warning)
    names = list(recording.imus)
    if not names:
        raise CliError(f"{path} holds no IMU data")
    if imu is None and len(names) > 1:
        raise CliError(f"{path} has several IMUs: {', '.join(names)}; choose one with --imu", EXIT_USAGE)
    chosen = meant(recording.imus, imu) if imu else names[0]
    if chosen not in names:
        raise CliError(f"{path} has no IMU {chosen!r}, only {', '.join(names)}", EXIT_USAGE)
    arrays = recording.imu_arrays(chosen)
    return arrays.t_ns, arrays.gyro_rps, arrays.specific_force_mps2, f"{path}: {chosen}"
