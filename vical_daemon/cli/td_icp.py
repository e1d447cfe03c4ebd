"""`vical td-icp INPUT [SENSOR ...]`: temporal calibration alone, from the rotations of any sensors."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import RECORDING, add_json, warn

if TYPE_CHECKING:
    from vical_daemon.offline.td_icp.request import TdIcpRequest


_EPILOG = """\
examples:
  vical td-icp log.mcap --target board.yaml
  vical td-icp tracks/mav0 --initial camchain.yaml        without a board
  vical td-icp drive.bag --sensors imu0,/odom,/vicon/pose
  vical td-icp slam.txt mocap.txt                         trajectory files

The sign is Kalibr's: t_imu = t_cam + shift.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    parser.add_argument("input", metavar="INPUT", help=f"{RECORDING}; or a trajectory file")
    parser.add_argument("more", metavar="SENSOR", nargs="*", help="further sensors, as with --sensors")
    parser.add_argument(
        "--target",
        metavar="FILE",
        help="target file of the board, Kalibr's format (not needed for feature tracks)",
    )
    parser.add_argument("--initial", metavar="FILE", help="Kalibr's files with the lens and the IMU's noise")
    parser.add_argument("--camera", metavar="NAME", help="which camera, if the recording has several")
    parser.add_argument("--imu", metavar="NAME", help="which IMU, if the recording has several")
    parser.add_argument(
        "--sensors",
        metavar="A,B,C",
        help="register these sensors jointly: names of IMUs and cameras, topics with orientations (Odometry, "
        "PoseStamped, PoseWithCovarianceStamped, TransformStamped, QuaternionStamped, Imu), trajectory files "
        "(TUM, EuRoC). The IMU's gyro is the reference, or without one the fastest stream",
    )
    parser.add_argument(
        "--search", metavar="S", type=float, default=5.0, help="search delays up to ± S seconds (default 5)"
    )
    parser.add_argument(
        "--watch",
        metavar="S",
        type=float,
        help="also follow the delay through the recording in windows of S seconds",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Calibrate and print; 1 if there is no answer."""
    if not 0.0 < args.search <= 60.0:
        raise CliError("--search must be above 0 and at most 60 seconds", EXIT_USAGE)
    if args.watch is not None and not 3.0 <= args.watch <= 120.0:
        raise CliError("--watch must be 3 to 120 seconds", EXIT_USAGE)
    from vical_daemon.config.priors import Initial, read_initial
    from vical_daemon.offline.td_icp.request import TdIcpRequest, is_trajectory

    initial = read_initial(args.initial) if args.initial else Initial()
    if not Path(args.input).exists():
        raise CliError(f"{args.input} does not exist; check the path")
    names = args.more + [name.strip() for name in (args.sensors or "").split(",") if name.strip()]
    request = TdIcpRequest(Path(args.input), initial, args.target, args.camera, args.imu, args.search, warn)
    if names or is_trajectory(request.path):
        return _joint(args, request, names)
    return _single(args, request)


def _single(args: argparse.Namespace, request: TdIcpRequest) -> int:
    """One imu and one camera."""
    from vical_daemon.cli.td_icp_report import print_single, report_json
    from vical_daemon.estimation.temporal.td_icp_result import REFUSED
    from vical_daemon.offline.td_icp.single import register_camera

    found = register_camera(request, args.watch)
    result, lens = found.result, found.lens
    document: dict[str, Any] = {
        **result.to_json(),
        "imu": found.imu,
        "camera": found.camera,
        "lens": lens.to_json(),
    }
    if args.watch is not None and result.status != REFUSED:
        document["watch"] = [report_json(r) for r in found.watch]
    if args.json:
        print(json.dumps(document))
    elif result.status != REFUSED:
        print_single(found.imu, found.camera, result, lens, document.get("watch", []))
    return _end(result.status, "delay", result.reason)


def _joint(args: argparse.Namespace, request: TdIcpRequest, names: list[str]) -> int:
    """Any number of sensors."""
    from vical_daemon.cli.td_icp_report import print_joint
    from vical_daemon.estimation.temporal.td_icp_result import REFUSED
    from vical_daemon.offline.td_icp.sensors import register_sensors

    result, lenses = register_sensors(request, names)
    if args.json:
        used = {name: lens.to_json() for name, lens in lenses.items()}
        print(json.dumps({**result.to_json(), "lenses": used}))
    elif result.status != REFUSED:
        print_joint(result, lenses)
    return _end(result.status, "delays", result.reason)


def _end(status: str, what: str, reason: str) -> int:
    from vical_daemon.estimation.temporal.td_icp_result import REFUSED

    if status == REFUSED:
        raise CliError(f"no {what} found: {reason}")
    if reason:
        warn(reason)
    return 0
