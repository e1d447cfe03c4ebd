"""`vical export SOURCE --format F`: the result in the form that other software reads."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_json

if TYPE_CHECKING:
    from vical_daemon.results.export import ExportFile, Rig

FORMATS = ("kalibr", "ros", "opencv", "openvins", "vins", "orbslam3", "basalt", "urdf", "json")
_RESULT_LIMIT = 2**25  # bytes; a result takes 0.5 kB for each second of recording: 18 hours
_EPILOG = """\
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
        "source", metavar="SOURCE", help="result JSON, log (.mcap), Kalibr's camchain (.yaml), or: store"
    )
    parser.add_argument("--format", required=True, choices=FORMATS, metavar="F", help=", ".join(FORMATS))
    parser.add_argument(
        "-o", "--output", metavar="F", help="file or folder (default: the main file on stdout)"
    )
    parser.add_argument("--camera", metavar="NAME", help="only this camera")
    parser.add_argument("--resolution", metavar="WxH", help="image size, if the source has none")
    parser.add_argument("--imu-noise", metavar="F.yaml", help="Kalibr's imu.yaml with the noise densities")
    parser.add_argument("--imu-topic", metavar="T", default="/imu0", help="ROS topic of the IMU")
    parser.add_argument("--image-topic", metavar="T", help="ROS topic of the images (one camera)")
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
    from vical_daemon.results.export import export

    rig = _complete(read_source(args.source), args)
    files = export(rig, args.format, force=args.force)
    if rig.status not in ("", "converged"):
        print(f"vical: warning: not converged: {rig.status}: {rig.reason}", file=sys.stderr)
    for camera in rig.cameras.values():
        for direction in camera.unobservable:
            print(f"vical: warning: {camera.name}: not revealed by the motion: {direction}", file=sys.stderr)
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
    """Write the main file to `output` and the others beside it; into a folder under their usual names.

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
        path.write_text(file.text, encoding="utf-8")
        paths.append(path)
    return paths


def read_source(source: str) -> Rig:
    """Read a rig from whatever the source is.

    Raises:
        CliError: Nothing there that holds a calibration.
    """
    from vical_daemon.results.export import rig_from_json
    from vical_daemon.results.export.kalibr import read_camchain

    path = Path(source)
    if source == "store" and not path.exists():
        return _from_store()
    if not path.exists():
        raise CliError(f"{source}: no such file")
    if path.suffix in (".yaml", ".yml"):
        return read_camchain(path)
    if path.is_dir() or path.suffix == ".mcap" or path.name.endswith(".mcap.part"):
        return _from_log(path)
    return rig_from_json(_read_json(path), note=f"vical, from {path.name}")


def _read_json(path: Path) -> dict[str, Any]:
    """Read a result; of a file with several lines (`vical demo --json`) the last one counts."""
    from vical_drivers.user_files import read_text

    try:
        text = read_text(path, _RESULT_LIMIT)
        document = json.loads(text)
    except json.JSONDecodeError as error:
        lines = [line for line in text.splitlines() if line.strip()]
        try:
            document = json.loads(lines[-1]) if lines else None
        except json.JSONDecodeError:
            raise CliError(f"{path}: not JSON: {error}") from None
    except (UnicodeDecodeError, RecursionError):
        raise CliError(f"{path}: not JSON; give the result of `vical calibrate -o`") from None
    if not isinstance(document, dict):
        raise CliError(f"{path}: not a result of `vical calibrate --json`")
    return document


def _from_log(path: Path) -> Rig:
    """Read the last calibration of every camera, and image sizes, from our own log."""
    from vical_daemon.bus.messages import (
        CALIBRATION_TYPE,
        CAMERA_INFO_TYPE,
        POSE_TYPE,
        decode_calibration,
        decode_camera_info,
        decode_pose,
        merge_calibrations,
    )
    from vical_daemon.logs.mcap import LogReader
    from vical_daemon.results.export import rig_from_estimate

    last: dict[str, bytes] = {}
    sizes: dict[str, tuple[int, int]] = {}
    devices: dict[str, str] = {}
    frames: set[str] = set()
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    for file in files:
        reader = LogReader(file)
        for message in reader.messages():
            if message.channel.type_name == CALIBRATION_TYPE:
                last[message.channel.topic] = message.payload
            elif message.channel.type_name == POSE_TYPE:
                frames.add(decode_pose(message.payload).frame_id)
            elif message.channel.type_name == CAMERA_INFO_TYPE:
                info = decode_camera_info(message.payload)
                sizes[info.frame_id] = (info.width, info.height)
        for name, values in reader.metadata:
            devices |= values if name == "devices" else {}
    if not last:
        raise CliError(
            f"{path}: no calibration in this log; run `vical calibrate {path} --target FILE -o result.json` "
            "and export result.json"
        )
    estimate = merge_calibrations(decode_calibration(data) for data in last.values())
    rig = rig_from_estimate(estimate, sizes, note=f"vical, from {path.name}")
    return replace(rig, devices=devices, imu_frame=frames.pop() if len(frames) == 1 else rig.imu_frame)


def _from_store() -> Rig:
    """Read the newest stored calibration of every camera."""
    from dataclasses import replace as with_changes

    from vical_daemon.config.paths import state_directory
    from vical_daemon.results.export import rig_from_estimate
    from vical_daemon.results.store import CalibrationStore

    folder = state_directory() / "calibration"
    stored = sorted(CalibrationStore(folder).all(), key=lambda entry: entry.saved_ns)
    if not stored:
        raise CliError(f"no calibration is stored in {folder}: nothing has converged on this machine yet")
    cameras = {entry.camera: entry.known for entry in stored}
    estimate = with_changes(stored[-1].estimate, cameras=cameras)
    devices = {"imu": stored[-1].imu_serial} | {f"camera/{e.camera}": e.camera_serial for e in stored}
    return replace(rig_from_estimate(estimate, note="vical, from the store"), devices=devices)


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
