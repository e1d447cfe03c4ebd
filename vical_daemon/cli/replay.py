"""`vical replay LOG`: puts a recording back on the bus in real time."""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_config, add_json, warn

if TYPE_CHECKING:
    from vical_daemon.bus.interface import Bus


_EPILOG = """\
examples:
  vical replay log.mcap                   then, in another terminal: vical watch
  vical replay log.mcap --speed 0 --streams imu0 cam0
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    parser.add_argument("log", metavar="LOG", help="a recording of any kind")
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        metavar="X",
        help="speed relative to real time (default 1; 0: as fast as possible)",
    )
    parser.add_argument("--rig", help="publish under this rig's keys (default: as recorded)")
    parser.add_argument(
        "--streams", nargs="+", metavar="NAME", help="play only these topics, IMUs or cameras (default: all)"
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="also play images of cameras whose detected points are in the recording",
    )
    parser.add_argument(
        "--connect",
        metavar="ENDPOINT",
        help="router to connect to, e.g. tcp/127.0.0.1:7447 (default: the local bus)",
    )
    parser.add_argument(
        "--wait",
        type=float,
        default=2.0,
        metavar="S",
        help="wait S seconds for subscribers, if this command hosts the bus (default 2)",
    )
    add_config(parser, required=False)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Publish with the time between stamps that there was; without a router, host the bus meanwhile."""
    from vical_daemon.logs import open_recording, unfit_imus
    from vical_daemon.offline.replay import replay

    if not (args.speed >= 0 and args.wait >= 0):
        raise CliError("--speed and --wait must be numbers, and not negative", EXIT_USAGE)
    recording = open_recording(args.log, topics=args.streams, check=False, as_recorded=True)
    for text in unfit_imus(recording):
        warn(text)
    bus = _open_bus(args)
    shows = sys.stderr.isatty() and not args.quiet

    def show(data_s: float) -> None:
        print(f"\r{data_s:7.1f} of {recording.duration_s:.1f} s", end="", file=sys.stderr, flush=True)

    try:
        result = replay(
            recording,
            bus,
            threading.Event(),
            speed=args.speed,
            rig=args.rig,
            everything=args.all,
            progress=show if shows else None,
        )
    finally:
        bus.close()
    if shows:
        print(file=sys.stderr)
    if args.json:
        print(json.dumps(result))
    else:
        late = f"the latest {result['late_ms']:.1f} ms late"
        print(f"{result['messages']} messages in {result['duration_s']:.1f} s, {late}")
    return 0


def _open_bus(args: argparse.Namespace) -> Bus:
    """Join the bus of the rig; where there is none, host it, so that others can come."""
    from vical_daemon.bus.zenoh_bus import BusError, open_bus
    from vical_daemon.cli.bus_access import open_client, socket_path
    from vical_daemon.config.model import BusConfig, load
    from vical_daemon.config.paths import make_private

    try:
        return open_client(args.config, args.connect)
    except BusError:
        if args.connect:
            raise
    settings = load(args.config).bus if args.config else BusConfig()
    path: Path = socket_path(settings)
    make_private(path.parent)
    port = settings.loopback_port
    print(
        f"nobody hosts the bus: hosting it at {path}{f' and tcp/127.0.0.1:{port}' if port else ''}",
        file=sys.stderr,
    )
    bus = open_bus(mode="router", socket=path, tcp_port=port)
    time.sleep(args.wait)  # or those who wait for a router miss the beginning
    return bus
