"""`vical export SOURCE --format F`: the result in the form that other software reads."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_json
from vical_daemon.service.atomic_file import write_output

if TYPE_CHECKING:
    from vical_daemon.results.export import ExportFile, Rig

FORMATS = ("kalibr", "ros", "opencv", "openvins", "vins", "orbslam3", "basalt", "urdf", "json")
_EPILOG = """\
examples:
  vical calibrate log.mcap --target target.yaml -o result.json
  vical export result.json --format kalibr -o camchain-imucam.yaml
  vical export log.mcap --format openvins -o openvins/         write every file of the format to a folder
  vical export store --format urdf                             the last stored calibration
  vical export camchain-imucam.yaml --format basalt            Kalibr's result for other software

Further files of a format (imu.yaml, one file per camera) are written next to the main one.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add SOURCE, the format and what the source may lack."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="result (.json), log (.mcap), Kalibr's camchain (.yaml), a store's folder, `store` (the latest)",
    )
    parser.add_argument("--format", required=True, choices=FORMATS, metavar="F", help=", ".join(FORMATS))
    parser.add_argument(
        "-o", "--output", metavar="F", help="file or folder (default: the main file on stdout)"
    )
    parser.add_argument("--camera", metavar="NAME", help="use only this camera (default: all)")
    parser.add_argument(
        "--resolution", metavar="WxH", help="image size in px, e.g. 752x480, if the source has none"
    )
    parser.add_argument("--imu-noise", metavar="F.yaml", help="Kalibr's imu.yaml with the noise densities")
    parser.add_argument(
        "--imu-topic", metavar="T", default="/imu0", help="ROS topic of the IMU in the files (default /imu0)"
    )
    parser.add_argument(
        "--image-topic", metavar="T", help="ROS topic of the images in the files (one camera only)"
    )
    parser.add_argument(
        "--imu-frame",
        metavar="NAME",
        help="name of the IMU frame in ros and urdf (default: as on the bus, else imu)",
    )
    parser.add_argument(
        "--force", action="store_true", help="also write directions that the motion did not determine"
    )
    parser.epilog = _EPILOG
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Read, convert, write."""
    from vical_daemon.offline.sources import read_source
    from vical_daemon.results.export import export

    rig = _complete(read_source(args.source), args)
    files = export(rig, args.format, force=args.force)
    if rig.status not in ("", "converged"):
        print(f"vical: warning: not converged: {rig.status}: {rig.reason}", file=sys.stderr)
    for camera in rig.cameras.values():
        for direction in camera.unobservable:
            print(
                f"vical: warning: {camera.name}: not determined by the motion: {direction}", file=sys.stderr
            )
    if args.output:
        written = write_files(files, Path(args.output))
        if args.json:
            print(json.dumps({"format": args.format, "files": [str(p) for p in written]}))
        else:
            print("\n".join(str(p) for p in written))
    elif args.json:
        print(json.dumps({"format": args.format, "files": {f.name: f.text for f in files}}))
    else:
        print(files[0].text, end="")
        if len(files) > 1:
            rest = ", ".join(f.name for f in files[1:])
            print(f"vical: give -o FOLDER to get also {rest}", file=sys.stderr)
    return 0


def write_files(files: list[ExportFile], output: Path) -> list[Path]:
    """Write the main file to `output` and the others next to it; into a folder under their usual names.

    Raises:
        CliError: The folder is missing.
    """
    folder = output.is_dir() or output.suffix == ""
    parent = output if folder else output.parent
    if folder:
        parent.mkdir(parents=True, exist_ok=True)
    elif not parent.is_dir():
        raise CliError(f"{parent}: no such folder; make it first")
    paths = []
    for number, file in enumerate(files):
        path = output if number == 0 and not folder else parent / file.name
        write_output(path, file.text)
        paths.append(path)
    return paths


def _complete(rig: Rig, args: argparse.Namespace) -> Rig:
    """Add what the options say: camera, image size, noise, topics."""
    cameras = dict(rig.cameras)
    if args.camera:
        if args.camera not in cameras:
            known = ", ".join(cameras) or "none"
            raise CliError(f"no camera {args.camera!r} in {args.source} (there: {known})", EXIT_USAGE)
        cameras = {args.camera: cameras[args.camera]}
    if args.resolution:
        size = _size(args.resolution)
        cameras = {n: c if c.resolution else replace(c, resolution=size) for n, c in cameras.items()}
    if args.image_topic:
        if len(cameras) != 1:
            raise CliError("--image-topic is for one camera; choose it with --camera", EXIT_USAGE)
        cameras = {n: replace(c, topic=args.image_topic) for n, c in cameras.items()}
    noise = rig.noise
    if args.imu_noise:
        from vical_daemon.config.priors import read_initial

        noise = read_initial(args.imu_noise).imu_noise or noise
    frame = args.imu_frame or rig.imu_frame
    return replace(rig, cameras=cameras, noise=noise, imu_topic=args.imu_topic, imu_frame=frame)


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise CliError(f"--resolution {text!r}: write it like 640x480", EXIT_USAGE)
    return int(width), int(height)
