"""`vical watch`: subscribes to calibration updates and shows them live, with the health of every role."""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import CliError
from vical_daemon.cli.options import add_config, add_json

if TYPE_CHECKING:
    from vical_daemon.bus.interface import Bus, Sample
    from vical_daemon.bus.messages import VerifyResult
    from vical_daemon.estimation.result import CalibrationEstimate

_REFRESH_S = 0.25


_EPILOG = """\
examples:
  vical watch -c vical.yaml
  vical watch --until-converged --timeout 120 && echo done        in a script
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    add_config(parser, required=False)
    parser.add_argument(
        "--connect",
        metavar="ENDPOINT",
        help="router to connect to, e.g. tcp/127.0.0.1:7447 (default: the local bus)",
    )
    parser.add_argument("--rig", default="*", help="only this rig (default: all rigs on the bus)")
    parser.add_argument("--once", action="store_true", help="print the last known state and exit")
    parser.add_argument("--until-converged", action="store_true", help="exit when every camera has converged")
    parser.add_argument(
        "--timeout",
        type=float,
        metavar="S",
        help="give up after S seconds, with exit code 1 (default: never)",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Show until interrupted, converged or out of time; a bus that is not there yet is waited for."""
    from vical_daemon.cli.bus_wait import wait_for_bus

    begin_s = time.monotonic()
    end_s = begin_s + args.timeout if args.timeout else float("inf")
    never = threading.Event()
    bus = wait_for_bus(
        args.config, args.connect, end_s=begin_s if args.once else end_s, stop=never, quiet=args.quiet
    )
    assert bus is not None  # nobody stops it
    try:
        view = View(args.rig, as_json=args.json)
        view.begin(bus)
        return _loop(args, view, end_s)
    finally:
        bus.close()


def _loop(args: argparse.Namespace, view: View, end_s: float) -> int:
    if args.once:
        end_s = min(end_s, time.monotonic() + 3.0)
    with _screen(hidden=args.json) as show:
        while time.monotonic() < end_s:
            if args.once and view.estimates:
                break
            converged = args.until_converged and view.all_converged()
            if not args.once:
                view.print_new()
            show(view)
            if converged:  # its estimate has been printed
                return 0
            time.sleep(_REFRESH_S)
    if args.once:
        view.print_all()
        if not view.estimates:
            raise CliError("nothing is calibrating here; is `vical run` (vical.target) running?")
        return 0
    raise CliError(f"{args.timeout:g} s timeout: {view.where()}")


class View:
    """The last estimate of each camera and the last words of each role."""

    def __init__(self, rig: str, *, as_json: bool) -> None:
        self._rig, self._json = rig, as_json
        self.estimates: dict[tuple[str, str], CalibrationEstimate] = {}
        self._heard_s: dict[tuple[str, str], float] = {}
        self.health: dict[tuple[str, str], tuple[str, str]] = {}
        self._printed: dict[tuple[str, str], str] = {}  # level of each component, as last printed
        self.verified: dict[tuple[str, str], VerifyResult] = {}
        self._unprinted: deque[tuple[str, str, CalibrationEstimate]] = deque(maxlen=10_000)

    def begin(self, bus: Bus) -> None:
        """Ask for the last values first: a late joiner sees the state at once."""
        from vical_daemon.bus import topics

        for topic in (topics.CALIBRATION, topics.STATUS, topics.VERIFY):
            key = topic.pattern.format(rig=self._rig, name="*")
            for sample in bus.latest(key):
                self.take(sample)
            bus.subscribe(key, self.take)

    def take(self, sample: Sample) -> None:
        """Take a message; others than calibrations, verifications and statuses are ignored."""
        from vical_daemon.bus import topics

        parsed = topics.parse_key(sample.key)
        if parsed is not None and parsed.topic is topics.CALIBRATION:
            self._on_estimate(parsed.rig, parsed.name, sample)
        elif parsed is not None and parsed.topic is topics.STATUS:
            self._on_status(parsed.rig, sample)

        elif parsed is not None and parsed.topic is topics.VERIFY:
            self._on_verified(parsed.rig, parsed.name, sample)

    def all_converged(self) -> bool:
        """Whether there is a camera and every one has converged, and is still converged."""
        return (
            bool(self.estimates)
            and all(e.status == "converged" for e in self.estimates.values())
            and not self.silent()
        )

    def silent(self) -> dict[tuple[str, str], float]:
        """Return the cameras whose estimates have stopped, with the age of the last one, s."""
        from vical_daemon.service.liveness import FRESH_S

        now_s = time.monotonic()
        ages = {key: now_s - heard_s for key, heard_s in list(self._heard_s.items())}
        return {key: age_s for key, age_s in ages.items() if age_s > FRESH_S}

    def where(self) -> str:
        """Say in a few words how far each camera is."""
        silent = self.silent()
        each = [
            f"{camera} of {rig} is {estimate.status} ({estimate.progress:.0%})"
            + (f", said {silent[rig, camera]:.0f} s ago and silent since" if (rig, camera) in silent else "")
            for (rig, camera), estimate in sorted(self.estimates.items())
        ]
        return ", ".join(each) or "nothing is calibrating here; is `vical run` (vical.target) running?"

    def print_all(self) -> None:
        """Print the last estimate of each camera, and what does not work."""
        for (rig, camera), estimate in sorted(self.estimates.items()):
            self._print(rig, camera, estimate)
        self._print_problems()

    def print_new(self) -> None:
        """Print what came since the last call (here, not in the bus' thread: a pipe may be closed)."""
        while self._unprinted:
            entry = self._unprinted.popleft()
            if self._json or not sys.stdout.isatty():
                self._print(*entry)
        if not sys.stdout.isatty():
            self._print_problems()

    def problems(self, rig: str = "") -> list[dict[str, str]]:
        """Return the components that do not work as they should, of one rig or of all."""
        return [
            {"rig": of, "component": name, "level": level, "message": message}
            for (of, name), (level, message) in sorted(self.health.items())
            if level != "ok" and rig in ("", of)
        ]

    def _print_problems(self) -> None:
        """Print each component whose level has changed (JSON has them in every line)."""
        for key, (level, message) in sorted(self.health.items()):
            before, self._printed[key] = self._printed.get(key, "ok"), level
            if level != before and not self._json:
                print(f"{key[0]}  {key[1]}  {level}: {message}", flush=True)

    def _on_estimate(self, rig: str, camera: str, sample: Sample) -> None:
        from vical_daemon.bus.messages import MessageError, decode_calibration

        try:
            estimate = decode_calibration(sample.payload).estimate
        except MessageError:
            return
        self._heard_s[rig, camera] = time.monotonic()
        self.estimates[rig, camera] = estimate
        self._unprinted.append((rig, camera, estimate))

    def _print(self, rig: str, camera: str, estimate: CalibrationEstimate) -> None:
        verified = self.verified.get((rig, camera))
        if self._json:
            more: dict[str, Any] = {} if verified is None else {"verify": asdict(verified)}
            more["problems"] = self.problems(rig)
            print(json.dumps({"rig": rig, "camera": camera} | estimate.to_json() | more), flush=True)
        else:
            from vical_daemon.cli.live_table import one_line

            text = one_line(camera, estimate) if verified is None else f"{camera}  {verified.text}"
            print(f"{rig}  {text}", flush=True)

    def _on_verified(self, rig: str, camera: str, sample: Sample) -> None:
        from vical_daemon.bus.messages import MessageError, admit_verification

        with suppress(MessageError):
            self.verified[rig, camera] = admit_verification(sample.payload)

    def _on_status(self, rig: str, sample: Sample) -> None:
        from vical_daemon.bus.messages import MessageError, decode_diagnostics

        try:
            statuses = decode_diagnostics(sample.payload).statuses
        except MessageError:
            return
        for status in statuses:
            if status.name != "clock":
                self.health[rig, status.name] = (status.level.name.lower(), status.message)


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

    def _show(self, view: View) -> None:
        if self._live is None:
            return
        from vical_daemon.cli.live_table import screen

        self._live.update(screen(view.estimates, view.health, view.silent()), refresh=True)
