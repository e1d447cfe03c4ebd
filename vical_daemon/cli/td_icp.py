"""`vical td-icp INPUT`: temporal calibration alone, from the rotations of any sensors."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_json

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from vical_daemon.config.priors import Initial
    from vical_daemon.estimation.measurements import CameraPrior
    from vical_daemon.estimation.temporal.td_icp import TdIcpOptions
    from vical_daemon.estimation.temporal.td_icp_joint import OrientationStream
    from vical_daemon.estimation.temporal.td_icp_monitor import DelayReport
    from vical_daemon.logs import Recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.add_argument(
        "input", metavar="INPUT", help="MCAP, ROS 1 or 2 bag, ASL/EuRoC folder, or a trajectory file"
    )
    parser.add_argument("--target", metavar="FILE", help="the board, Kalibr's format (not needed for tracks)")
    parser.add_argument("--initial", metavar="FILE", help="the lens and the imu's noise: Kalibr's files")
    parser.add_argument("--camera", metavar="NAME", help="only this camera")
    parser.add_argument("--imu", metavar="NAME", help="which IMU, where there are several")
    parser.add_argument(
        "--sensors",
        metavar="A,B,C",
        help="several sensors jointly: names of imus and cameras, topics with orientations (Odometry, "
        "PoseStamped, PoseWithCovarianceStamped, TransformStamped, QuaternionStamped, Imu), trajectory files "
        "(TUM, EuRoC). The imu's gyro is the reference, or without one the fastest stream",
    )
    parser.add_argument(
        "--search", metavar="S", type=float, default=5.0, help="look for delays up to ± S seconds (5)"
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

    initial = read_initial(args.initial) if args.initial else Initial()
    if not Path(args.input).exists():
        raise CliError(f"{args.input} does not exist; check the path")
    names = [name.strip() for name in (args.sensors or "").split(",") if name.strip()]
    if names or is_trajectory(Path(args.input)):
        return _joint(args, initial, names)
    return _single(args, initial)


def is_trajectory(path: Path) -> bool:
    """Whether this is a trajectory as text rather than a recording."""
    return path.is_file() and path.suffix in (".txt", ".csv", ".tum")


def options_of(args: argparse.Namespace, initial: Initial) -> TdIcpOptions:
    """Return the settings that follow from the command line and what is known of the imu."""
    from vical_daemon.estimation.temporal.td_icp import TdIcpOptions

    noise = initial.imu_noise
    if noise is None:
        # an unknown imu: the default class, loosely
        return TdIcpOptions(search_s=args.search, gyro_log_sigma=0.7)
    return TdIcpOptions(search_s=args.search, gyro_density=noise.gyro_density, gyro_walk=noise.gyro_walk)


def open_input(path: str, camera: str | None = None) -> Recording:
    """Open a recording without judging it, of a folder only one camera; warnings go to stderr."""
    from vical_daemon.logs import open_recording

    cameras = () if camera is None else (camera,)
    recording = open_recording(
        path, cameras=cameras, check=False
    )  # wrong units are found here, with the reason
    for warning in recording.warnings:
        print(f"vical: warning: {warning}", file=sys.stderr)
    return recording


def choose_gyro(
    recording: Recording, name: str | None
) -> tuple[str, npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return name, stamps (ns) and rates (rad/s) of the imu that is meant.

    Raises:
        CliError: None, or several and no name.
    """
    imus = recording.imus
    if not imus:
        raise CliError(f"{recording.path} holds no imu data")
    if name is None and len(imus) > 1:
        raise CliError(
            f"{recording.path} holds the imus {', '.join(imus)}; choose one with --imu", EXIT_USAGE
        )
    chosen = name or next(iter(imus))
    if chosen not in imus:
        raise CliError(f"{recording.path} holds no imu {chosen!r}, only {', '.join(imus)}", EXIT_USAGE)
    arrays = recording.imu_arrays(chosen)
    return chosen, arrays.t_ns, arrays.gyro_rps


def _single(args: argparse.Namespace, initial: Initial) -> int:
    """One imu and one camera."""
    from vical_daemon.cli.td_icp_report import print_single, report_json
    from vical_daemon.cli.td_icp_sources import camera_stream, seconds, track_frames
    from vical_daemon.estimation.temporal.td_icp import REFUSED, td_icp
    from vical_daemon.estimation.temporal.track_registration import track_registration

    recording = open_input(args.input, args.camera)
    cameras = recording.cameras
    if not cameras:
        raise CliError(f"{recording.path} holds no camera: neither images nor points")
    if args.camera is None and len(cameras) > 1:
        raise CliError(
            f"{recording.path} holds the cameras {', '.join(cameras)}; choose one with --camera, "
            "or several with --sensors",
            EXIT_USAGE,
        )
    camera = args.camera or next(iter(cameras))
    if camera not in cameras:
        raise CliError(f"{recording.path} holds no camera {camera!r}, only {', '.join(cameras)}", EXIT_USAGE)
    imu, t_ns, gyro = choose_gyro(recording, args.imu)
    base = int(t_ns[0])
    options = options_of(args, initial)
    t_imu, prior = seconds(t_ns, base), prior_of(initial, camera)
    stream = None
    if cameras[camera].kind == "tracks":
        frames, used = track_frames(recording, cameras[camera], prior, base)
        lens = (used.lens.intrinsics, used.lens.distortion, used.lens.model)
        result = track_registration(t_imu, gyro, frames, lens, options)
    else:
        stream, used = camera_stream(recording, cameras[camera], prior, args.target, base)
        result = td_icp(t_imu, gyro, stream.t_s, stream.R_world_sensor, stream.rotation_sigma, options)
    document: dict[str, Any] = {**result.to_json(), "imu": imu, "camera": camera, "lens": used.to_json()}
    if args.watch is not None and stream is None:
        raise CliError("--watch needs a board: tracks of unknown points are fitted as a whole", EXIT_USAGE)
    if args.watch is not None and stream is not None and result.status != REFUSED:
        document["watch"] = [report_json(r) for r in _watch(t_imu, gyro, stream, options, args.watch)]
    if args.json:
        print(json.dumps(document))
    elif result.status != REFUSED:
        print_single(imu, camera, result, used, document.get("watch", []))
    if result.status == REFUSED:
        raise CliError(f"no delay found: {result.reason}")
    if result.reason:
        print(f"vical: warning: {result.reason}", file=sys.stderr)
    return 0


def prior_of(initial: Initial, camera: str) -> CameraPrior | None:
    """Return what a file says about a camera; a single camera of another name is meant for it."""
    prior = initial.cameras.get(camera)
    if prior is None and len(initial.cameras) == 1:
        prior = next(iter(initial.cameras.values()))
    return prior


def _watch(
    t_imu: npt.NDArray[np.float64],
    gyro: npt.NDArray[np.float64],
    stream: OrientationStream,
    options: TdIcpOptions,
    window_s: float,
) -> list[DelayReport]:
    """Replay the streams through the monitor in order of their stamps."""
    import numpy as np

    from vical_daemon.estimation.temporal.td_icp_monitor import DelayMonitor

    monitor = DelayMonitor(options, window_s, window_s / 2.0)
    sigma = np.asarray(stream.rotation_sigma)
    reports, k = [], 0
    ahead = options.search_s  # imu data beyond the camera's stamp, so that a positive delay finds its samples
    for i, t in enumerate(stream.t_s):
        while k < len(t_imu) and t_imu[k] <= t + ahead:
            monitor.add_gyro(float(t_imu[k]), gyro[k])
            k += 1
        covariance = sigma[i] if sigma.ndim == 3 else np.eye(3) * float(sigma.mean()) ** 2
        report = monitor.add_orientation(float(t), stream.R_world_sensor[i], covariance)
        if report is not None:
            reports.append(report)
    return reports


def _joint(args: argparse.Namespace, initial: Initial, names: list[str]) -> int:
    """Any number of sensors."""
    from vical_daemon.cli.td_icp_report import print_joint
    from vical_daemon.cli.td_icp_sensors import register
    from vical_daemon.estimation.temporal.td_icp import REFUSED

    result, lenses = register(args, initial, names)
    if args.json:
        used = {name: lens.to_json() for name, lens in lenses.items()}
        print(json.dumps({**result.to_json(), "lenses": used}))
    elif result.status != REFUSED:
        print_joint(result, lenses)
    if result.status == REFUSED:
        raise CliError(f"no delays found: {result.reason}")
    if result.reason:
        print(f"vical: warning: {result.reason}", file=sys.stderr)
    return 0
