"""`vical imu stream`: stamped samples on stdout, a summary, and a picture of the intervals if wanted."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
import time
from pathlib import Path
from types import FrameType

import numpy as np
from vical_drivers.errors import DeviceLostError, DriverError
from vical_drivers.microstrain.device import MicrostrainImu, open_imu
from vical_drivers.samples import ImuSample

from vical_daemon.cli.errors import CliError

_STATUS_EVERY_S = 1.0
_GIVE_UP_S = 10.0


def run(args: argparse.Namespace) -> int:
    """Stream until enough, Ctrl-C or SIGTERM; the device is stopped and closed in every case."""
    _check(args)
    stop = threading.Event()

    def end(_signal: int, _frame: FrameType | None) -> None:
        stop.set()

    previous = [(s, signal.signal(s, end)) for s in (signal.SIGINT, signal.SIGTERM)]
    try:
        with open_imu(
            args.port,
            protocol=args.protocol,
            rate_hz=args.rate,
            filter_width=args.filter_width,
            baud=args.baud,
            link=args.link,
        ) as imu:
            stamps = _print_samples(imu, args, stop)
            summary = _summary(imu) | {"samples": len(stamps)}
    finally:
        for number, handler in previous:
            signal.signal(number, handler)
    _report(args, imu, summary)
    if args.plot:
        _plot(args, np.array(stamps, np.int64).reshape(-1, 2), args.rate)
    return 0


def _check(args: argparse.Namespace) -> None:
    if not 1.0 <= args.rate <= 1000.0:
        raise CliError(f"--rate {args.rate:g} is outside 1 .. 1000 Hz", 2)
    if args.filter_width is not None and not 1 <= args.filter_width <= 32:
        raise CliError(f"--filter-width {args.filter_width} is outside 1 .. 32", 2)
    for name in ("samples", "seconds"):
        value = getattr(args, name)
        if value is not None and value <= 0:
            raise CliError(f"--{name} must be positive", 2)
    if args.plot and not Path(args.plot).absolute().parent.is_dir():
        raise CliError(f"{args.plot}: no such folder", 2)


def _print_samples(
    imu: MicrostrainImu, args: argparse.Namespace, stop: threading.Event
) -> list[tuple[int, int]]:
    """Print samples as they come; returns (arrival, stamp) of each, ns."""
    stamps: list[tuple[int, int]] = []
    start_s = last_status_s = alive_s = time.monotonic()
    while not stop.is_set() and not _enough(args, len(stamps), start_s):
        try:
            samples = imu.read(0.2)
        except DriverError as error:
            print(f"vical: {error}; trying to reconnect", file=sys.stderr)
            continue
        now_s = time.monotonic()
        if samples:
            alive_s = now_s
        elif now_s - alive_s > _GIVE_UP_S:
            raise DeviceLostError(f"{args.port}: no samples for {_GIVE_UP_S:g} s; check the cable and power")
        for sample in samples:
            if args.samples is not None and len(stamps) >= args.samples:
                break
            stamps.append((sample.t_arrival_ns, sample.t_host_ns))
            print(_line(sample))
        if samples:
            sys.stdout.flush()
        if now_s - last_status_s > _STATUS_EVERY_S and not args.quiet and sys.stderr.isatty():
            last_status_s = now_s
            print(f"\r{len(stamps)} samples ", end="", file=sys.stderr, flush=True)
    return stamps


def _enough(args: argparse.Namespace, count: int, start_s: float) -> bool:
    if args.samples is not None and count >= args.samples:
        return True
    return args.seconds is not None and time.monotonic() - start_s >= args.seconds


def _line(sample: ImuSample) -> str:
    return json.dumps(
        {
            "t_host_ns": sample.t_host_ns,
            "device_ticks": sample.device_ticks,
            "gyro_rps": sample.gyro_rps,
            "accel_mps2": sample.specific_force_mps2,
            "t_sigma_ns": sample.t_sigma_ns,
            "lost_before": sample.lost_before,
        }
    )


def _summary(imu: MicrostrainImu) -> dict[str, object]:
    s = imu.stats()
    return {
        "samples": s.samples,
        "lost": s.lost,
        "checksum_errors": s.checksum_errors,
        "resync_bytes": s.resync_bytes,
        "rate_hz": s.rate_hz,
        "clock_skew_ppm": s.clock_skew_ppm,
        "jitter_us": s.jitter_us,
        "reconnects": s.reconnects,
        **s.extra,
    }


def _report(args: argparse.Namespace, imu: MicrostrainImu, summary: dict[str, object]) -> None:
    if args.json:
        print(json.dumps({"summary": summary}))
        return
    info = imu.info
    print(
        f"# {info.model} {info.serial_number} over {info.protocol}: {summary['samples']} samples at "
        f"{summary['rate_hz']:.3f} Hz, {summary['lost']} lost, {summary['checksum_errors']} checksum errors, "
        f"device clock {summary['clock_skew_ppm']:+.1f} ppm, arrival jitter {summary['jitter_us']:.0f} us"
    )


def _plot(args: argparse.Namespace, stamps: np.ndarray, rate_hz: float) -> None:
    if len(stamps) < 3:
        raise CliError("too few samples for a picture; stream for a second or more")
    from vical_daemon.cli import imu_plot

    imu_plot.write(Path(args.plot), stamps[:, 0], stamps[:, 1], rate_hz)
    print(f"wrote {args.plot}", file=sys.stderr)
