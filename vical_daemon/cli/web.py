"""`vical web`: the page of a rig that is running, from any machine that reaches its bus."""

from __future__ import annotations

import argparse
import json
import logging
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_config, add_json, check_port

if TYPE_CHECKING:
    from vical_daemon.bus.interface import Bus
    from vical_daemon.config.model import Config

_RETRY_S = 0.5
_EPILOG = """\
  vical web -c vical.yaml                 page at http://127.0.0.1:8080/
  vical web --port 0 --foxglove 8765      needs no config: lists the cameras on the bus; serves Foxglove, too

On a robot set `web: {enabled: true}` instead; then `vical run` serves the page.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add where to listen and which bus to ask."""
    add_config(parser, required=False)
    parser.add_argument(
        "--connect",
        metavar="ENDPOINT",
        help="router to connect to, e.g. tcp/127.0.0.1:7447 (default: the local bus)",
    )
    parser.add_argument("--host", help="address to listen on (default: as in the config, 127.0.0.1)")
    parser.add_argument("--port", type=int, help="port (default: as in the config, 8080; 0: any free one)")
    parser.add_argument(
        "--foxglove", type=int, metavar="PORT", help="also serve a WebSocket for Foxglove on this port"
    )
    parser.epilog = _EPILOG
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted; a bus that is not there yet is waited for, as is what it carries."""
    check_port("--port", args.port)
    check_port("--foxglove", args.foxglove)
    from vical_daemon.cli.bus_wait import wait_for_bus
    from vical_daemon.config.model import load
    from vical_daemon.service.wall_clock import private_clock
    from vical_daemon.web import role as web

    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    bus = wait_for_bus(args.config, args.connect, end_s=float("inf"), stop=stop, quiet=args.quiet)
    if bus is None:
        return 0
    try:
        config = load(args.config) if args.config else _discover(bus, stop)
        if config is None:
            return 0
        settings = config.web
        for name, value in (("host", args.host), ("port", args.port), ("foxglove_port", args.foxglove)):
            if value is not None:
                settings = replace(settings, **{name: value})
        web.run(replace(config, web=settings), bus, stop, clock=private_clock(), ready=_tell(args))
    finally:
        bus.close()
    return 0


def _tell(args: argparse.Namespace) -> Callable[[str], None]:
    """Return what prints the address once it is served."""

    def ready(address: str) -> None:
        print(json.dumps({"address": address}) if args.json else address, flush=True)
        if sys.stderr.isatty() and not args.quiet:
            print("Ctrl-C ends it", file=sys.stderr)

    return ready


def _discover(bus: Bus, stop: threading.Event) -> Config | None:
    """Make up the part of a config that the page needs from what is on the bus; None when stopped.

    Raises:
        CliError: Several rigs.
    """
    from vical_daemon.bus import topics
    from vical_daemon.config.model import CameraConfig, Config, ImuConfig

    parsed: list[topics.ParsedKey] = []
    reported = False
    while not parsed and not stop.is_set():
        found = [topics.parse_key(sample.key) for sample in bus.latest(f"{topics.ROOT}/**", 2.0)]
        parsed = [entry for entry in found if entry is not None]
        if not parsed and not reported:
            reported = True
            print(
                "vical: waiting: nothing on the bus yet; is `vical run` (vical.target) running?",
                file=sys.stderr,
            )
        if not parsed:
            stop.wait(_RETRY_S)
    if not parsed:
        return None
    rigs = sorted({entry.rig for entry in parsed})
    if len(rigs) > 1:
        raise CliError(
            f"several rigs are on this bus ({', '.join(rigs)}): choose one with -c FILE", EXIT_USAGE
        )
    about_cameras = (topics.CALIBRATION, topics.CAMERA_INFO, topics.POSE)
    cameras = sorted({entry.name for entry in parsed if entry.topic in about_cameras})
    logging.getLogger(__name__).info("rig %s, cameras %s", rigs[0], ", ".join(cameras) or "none")
    return Config(
        rig=rigs[0],
        imus={"imu0": ImuConfig(port="elsewhere")},
        cameras={name: CameraConfig(uri="elsewhere") for name in cameras},
    )
