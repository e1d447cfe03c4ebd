"""`vical verify INPUT --against RESULT`: does a calibration still hold for this recording?"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vical_daemon.cli.calibrate import ProgressBar, finite
from vical_daemon.cli.errors import EXIT_CANNOT_TELL, EXIT_CHANGED, EXIT_USAGE, CliError
from vical_daemon.cli.options import RECORDING, add_json, add_sensors, add_stretch, named, warn

if TYPE_CHECKING:
    from vical_daemon.config.priors import Initial
    from vical_daemon.logs import Recording
    from vical_daemon.results.change_odds import Counts
    from vical_daemon.results.export import Rig
    from vical_daemon.results.known import KnownCamera
    from vical_daemon.results.verifier import Verifier

_EPILOG = """\
examples:
  vical verify today.mcap --against store --target board.yaml
  vical verify today.mcap --against result.json                        without a board
  vical verify euroc/mav0 --against camchain-imucam.yaml --initial imu.yaml --target april.yaml
  vical verify euroc/mav0 --against mounting.yaml --initial lens.yaml --target april.yaml

In the last example mounting.yaml has no lens: mounting and time shift are tested, with the lens of --initial.

exit code: 0 holds; 4 no longer holds; 5 this recording cannot tell; 1 it cannot be read; 2 bad usage
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the recording, the calibration, and what counts as a change."""
    parser.epilog = _EPILOG
    parser.add_argument("input", metavar="INPUT", help=RECORDING)
    parser.add_argument(
        "--against",
        metavar="SOURCE",
        required=True,
        help="result, log, `store` (the latest), a store's folder or file, Kalibr's or OpenVINS's files, or "
        "ROS CameraInfo and static transforms in a YAML file or bag",
    )
    add_sensors(parser)
    parser.add_argument(
        "--initial",
        metavar="FILE",
        help="Kalibr's files with the lens and the IMU's noise, if SOURCE does not have them",
    )
    parser.add_argument(
        "--fix",
        choices=("intrinsics",),
        help="test mounting and time shift only, with the lens as given",
    )
    add_stretch(parser)
    counts = parser.add_argument_group("smallest relevant changes")
    counts.add_argument(
        "--position-mm", type=float, default=2.0, metavar="MM", help="change of position, mm (default 2)"
    )
    counts.add_argument(
        "--rotation-deg", type=float, default=0.2, metavar="DEG", help="change of rotation, deg (default 0.2)"
    )
    counts.add_argument(
        "--timeshift-ms",
        type=float,
        default=1.0,
        metavar="MS",
        help="change of the time shift, ms (default 1)",
    )
    counts.add_argument(
        "--focal-percent",
        type=float,
        default=0.5,
        metavar="P",
        help="change of focal length or principal point, %% of the focal length (default 0.5)",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Verify and print; 4 if it does not hold, 5 if the recording cannot tell."""
    counts = _counts(args)
    if not args.skip >= 0 or not (args.seconds is None or args.seconds > 0):
        raise CliError("--skip must not be negative, --seconds must be above 0", EXIT_USAGE)
    from vical_daemon.offline.calibrate import run_job
    from vical_daemon.offline.calibration_job import make_job
    from vical_daemon.offline.camera_names import by_recording
    from vical_daemon.offline.sources import read_known
    from vical_daemon.results.known import ANY_SHIFT_S

    known, rig = read_known(args.against)
    if rig is not None and rig.status == "inconsistent":
        raise CliError(f"{args.against} is inconsistent: its data contradict each other; calibrate again")
    if args.target:
        from vical_daemon.vision.target import load_target

        load_target(Path(args.target))
    recording = _opened(args)
    topics = {name: camera.topic for name, camera in known.items()}
    known = by_recording(known, topics, recording.cameras)
    initial = _initial(args, known, rig)
    held = args.fix == "intrinsics" or any(camera.lens is None for camera in known.values())
    job = make_job(
        recording,
        initial,
        target=args.target,
        camera=args.camera,
        imu=args.imu,
        fix=("intrinsics",) if held else (),
        skip_s=args.skip,
        seconds=args.seconds,
    )
    own_clock = bool(recording.unplaced)
    if own_clock:
        known = {name: camera.with_any_shift() for name, camera in known.items()}
        counts = replace(counts, timeshift_s=10.0 * ANY_SHIFT_S)
    job.warn = warn
    verifier = _verifier(known, list(job.cameras), held, counts, args.against)
    bar = ProgressBar(hidden=args.quiet or not sys.stderr.isatty())
    run_job(job, bar.show, enough=verifier.look)
    bar.close()
    document = verifier.document()
    for camera in document["cameras"].values() if own_clock else ():
        camera["blocks"].pop("time shift", None)
    paired = len(known) == 1 or args.camera  # then it is meant
    document["not_checked"] = [] if paired else [name for name in known if name not in verifier.cameras]
    if args.json:
        print(json.dumps(finite(document), allow_nan=False))
    else:
        from vical_daemon.results.verify_text import describe

        print(describe(document, Path(args.against).name))
    return {"holds": 0, "changed": EXIT_CHANGED}.get(document["verdict"], EXIT_CANNOT_TELL)


def _opened(args: argparse.Namespace) -> Recording:
    """Open the recording, and print what is unusual."""
    from vical_daemon.logs import open_recording

    recording = open_recording(
        args.input,
        cameras=named(args.camera),
        imus=named(args.imu),
        skip_s=args.skip,
        seconds=args.seconds,
    )
    for warning in recording.warnings:
        warn(warning)
    return recording


def _verifier(
    known: dict[str, KnownCamera], cameras: list[str], held: bool, counts: Counts, against: str
) -> Verifier:
    """Pair the recording's cameras with those of the calibration."""
    from vical_daemon.results.verifier import CameraCheck, Verifier

    if len(known) == len(cameras) == 1:
        known = {cameras[0]: next(iter(known.values()))}
    missing = [name for name in cameras if name not in known]
    if missing:
        there = ", ".join(known) or "none"
        raise CliError(
            f"{against} has no camera {missing[0]!r} (it has {there}); choose with --camera", EXIT_USAGE
        )
    checks = {
        name: CameraCheck(known[name].given_lens() if held else known[name], lens_asked=not held)
        for name in cameras
    }
    return Verifier(checks, counts)


def _initial(args: argparse.Namespace, known: dict[str, KnownCamera], rig: Rig | None) -> Initial:
    """What the estimator starts from: the lens in question, nothing about mounting and time shift."""
    from vical_daemon.config.priors import Initial, read_initial
    from vical_daemon.estimation.measurements import CameraPrior

    given = read_initial(args.initial) if args.initial else Initial()
    cameras = {
        name: replace(prior, T_imu_cam=None, timeshift_cam_imu_s=None)
        for name, prior in given.cameras.items()
    }
    for name, camera in known.items():
        if camera.lens is None:
            continue
        fx, fy, cx, cy, *distortion = (float(x) for x in camera.lens)
        readout_s = rig.cameras[camera.name].readout_s if rig is not None else 0.0
        cameras[name] = CameraPrior(
            camera.resolution or (0, 0),
            (fx, fy, cx, cy),
            camera.model,
            tuple(distortion),
            readout_s=readout_s,
        )
    lacking = [name for name in known if name not in cameras and len(cameras) != 1]
    if lacking:
        raise CliError(f"{args.against} has no lens of {lacking[0]}; give it with --initial", EXIT_USAGE)
    noise = given.imu_noise or (rig.noise if rig is not None else None)
    topics = {name: topic for name, topic in given.topics.items() if name not in known}
    return Initial(cameras, noise, given.imu_rate_hz, topics)


def _counts(args: argparse.Namespace) -> Counts:
    from vical_daemon.results.change_odds import Counts

    sizes = {
        "--position-mm": args.position_mm,
        "--rotation-deg": args.rotation_deg,
        "--timeshift-ms": args.timeshift_ms,
        "--focal-percent": args.focal_percent,
    }
    for option, value in sizes.items():
        if not (value > 0.0 and math.isfinite(value)):
            raise CliError(f"{option} must be above 0", EXIT_USAGE)
    return Counts(
        math.radians(args.rotation_deg),
        1e-3 * args.position_mm,
        1e-3 * args.timeshift_ms,
        1e-2 * args.focal_percent,
    )
