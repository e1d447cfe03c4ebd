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
from vical_daemon.cli.options import add_config, add_json

if TYPE_CHECKING:
    from vical_daemon.bus.interface import Bus
    from vical_daemon.logs import Recording

_PROGRESS_S = 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.add_argument("log", metavar="LOG", help="a recording of any kind")
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        metavar="X",
        help="speed relative to real time; 0: as fast as possible",
    )
    parser.add_argument("--rig", help="publish under this rig's keys (default: as recorded)")
    parser.add_argument(
        "--streams", nargs="+", metavar="NAME", help="play only these topics, IMUs or cameras"
    )
    parser.add_argument("--all", action="store_true", help="also play images of cameras that have points")
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
        help="wait S seconds for subscribers, if this command hosts the bus",
    )
    add_config(parser, required=False)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Publish with the time between stamps that there was; without a router, host the bus meanwhile."""
    from vical_daemon.logs import open_recording

    if args.speed < 0 or args.wait < 0:
        raise CliError("--speed and --wait must not be negative", EXIT_USAGE)
    recording = open_recording(args.log, topics=args.streams, check=False, as_recorded=True)
    bus = _open_bus(args)
    try:
        result = replay(
            recording,
            bus,
            threading.Event(),
            speed=args.speed,
            rig=args.rig,
            everything=args.all,
            progress=sys.stderr.isatty() and not args.quiet,
        )
    finally:
        bus.close()
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


def replay(
    recording: Recording,
    bus: Bus,
    stop: threading.Event,
    *,
    speed: float = 1.0,
    rig: str | None = None,
    everything: bool = False,
    progress: bool = False,
) -> dict[str, float]:
    """Publish a recording; stamps stay as recorded.

    Args:
        recording: What to publish.
        bus: Where to.
        stop: Ends it early.
        speed: Times real time; 0: as fast as it goes.
        rig: Name of the rig in the keys; None: as recorded.
        everything: Every stream, not only the best one of each camera.
        progress: Show it on stderr.

    Returns:
        ``bus/messages``, ``duration_s`` and ``late_ms``, by how much the latest message came late.
    """
    from vical_daemon.bus.topics import check_name
    from vical_daemon.logs.recorded_logs import stamp_of

    prefix = f"vical/{check_name(rig)}/" if rig else ""
    begin_s, count, late_s, shown_s = time.monotonic(), 0, 0.0, 0.0
    first_ns = recording.begin_ns
    for key, payload in recording.messages(recording.streams if everything else None):
        data_s = ((stamp_of(payload) or first_ns) - first_ns) * 1e-9
        wait_s = begin_s + data_s / speed - time.monotonic() if speed else 0.0
        if wait_s > 0:
            stop.wait(wait_s)
        elif speed:
            late_s = max(late_s, -wait_s)
        if stop.is_set():
            break
        bus.publish(prefix + key.split("/", 2)[2] if prefix else key, payload)
        count += 1
        now_s = time.monotonic()
        if progress and now_s - shown_s >= _PROGRESS_S:
            shown_s = now_s
            print(f"\r{data_s:7.1f} of {recording.duration_s:.1f} s", end="", file=sys.stderr, flush=True)
    if progress:
        print(file=sys.stderr)
    return {"messages": count, "duration_s": time.monotonic() - begin_s, "late_ms": late_s * 1e3}
