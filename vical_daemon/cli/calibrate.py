"""`vical calibrate INPUT ...`: the online filter over recordings of one rig."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_NOT_CONVERGED, EXIT_USAGE, CliError
from vical_daemon.cli.options import RECORDING, add_json, add_sensors, add_stretch, named, suggest, warn
from vical_daemon.service.atomic_file import write_output

if TYPE_CHECKING:
    from vical_daemon.estimation.result import CalibrationEstimate
    from vical_daemon.offline.calibrate import Outcome
    from vical_daemon.offline.calibration_job import Job

FIX = ("intrinsics", "timeshift", "extrinsics")
ESTIMATE = ("imu_intrinsics", "size_effect", "readout", "target_scale", "target_shape")
_EXAMPLES = """\
examples:
  vical calibrate log.mcap --target target.yaml --initial lens.yaml --fix intrinsics
  vical calibrate euroc_folder --target april.yaml --json -o result.json --report result.html
  vical calibrate monday.mcap tuesday.mcap --target target.yaml     one rig, several recordings
  vical export result.json --format kalibr -o camchain.yaml

Mounting, lens and time shift are common to all recordings. Biases and the pose of the board are estimated
for each. The clocks of the recordings need not be related. Files into which one recording was split count as
one: give them in order.

exit code: 0 converged; 3 the result is only converging or degenerate (--accept makes that 0);
1 no result; 2 bad usage
"""
ACCEPT = ("converging", "degenerate")
CLOCKS = ("common", "apart")
_UNUSABLE = ("waiting", "initialising", "inconsistent")
_START_S = 5.0
"""Images of 3 to 3.5 s (`MIN_SPAN_S`, `_LEAST_S` of the initializers), and what devices send before them."""
_USUAL_S = (10.0, 30.0)
"""Seconds of motion until `converged`, as the README says; `python -m benchmarks zoo` measures them."""


def add_arguments(parser: argparse.ArgumentParser, accept: tuple[str, ...] = ACCEPT) -> None:
    """Add the options of COMMANDS; `accept`: words that --accept takes."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "inputs",
        metavar="INPUT",
        nargs="+",
        help=f"{RECORDING}; several recordings of one rig make one calibration",
    )
    add_sensors(parser)
    parser.add_argument(
        "--initial",
        metavar="FILE",
        help="prior values, in the format of Kalibr's camchain and imu.yaml, both in one file; every key is "
        "optional",
    )
    parser.add_argument(
        "--fix",
        metavar="WHAT",
        default="",
        help=f"comma-separated, kept at the values of --initial: {', '.join(FIX)}",
    )
    parser.add_argument(
        "--estimate",
        metavar="WHAT",
        default="",
        help="comma-separated, estimated from the start, not only if the data require it (size_effect: the "
        "positions of the accelerometer's axes): " + ", ".join(ESTIMATE),
    )
    add_stretch(parser)
    parser.add_argument(
        "--gravity",
        type=float,
        metavar="G",
        default=9.80665,
        help="local gravity, m/s^2: 9.78 at the equator, 9.83 at the poles (default 9.80665 +- 0.015)",
    )
    parser.add_argument("--report", metavar="F.html", help="write a report, one HTML file")
    parser.add_argument(
        "-o",
        "--output",
        metavar="F.json",
        help="write the result as JSON, for `vical export`, `verify` and `compare`",
    )
    parser.add_argument(
        "--accept",
        metavar="STATUS",
        default="",
        help=f"comma-separated, exit with 0 instead of 3 if the result is: {', '.join(accept)}",
    )
    parser.add_argument(
        "--clock",
        choices=CLOCKS,
        default=CLOCKS[0],
        help="with several recordings: one time shift for all (common, the default) or one for each (apart)",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Calibrate and print; 1 if there is no usable result, 3 if it is not converged."""
    job, accepted = job_of(args)
    from vical_daemon.offline.calibrate import document, run_job

    bar = ProgressBar(hidden=args.quiet or not sys.stderr.isatty())
    outcome = run_job(job, bar.show, keep_frames=bool(args.report))
    bar.close()
    result = document(job, outcome)
    write(args, result)
    for use in outcome.inputs:
        if use.imu is None:
            warn(f"{use.path} is not in the result: no initialisation succeeded")
    return conclude(args, job, outcome, result, accepted)


def job_of(args: argparse.Namespace, accept: tuple[str, ...] = ACCEPT) -> tuple[Job, tuple[str, ...]]:
    """Check the options and open the recordings; what is to be calibrated, and the words of --accept."""
    accepted = _words("--accept", args.accept, accept)
    fix, estimate = _words("--fix", args.fix, FIX), _words("--estimate", args.estimate, ESTIMATE)
    if not args.skip >= 0 or not (args.seconds is None or args.seconds > 0):
        raise CliError("--skip must not be negative, --seconds must be above 0", EXIT_USAGE)
    for path in filter(None, (args.report, args.output)):
        _check_output(path)
    files = [os.path.realpath(path) for path in args.inputs]
    for i, file in enumerate(files):
        if file in files[:i]:
            raise CliError(f"{args.inputs[i]} is given twice; its data count only once", EXIT_USAGE)
    from vical_daemon.config.model import GRAVITY_BOUNDS
    from vical_daemon.config.priors import Initial, read_initial
    from vical_daemon.logs import open_recording
    from vical_daemon.offline.calibration_job import add_recordings, make_job

    low, high = GRAVITY_BOUNDS
    if not low <= args.gravity <= high:
        raise CliError(f"--gravity {args.gravity:g}: {low} to {high} m/s^2 on Earth", EXIT_USAGE)
    initial = read_initial(args.initial) if args.initial else Initial()
    if args.target:
        from vical_daemon.vision.target import load_target

        load_target(Path(args.target))  # a wrong file is refused before the recording is read
    cameras, imus = named(args.camera), named(args.imu)
    used: dict[str, Any] = {"skip_s": args.skip, "seconds": args.seconds}
    recordings = [open_recording(path, cameras=cameras, imus=imus, **used) for path in args.inputs]
    for warning in (text for recording in recordings for text in recording.warnings):
        warn(warning)
    job = make_job(
        recordings[0],
        initial,
        target=args.target,
        camera=args.camera,
        imu=args.imu,
        fix=fix,
        estimate=estimate,
        skip_s=args.skip,
        seconds=args.seconds,
        gravity_mps2=args.gravity,
    )
    add_recordings(job, recordings[1:], args.imu)
    job.warn = warn
    job.common_clock = args.clock == CLOCKS[0]
    return job, accepted


def _check_output(path: str) -> None:
    """Refuse an output that could not be written in the end."""
    folder = Path(path).absolute().parent
    if not folder.is_dir():
        raise CliError(f"{path}: its folder does not exist; make it first", EXIT_USAGE)
    if Path(path).is_dir():
        raise CliError(f"{path} is a folder: give the name of a file", EXIT_USAGE)
    if not os.access(folder, os.W_OK) and not os.access(path, os.W_OK):
        raise CliError(f"{path} cannot be written: no permission, or a read-only disk", EXIT_USAGE)


def write(
    args: argparse.Namespace, result: dict[str, Any], more: Callable[[dict[str, Any]], str] | None = None
) -> None:
    """Print the result and write it where it was asked for; `more`: text that goes before, for people."""
    text = json.dumps(finite(result), allow_nan=False)
    try:
        if args.output and result["cameras"]:  # a failure must not replace an earlier result
            write_output(Path(args.output), text + "\n")
    finally:  # a full disk must not cost the result either
        _print(args, result, text, more)


def _print(
    args: argparse.Namespace,
    result: dict[str, Any],
    text: str,
    more: Callable[[dict[str, Any]], str] | None,
) -> None:
    if args.json:
        print(text)
        return
    if more is not None:
        print(more(result) + "\n")
    if result["cameras"]:
        from vical_daemon.cli.calibration_text import describe

        print(describe(result))


def conclude(
    args: argparse.Namespace, job: Job, outcome: Outcome, result: dict[str, Any], accepted: tuple[str, ...]
) -> int:
    """Write the report; say in one line if the result cannot be used as it is; return the exit code."""
    if args.report and result["cameras"]:
        _report(args, job, outcome, result)
    status, why = result["status"], result["reason"] or result["guidance"]
    if status in _UNUSABLE or not result["cameras"]:
        from vical_daemon.offline.calibration_job import one_alone, suspects
        from vical_daemon.offline.input_diagnosis import diagnose_input

        why = outcome.wrong_target or diagnose_input(job)
        if why:
            why += one_alone(job)
        elif result["duration_s"] < _START_S:
            why = _too_short(args, result)
        else:
            why = f"{status}: {result['reason'] or result['guidance'] or 'too little data'} ({suspects(job)})"
            why = "; ".join(filter(None, [why, _too_short(args, result)]))
        unwritten = "" if result["cameras"] or not args.output else f"; {args.output} was not written"
        raise CliError(f"no calibration: {why}{unwritten}")
    if job.accel_late:
        warn(result["warnings"][-1])
    if status == "converged":
        return 0
    warn("; ".join(filter(None, [f"{status}: {why}", _too_short(args, result)])))
    return 0 if status in accepted else EXIT_NOT_CONVERGED


def _too_short(args: argparse.Namespace, result: dict[str, Any]) -> str:
    """Say so where the data are shorter than those from which a calibration usually converges."""
    used_s, part = result["duration_s"], args.seconds is not None or args.skip
    if used_s >= _USUAL_S[0]:
        return ""
    more = "use more (--seconds, --skip)" if part else "record more"
    needed = f"{_USUAL_S[0]:g} to {_USUAL_S[1]:g} s"
    if result["cameras"]:
        return f"{used_s:.1f} s of data are short: a result usually needs {needed} of motion; {more}"
    return (
        f"{used_s:.1f} s of data are short: a start needs about {_START_S:g} s of images in motion, "
        f"a result usually {needed}; {more}"
    )


def _report(args: argparse.Namespace, job: Job, outcome: Outcome, result: dict[str, Any]) -> None:
    from vical_daemon.offline.calibrate import images_at
    from vical_daemon.results import report
    from vical_daemon.vision.target import load_target

    inputs = [Path(p) for p in (*args.inputs, args.target, args.initial) if p]
    settings = {"fix": args.fix, "estimate": args.estimate}
    if args.skip or args.seconds is not None:
        settings["part"] = f"{outcome.estimate.duration_s:.1f} s, from {args.skip:g} s on"
    report.write_report(
        Path(args.report),
        result | {"trace": outcome.traces},
        outcome.frames,
        image_sizes={name: prior.resolution for name, prior in job.priors.items()},
        target_m=load_target(Path(args.target)).points_m if args.target else None,
        images=lambda camera, stamps_ns: images_at(job, camera, stamps_ns),
        provenance=report.collect(" ".join(sys.argv), inputs, settings),
    )
    print(f"report: {args.report}", file=sys.stderr)


def _words(option: str, text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    words = tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    for word in words:
        if word not in known:
            hint = suggest(word, list(known)) or f" (known: {', '.join(known)})"
            raise CliError(f"{option}: {word!r} is not known{hint}", EXIT_USAGE)
    return words


def finite(value: Any) -> Any:
    """Replace NaN and infinity, which JSON has not, by null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    return [finite(item) for item in value] if isinstance(value, list | tuple) else value


class ProgressBar:
    """One line on stderr that shows how far it is; only on a terminal and after the first second."""

    def __init__(self, *, hidden: bool) -> None:
        self._hidden = hidden
        self._begin_s = time.monotonic()
        self._shown = False

    def show(self, share: float, estimate: CalibrationEstimate | None) -> None:
        """Draw the bar anew."""
        if self._hidden or time.monotonic() - self._begin_s < 1.0:
            return
        filled = round(30 * share)
        status = str(estimate.status) if estimate is not None else ""
        print(f"\r[{'#' * filled}{'.' * (30 - filled)}] {share:4.0%} {status:<12}", end="", file=sys.stderr)
        self._shown = True

    def close(self) -> None:
        """Take the bar away."""
        if self._shown:
            print("\r" + " " * 60 + "\r", end="", file=sys.stderr)
