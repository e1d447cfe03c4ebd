"""`vical init`: a commented config from what is plugged in, then `vical check` of it."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_json
from vical_daemon.service.atomic_file import write_output

if TYPE_CHECKING:
    from vical_daemon.cli.check import Finding
    from vical_daemon.cli.init_config import FoundCamera

_EPILOG = """\
examples:
  vical init                        what is plugged in; uses a target file next to the config
  vical init --target aprilgrid     also makes board.pdf to print, and target.yaml
  vical init --emulated             no hardware: an emulated IMU and a rendered camera

It asks no questions. Comments in the config explain each key; correct what vical could not determine.
"""
_BOARD_FILE, _TARGET_FILE = "board.pdf", "target.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        default="vical.yaml",
        help="config to write (default vical.yaml)",
    )
    parser.add_argument(
        "--target",
        choices=("aprilgrid", "checkerboard"),
        help=f"also make a board for an A4 sheet: {_BOARD_FILE} and {_TARGET_FILE}, next to the config",
    )
    parser.add_argument("--rig", metavar="NAME", help="name of the rig (default: this computer's)")
    parser.add_argument(
        "--port",
        action="append",
        default=[],
        metavar="PORT",
        help="also look for an IMU on this port (for pseudo terminals); may be repeated",
    )
    parser.add_argument(
        "--emulated", action="store_true", help="use an emulated IMU and a rendered camera instead of devices"
    )
    parser.add_argument("--no-check", action="store_true", help="write the files only, without the check")
    parser.add_argument("--force", action="store_true", help="overwrite existing files")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Look, write, check; 1 if nothing is plugged in or the check finds something."""
    folder = args.output.absolute().parent
    if not folder.is_dir():
        raise CliError(f"-o {args.output}: its folder does not exist", EXIT_USAGE)
    if args.emulated and (args.port or args.target):
        raise CliError("--emulated brings its own IMU and board: omit --port and --target", EXIT_USAGE)
    makes_target = args.target is not None or args.emulated
    _refuse_to_overwrite(args, [args.output, *([folder / _TARGET_FILE] if makes_target else [])])
    from vical_daemon.cli import init_config
    from vical_daemon.config.model import ConfigError, loads

    imus, cameras = ([], []) if args.emulated else _look(args)
    target = _make_target(args, folder) if makes_target else init_config.target_beside(args.output)
    rig = init_config.rig_name() if args.rig is None else args.rig
    if args.emulated:
        text = init_config.emulated_config(rig, _TARGET_FILE)
    else:
        text = init_config.config_of(rig, imus, cameras, target)
    try:
        loads(text, str(args.output))
    except ConfigError as error:  # --rig, or what a device says of itself
        raise CliError(str(error), EXIT_USAGE) from None
    write_output(args.output, text)
    _say(args, f"wrote {args.output}" + (f" (target: {target})" if target else ""))
    if target is None:
        _say(args, "no board: calibrates from what the camera sees. With one: vical init --target aprilgrid")
    findings = [] if args.no_check else _check(args)
    return _end(args, imus, cameras, target, findings)


def _say(args: argparse.Namespace, text: str) -> None:
    if not args.quiet:
        print(text, file=sys.stderr if args.json else sys.stdout)


def _refuse_to_overwrite(args: argparse.Namespace, paths: list[Path]) -> None:
    for path in paths:
        if path.exists() and not args.force:
            raise CliError(f"{path} exists; choose another name with -o, or overwrite it with --force")


def _look(args: argparse.Namespace) -> tuple[list[dict[str, Any]], list[FoundCamera]]:
    """Ask all serial ports, and open each camera once as it is."""
    from vical_daemon.cli import devices
    from vical_daemon.cli.init_config import look_at

    ports = devices.probe_all(devices.different([*args.port, *devices.serial_ports()]))
    imus = [port for port in ports if port["found"]]
    listed, problem = devices.list_cameras()
    cameras = [look_at(camera) for camera in listed]
    for port in ports:
        if not port["found"] and port["port"] in args.port:
            raise CliError(str(port["problem"]))
    for imu in imus:
        _say(args, f"found IMU {imu['model']} serial {imu['serial_number']} on {imu['port']}")
    for camera in cameras:
        _say(args, f"found camera {camera.model} at {camera.uri}")
    if not imus and not cameras:
        why = f" ({problem})" if problem else ""
        raise CliError(
            f"no IMU and no camera found{why}; `vical devices` shows what answered, `vical doctor` "
            "what may be wrong. Without hardware: vical init --emulated"
        )
    return imus, cameras


def _make_target(args: argparse.Namespace, folder: Path) -> str:
    """Write the target file (and the board to print); its name."""
    if args.emulated:
        from vical_daemon.cli.demo import BOARD
        from vical_daemon.vision.target import Checkerboard

        board = Checkerboard(**BOARD)  # type: ignore[arg-type]
        write_output(folder / _TARGET_FILE, board.to_yaml())
        return _TARGET_FILE
    from vical_daemon.cli import target

    parser = argparse.ArgumentParser()
    target.add_arguments(parser)
    paths = ["-o", str(folder / _BOARD_FILE), "--yaml", str(folder / _TARGET_FILE), "--force"]
    made = target.make(parser.parse_args(["--type", args.target, *paths]))
    _say(args, f"wrote {folder / _BOARD_FILE}: {made.description}; print it at 100 %, and measure it")
    return _TARGET_FILE


def _check(args: argparse.Namespace) -> list[Finding]:
    from vical_daemon.cli import check
    from vical_daemon.config.model import load

    findings = []
    for finding in check.examine(load(args.output), str(args.output), devices=True):
        findings.append(finding)
        if not args.json:
            check.print_line(finding)
    return findings


def _end(
    args: argparse.Namespace,
    imus: list[dict[str, Any]],
    cameras: list[FoundCamera],
    target: str | None,
    findings: list[Finding],
) -> int:
    from vical_daemon.cli import check

    if args.json:
        document = {
            "config": str(args.output),
            "target": target,
            "emulated": args.emulated,
            "imus": [str(imu["port"]) for imu in imus],
            "cameras": [camera.uri for camera in cameras],
            "check": None if args.no_check else check.document(findings),
        }
        print(json.dumps(document))
    if any(finding.problem for finding in findings):
        raise CliError(f"{args.output} is written, but: {check.count(findings)}")
    _say(args, f"next: vical run -c {args.output}, and http://127.0.0.1:8080/ or `vical watch`")
    return 0
