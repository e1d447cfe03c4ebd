"""`vical watch`: subscribes to calibration updates and shows them live, with the health of every role."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_FAILURE, CliError
from vical_daemon.cli.options import add_config, add_json

if TYPE_CHECKING:
    from vical_daemon.bus import Bus, Sample
    from vical_daemon.estimation.result import CalibrationEstimate

HELP = "subscribe to calibration updates and show them live"
_REFRESH_S = 0.25


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = "in a script: vical watch --until-converged --timeout 120 && echo done"
    add_config(parser, required=False)
    parser.add_argument(
        "--connect", metavar="ENDPOINT", help="a router, e.g. tcp/127.0.0.1:7447 (default: ours)"
    )
    parser.add_argument("--rig", default="*", help="only this rig (default: all that are heard)")
    parser.add_argument("--once", action="store_true", help="print the last known state and end")
    parser.add_argument("--until-converged", action="store_true", help="end when every camera has converged")
    parser.add_argument("--timeout", type=float, metavar="S", help="give up after so many seconds (exit 1)")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Show until interrupted, converged or out of time."""
    from vical_daemon.cli.bus_access import open_client

    bus = open_client(args.config, args.connect)
    try:
        view = _View(args)
        view.begin(bus)
        return _loop(args, view)
    finally:
        bus.close()


def _loop(args: argparse.Namespace, view: _View) -> int:
    end_s = time.monotonic() + args.timeout if args.timeout else float("inf")
    if args.once:
        end_s = min(end_s, time.monotonic() + 3.0)
    with _screen(hidden=args.json) as show:
        while time.monotonic() < end_s:
            if args.once and view.estimates:
                break
            if args.until_converged and view.all_converged():
                return 0
            if not args.once:
                view.print_new()
            show(view)
            time.sleep(_REFRESH_S)
    if args.once:
        view.print_all()
        if not view.estimates:
            raise CliError("nothing is calibrating here; is `vical run` (vical.target) up?")
        return 0
    return EXIT_FAILURE


class _View:
    """The last estimate of each camera and the last words of each role."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._rig: str = args.rig
        self._json: bool = args.json
        self.estimates: dict[tuple[str, str], CalibrationEstimate] = {}
        self.health: dict[tuple[str, str], str] = {}
        self._unprinted: deque[tuple[str, str, CalibrationEstimate]] = deque(maxlen=10_000)

    def begin(self, bus: Bus) -> None:
        """Ask for the last values first: a late joiner sees the state at once."""
        from vical_daemon import topics

        for topic, handler in ((topics.CALIBRATION, self._on_estimate), (topics.STATUS, self._on_status)):
            key = topic.pattern.format(rig=self._rig, name="*")
            for sample in bus.latest(key):
                handler(sample)
            bus.subscribe(key, handler)

    def all_converged(self) -> bool:
        return bool(self.estimates) and all(e.status == "converged" for e in self.estimates.values())

    def print_all(self) -> None:
        for (rig, camera), estimate in sorted(self.estimates.items()):
            self._print(rig, camera, estimate)

    def print_new(self) -> None:
        """Print what came since the last call (here, not in the bus' thread: a pipe may be closed)."""
        while self._unprinted:
            entry = self._unprinted.popleft()
            if self._json or not sys.stdout.isatty():
                self._print(*entry)

    def _on_estimate(self, sample: Sample) -> None:
        from vical_daemon import topics
        from vical_daemon.messages import MessageError, decode_calibration

        parsed = topics.parse_key(sample.key)
        try:
            estimate = decode_calibration(sample.payload).estimate
        except MessageError:
            return
        if parsed is None or parsed.topic is not topics.CALIBRATION:
            return
        self.estimates[parsed.rig, parsed.name] = estimate
        self._unprinted.append((parsed.rig, parsed.name, estimate))

    def _print(self, rig: str, camera: str, estimate: CalibrationEstimate) -> None:
        if self._json:
            print(json.dumps({"rig": rig, "camera": camera} | estimate.to_json()), flush=True)
        else:
            from vical_daemon.cli.live_table import one_line

            print(f"{rig}  {one_line(camera, estimate)}", flush=True)

    def _on_status(self, sample: Sample) -> None:
        from vical_daemon import topics
        from vical_daemon.messages import MessageError, decode_diagnostics

        parsed = topics.parse_key(sample.key)
        try:
            statuses = decode_diagnostics(sample.payload).statuses
        except MessageError:
            return
        if parsed is not None:
            for status in statuses:
                if status.name != "clock":
                    self.health[parsed.rig, status.name] = f"{status.level.name.lower():<6}{status.message}"


class _screen:  # noqa: N801 (used like a function)
    """A live table on a terminal; elsewhere lines are printed as they come."""

    def __init__(self, *, hidden: bool) -> None:
        self._live: Any = None
        self._wanted = sys.stdout.isatty() and not hidden

    def __enter__(self) -> Any:
        if self._wanted:
            from rich.live import Live

            self._live = Live(auto_refresh=False)
            self._live.__enter__()
        return self._show

    def __exit__(self, *args: object) -> None:
        if self._live is not None:
            self._live.__exit__(*args)

    def _show(self, view: _View) -> None:
        if self._live is None:
            return
        from rich.console import Group
        from rich.text import Text

        from vical_daemon.cli.live_table import picture

        parts: list[Any] = [
            Group(Text(f"rig {rig}", style="bold"), picture(camera, estimate, []))
            for (rig, camera), estimate in sorted(view.estimates.items())
        ]
        parts = parts or [Text("waiting for a calibration; is `vical run` (vical.target) up?")]
        parts += [
            Text(f"{rig}  {name:<14} {text}", style="dim")
            for (rig, name), text in sorted(view.health.items())
        ]
        self._live.update(Group(*parts), refresh=True)
